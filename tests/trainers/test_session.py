"""A run's parts wired together, and what is said where they do not fit."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from curricula.lessons import Lessons
from curricula.samplers import UniformSampler
from envs import memory
from trainers.common.errors import UserError
from trainers.evaluation import evaluation_environment
from trainers.experience.episodes import EpisodeBatch
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings
from trainers.session import Session

MakeRun = Callable[..., RunSettings]
MakeSession = Callable[..., Session]
LESSONS = {
    "type": "lessons",
    "measure": "reward",
    "smoothing_episodes": 2,
    "min_lesson_length": 2,
    "lessons": [
        {"threshold": 0.0, "parameters": {"scale": 3.0}},
        {"threshold": 0.5, "parameters": {"scale": 2.0}},
        {"parameters": {"scale": 1.0}},
    ],
}


def refused(make_run: MakeRun, registries: Registries, *arguments: Any, **sections: Any) -> str:
    with pytest.raises(UserError) as caught:
        Session(make_run(*arguments, **sections), registries)
    return str(caught.value)


def test_an_encoder_for_no_observation_names_the_nearest(
    make_run: MakeRun, registries: Registries
) -> None:
    encoders = {"goals": {"type": "vector"}}
    message = refused(make_run, registries, "target", encoders=encoders)
    assert message == "encoders: the environment has no observation 'goals'; did you mean 'goal'?"


def test_an_image_too_small_for_its_encoder_names_the_encoders_key(
    make_run: MakeRun, registries: Registries
) -> None:
    encoders = {"camera": {"type": "paper", "size": 80}}
    message = refused(make_run, registries, "picture", encoders=encoders)
    assert message.startswith("encoders.camera (paper): a 8x8 image")
    # The default encoder has the same rule, and the same words.
    assert refused(make_run, registries, "picture").startswith("encoders.camera (simple): a 8x8")


@pytest.mark.parametrize(
    ("high", "told"), [(np.inf, True), (np.finfo(np.float32).max, True), (255.0, False)]
)
def test_images_without_bounds_are_told_once(
    make_run: MakeRun,
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    high: float,
    told: bool,
) -> None:
    run = make_run("picture", encoders={"camera": {"type": "fully_connected"}})
    space = Box(0.0, high, (8, 8, 1), np.float32)
    monkeypatch.setattr(run.environment.cls, "spaces", lambda _: {"camera": space})
    Session(run, registries).close()
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == told
    assert all("'camera': images without bounds are taken as they are" in line for line in said)


@pytest.mark.parametrize("rewards", [None, []])
@pytest.mark.parametrize("pays_by_itself", [True, False])
def test_a_run_in_which_nothing_is_paid_is_told(
    make_run: MakeRun,
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    rewards: Any,
    pays_by_itself: bool,
) -> None:
    run = make_run("target", rewards=rewards)
    monkeypatch.setattr(run.environment.cls, "pays_by_itself", pays_by_itself)
    Session(run, registries).close()
    assert ("rewards: the run file lists none" in caplog.text) is not pays_by_itself


def test_an_encoder_of_the_wrong_kind_names_its_key(
    make_run: MakeRun, registries: Registries
) -> None:
    message = refused(make_run, registries, "target", encoders={"goal": {"type": "simple"}})
    assert message.startswith("encoders.goal (simple): ")


def test_unknown_environment_parameters_name_where_they_stand(
    make_run: MakeRun, registries: Registries
) -> None:
    message = refused(make_run, registries, "target", environment_parameters={"scales": 1.0})
    assert message == (
        "environment_parameters: the environment has no parameter 'scales'; did you mean 'scale'?"
    )
    lessons = copy.deepcopy(LESSONS)
    for lesson in lessons["lessons"]:  # type: ignore[union-attr]
        lesson["parameters"] = {"size": 1.0}  # type: ignore[index]
    message = refused(make_run, registries, "target", curriculum=lessons)
    assert message == ("curriculum: the environment has no parameter 'size'; known: scale, shift")


def test_the_environment_is_closed_when_the_rest_does_not_fit(
    make_run: MakeRun, registries: Registries, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run("target", encoders={"goals": {"type": "vector"}})
    closed: list[Any] = []
    monkeypatch.setattr(run.environment.cls, "close_extras", lambda self, **_: closed.append(self))
    with pytest.raises(UserError):
        Session(run, registries)
    assert len(closed) == 1
    session = Session(make_run("target"), registries)
    session.close()
    assert closed[1:] == [session.env_runner.env]


def test_settings_the_environment_refuses_name_its_section(
    make_run: MakeRun, registries: Registries, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run("target")

    def refuse(*_: Any) -> None:
        raise ValueError("too many blocks for this table: lower blocks")

    monkeypatch.setattr(run.environment.cls, "__init__", refuse)
    with pytest.raises(UserError, match=r"^environment \(target\): too many blocks"):
        Session(run, registries)


@pytest.mark.parametrize("lesson", [0, 1, 2])
def test_parameters_the_environment_refuses_are_the_users_mistake(
    make_run: MakeRun,
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
    lesson: int,
) -> None:
    run = make_run("target", curriculum=LESSONS)
    environment, refused_scale = run.environment.cls, (3.0, 2.0, 1.0)[lesson]
    accept, closed = environment.set_parameters, []

    def set_parameters(self: Any, given: Any) -> None:
        if given["scale"] == refused_scale:
            raise ValueError(f"nothing fits in {refused_scale}")
        accept(self, given)

    monkeypatch.setattr(environment, "set_parameters", set_parameters)
    monkeypatch.setattr(environment, "close_extras", lambda self, **_: closed.append(self))
    message = r"^environment_parameters or curriculum: nothing fits in"
    with pytest.raises(UserError, match=message):
        Session(run, registries)
    assert len(closed) == 1
    if lesson == 2:
        with pytest.raises(UserError, match=message):
            evaluation_environment(run, 1)
        assert len(closed) == 2


def test_of_a_curriculum_that_does_not_tell_all_its_lessons_the_last_is_looked_at(
    make_run: MakeRun, registries: Registries, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(Lessons, "all_parameters")
    run, given = make_run("target", curriculum=LESSONS), []
    monkeypatch.setattr(run.environment.cls, "set_parameters", lambda _, these: given.append(these))
    Session(run, registries).close()
    assert given == [{"scale": 1.0}, {"scale": 3.0}]


def test_episodes_that_cannot_begin_are_the_users_mistake(
    make_run: MakeRun, registries: Registries, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Any, **_: Any) -> None:
        raise ValueError("no scene with 3 blocks fits: lower blocks")

    session = Session(make_run("target"), registries)
    monkeypatch.setattr(type(session.env_runner.env), "reset", full)
    with pytest.raises(UserError, match=r"^environment: no scene with 3 blocks fits: lower blocks"):
        session.reset()


@pytest.mark.parametrize(
    ("trainer", "message"),
    [
        # 2 x 2000 + 2000, 2000^2 + 2000, 2001 for each of two means and a value, 2; 16 bytes.
        (
            {"network_settings": {"hidden_units": 2000, "num_layers": 2, "critic": "shared"}},
            "trainer.network_settings and encoders: to train networks with 4,014,005 parameters "
            "needs 0.06 GB, and the machine has 0.05 GB: make hidden layers or encoders smaller",
        ),
        # 250,000 steps of 4 environments with 8 bytes each, and 4 KiB of a step's.
        (
            {"hyperparameters": {"buffer_size": 10**6}},
            "trainer.hyperparameters.buffer_size: to collect 1,000,000 transitions before an "
            "update needs 1.0 GB, and the machine has 0.05 GB: lower it",
        ),
        (
            {"trainer_type": "ddpg", "time_horizon": 10**5},
            "trainer.time_horizon: to collect 400,000 transitions before an update needs 0.4 GB, "
            "and the machine has 0.05 GB: lower it",
        ),
        # 8 bytes observed, 8 done, 38 beside.
        (
            {"trainer_type": "ddpg", "hyperparameters": {"buffer_size": 10**7}},
            "trainer.hyperparameters.buffer_size: to keep 10,000,000 transitions needs 0.5 GB, "
            "and the machine has 0.05 GB: lower it",
        ),
    ],
    ids=["networks", "rollout", "time horizon", "replay buffer"],
)
def test_what_the_machine_has_no_memory_for_is_refused_before_it_is_made(
    make_run: MakeRun,
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
    trainer: dict[str, Any],
    message: str,
) -> None:
    monkeypatch.setattr(memory, "machine_bytes", lambda: 50 * 10**6)
    assert refused(make_run, registries, "target", trainer) == message
    Session(make_run("target"), registries).close()


def parameters(session: Session) -> dict[str, Any]:
    return dict(session.env_runner.env.parameters)  # type: ignore[attr-defined]


def test_a_lessons_parameters_stand_over_the_runs(make_session: MakeSession) -> None:
    sampler = {"sampler_type": "uniform", "sampler_parameters": {"min_value": 0, "max_value": 1}}
    session = make_session(
        "target", environment_parameters={"scale": 9.0, "shift": sampler}, curriculum=LESSONS
    )
    assert parameters(session)["scale"] == 3.0
    assert isinstance(parameters(session)["shift"], UniformSampler)
    session = make_session("target", environment_parameters={"scale": 9.0})
    assert parameters(session) == {"scale": 9.0}
    assert (session.lesson, session.lesson_count) == (0, 1)


def episodes(*rewards: float, first: int = 0) -> EpisodeBatch:
    """Episodes with numbers from `first` on; the 4 with which a session begins have 0 to 3."""
    number = first + np.arange(len(rewards))
    return EpisodeBatch(number, np.array(rewards), np.ones(len(rewards)), {}, {})


def test_lessons_advance_with_the_episodes_and_set_the_environment(
    make_session: MakeSession,
) -> None:
    session = make_session("target", curriculum=LESSONS)
    assert session.lesson_count == 3
    assert not session.advance_curriculum(episodes(1.0), 0.1)
    assert parameters(session) == {"scale": 3.0}
    assert session.advance_curriculum(episodes(1.0), 0.2)
    assert session.lesson == 1
    assert parameters(session) == {"scale": 2.0}
    assert not session.advance_curriculum(episodes(0.1, 0.1, 0.1, first=4), 0.3)
    assert not make_session("target").advance_curriculum(episodes(9.0, 9.0), 1.0)


def test_episodes_that_were_begun_in_a_lesson_count_for_no_other(
    make_session: MakeSession,
) -> None:
    session = make_session("target", curriculum=LESSONS)
    session.advance_curriculum(episodes(1.0, 1.0), 0.1)
    assert session.lesson == 1
    assert not session.advance_curriculum(episodes(9.0, 9.0), 0.2)  # 2 and 3: still of lesson 1
    assert not session.advance_curriculum(episodes(9.0, 9.0, first=3), 0.2)
    assert session.advance_curriculum(episodes(9.0, first=5), 0.2)  # the second after number 4
    assert session.env_runner.parameters_from == 4  # as many as have begun


def test_a_lesson_has_a_title_with_its_name(make_session: MakeSession) -> None:
    named = copy.deepcopy(LESSONS)
    named["lessons"][1]["name"] = "narrow"  # type: ignore[index]
    session = make_session("target", curriculum=named)
    assert session.lesson_title == "lesson 1 of 3"
    session.advance_curriculum(episodes(1.0, 1.0), 0.1)
    assert session.lesson_title == "lesson 2 of 3 (narrow)"
    assert make_session("target").lesson_title == "lesson 1 of 1"


def test_lessons_of_progress_see_the_runs(make_session: MakeSession) -> None:
    lessons = {**LESSONS, "measure": "progress", "lessons": copy.deepcopy(LESSONS["lessons"])}
    del lessons["smoothing_episodes"], lessons["min_lesson_length"]
    lessons["lessons"][0]["threshold"] = 0.25  # type: ignore[index]
    session = make_session("target", curriculum=lessons)
    assert not session.advance_curriculum(episodes(), 0.25)
    assert session.advance_curriculum(episodes(), 0.26)


def test_a_state_taken_up_goes_on_in_its_lesson(make_session: MakeSession) -> None:
    session = make_session("target", curriculum=LESSONS)
    session.advance_curriculum(episodes(1.0, 1.0), 0.1)
    session.advance_curriculum(episodes(0.9, first=4), 0.1)
    state, weights = copy.deepcopy(session.state_dict()), session.weights()
    other = make_session("target", curriculum=LESSONS, seed=5)
    other.load_state_dict(weights, state)
    assert other.lesson == 1
    assert parameters(other) == {"scale": 2.0}
    assert not other.advance_curriculum(episodes(0.9), 0.1)  # it is of the lesson before
    assert other.advance_curriculum(episodes(0.9, first=5), 0.1)  # the second good one of this
    np.testing.assert_equal(
        other.env_runner.observations["goal"], session.env_runner.observations["goal"]
    )


def test_a_state_of_a_longer_curriculum_is_refused(make_session: MakeSession) -> None:
    session = make_session("target", curriculum=LESSONS)
    state = copy.deepcopy(session.state_dict())
    state["curriculum"]["lesson"] = 7
    with pytest.raises(ValueError, match=r"7.*3 lessons"):
        session.load_state_dict(session.weights(), state)


def test_equal_seeds_begin_alike_and_others_do_not(make_session: MakeSession) -> None:
    first, again, other = (make_session("target", seed=seed) for seed in (1, 1, 2))
    for name, tensor in first.weights().items():
        assert torch.equal(tensor, again.weights()[name])
    goal = first.env_runner.observations["goal"]
    np.testing.assert_array_equal(goal, again.env_runner.observations["goal"])
    assert not np.array_equal(goal, other.env_runner.observations["goal"])
    assert any(not torch.equal(t, other.weights()[name]) for name, t in first.weights().items())


def test_what_the_environment_keeps_for_critics_is_not_shown_to_the_policy(
    make_session: MakeSession,
) -> None:
    network = {"critic": "separate", "critic_observations": ["goal", "privileged"]}
    session = make_session({"type": "target", "privileged": True}, {"network_settings": network})
    policy = session.algorithm.policy
    assert set(policy.actor.vector_encoders) == {"goal"}
    assert set(policy.critic.vector_encoders) == {"goal", "privileged"}
