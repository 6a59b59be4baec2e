"""The training loop: when it saves, and what it leaves behind however it ends."""

from __future__ import annotations

import copy
import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.environment import EnvironmentFailure
from trainers import training as training_module
from trainers.common.errors import NonFiniteError
from trainers.common.stopping import StopRequested
from trainers.reporting.summary import Summary
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings
from trainers.saving import resumable
from trainers.saving.checkpoint import Checkpoints, Loaded
from trainers.session import Session

MakeRun = Callable[..., RunSettings]
LESSONS = {
    "type": "lessons",
    "measure": "reward",
    "smoothing_episodes": 2,
    "min_lesson_length": 9,
    "lessons": [{"threshold": -99.0, "parameters": {"scale": 2.0}}, {"parameters": {"scale": 1.0}}],
}


class Quiet:
    """A log and a display that keep only the messages."""

    def __init__(self) -> None:
        self.messages: list[str] = []

    def message(self, text: str) -> None:
        self.messages.append(text)

    def ignore(self, *_: Any) -> None:
        pass

    update = advance = scalars = images = status = ignore


class HeldOut:
    """An evaluation that ends in one way or another, every 32 steps."""

    scored_by, score, target_reached, took_s = "success", 0.5, None, 1.0

    def __init__(self, ends_with: Exception | None = None):
        self.latest = {"step": 0}
        self._ends_with = ends_with

    def due(self, step: int) -> bool:
        return step % 32 == 0

    def evaluate(self, step: int, log: Any) -> None:
        if self._ends_with is not None:
            raise self._ends_with
        self.latest = {"step": step}


class Training:
    """One training run in a temporary folder."""

    def __init__(
        self,
        run: RunSettings,
        registries: Registries,
        folder: Path,
        stop_at_step: float = np.inf,
    ):
        self.stop_at_step = stop_at_step
        self.session = Session(run, registries, lambda: self.steps >= self.stop_at_step)
        self.settings: Any = run.trainer.settings
        self.checkpoints = Checkpoints(folder, keep=99)
        self.quiet = Quiet()
        self.resumed: Loaded | None = None
        self.session.reset()

    @property
    def steps(self) -> int:
        return self.session.env_runner.step_count

    @property
    def saved(self) -> list[int]:
        return [entry.step for entry in self.checkpoints.list_checkpoints()]

    def resume(self) -> Loaded:
        self.resumed = self.checkpoints.load_latest()
        self.session.load_state_dict(self.resumed.weights, self.resumed.state)
        return self.resumed

    def train(self, held_out: Any = None) -> bool:
        quiet: Any = self.quiet
        env, settings = self.session.env_runner.env, self.settings
        summary = Summary(quiet, "run", env, settings.max_steps, settings.summary_freq)
        loop = training_module.Training(
            self.session, settings, quiet, summary, self.checkpoints, quiet, held_out, self.resumed
        )
        self.ending = loop.run()
        return self.ending.finished


@pytest.fixture
def training(make_run: MakeRun, registries: Registries, tmp_path: Path) -> Callable[..., Training]:
    """Builds a `Training` of 16 steps a collection; arguments as `write_run`'s."""

    def make(
        trainer: Any = None,
        *,
        environment: Any = "target",
        stop_at_step: float = np.inf,
        folder: str = "run",
        **rest: Any,
    ) -> Training:
        run = make_run(environment, trainer or {}, **rest)
        return Training(run, registries, tmp_path / folder, stop_at_step)

    return make


def test_a_run_ends_after_its_steps_and_is_saved_on_the_way(
    training: Callable[..., Training],
) -> None:
    one = training({"max_steps": 72, "checkpoint_interval": 32})
    assert one.train() is True
    assert one.steps == 80  # the fifth collection reaches 72
    assert one.saved == [32, 64, 80]
    assert one.ending.reason == "max_steps: 72 steps were taken"
    last = one.checkpoints.load_latest()
    assert last.state["step"] == 80
    for name, tensor in one.session.weights().items():
        assert torch.equal(tensor, last.weights[name])


def test_the_algorithm_hears_how_much_of_the_run_is_over(
    training: Callable[..., Training], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = training({"max_steps": 40})
    shares: list[float] = []
    update = one.session.algorithm.update
    monkeypatch.setattr(
        one.session.algorithm, "update", lambda share: shares.append(share) or update(share)
    )
    one.train()
    assert shares == [0.0, 0.4, 0.8]


def test_a_stop_within_a_collection_saves_the_state_before_it(
    training: Callable[..., Training],
) -> None:
    one = training(stop_at_step=40)
    assert one.train() is False
    assert one.steps == 40
    assert one.saved == [32]
    assert one.checkpoints.load_latest().state["interaction"]["step_count"] == 32


def test_a_stop_before_the_first_step_can_be_taken_up_too(
    training: Callable[..., Training],
) -> None:
    assert training(stop_at_step=0).train() is False
    again = training()
    assert again.resume().step == 0
    assert again.train() is True
    assert again.saved[-1] == 64


@pytest.mark.parametrize("ended_by", ["limit", "stop"])
@pytest.mark.parametrize(
    ("algorithm", "critic", "memory", "own"),
    [
        ("ppo", "shared", None, {"beta_schedule": "constant"}),
        ("ppo", "separate", None, {"beta_schedule": "constant"}),
        ("ppo", "separate", {"memory_size": 4}, {"beta_schedule": "constant"}),
        ("trpo", "separate", None, {"fisher_fraction": 0.5, "normalize_rewards": True}),
    ],
)
def test_two_halves_make_the_same_whole(
    training: Callable[..., Training],
    ended_by: str,
    algorithm: str,
    critic: str,
    memory: dict[str, Any] | None,
    own: dict[str, Any],
) -> None:
    # Where a collection ends, an episode is under way.
    parts = {"environment": {"type": "target", "episode_steps": 5}, "curriculum": LESSONS}

    def trainer(max_steps: int) -> dict[str, Any]:
        return {
            "trainer_type": algorithm,
            "max_steps": max_steps,
            "hyperparameters": {"learning_rate_schedule": "constant", "num_epoch": 2, **own},
            "network_settings": {"critic": critic, "memory": memory, "normalize": True},
        }

    whole = training(trainer(96), folder="whole", **parts)
    assert whole.train()
    first = (
        training(trainer(48), folder="halves", **parts)
        if ended_by == "limit"
        else training(trainer(96), folder="halves", stop_at_step=52, **parts)
    )
    first.train()
    assert first.saved[-1] == 48
    second = training(trainer(96), folder="halves", **parts)
    second.resume()
    assert second.train()
    expected, got = whole.checkpoints.load_latest(), second.checkpoints.load_latest()
    assert expected.step == got.step == 96
    assert expected.state["curriculum"]["lesson"] == 1
    for name, tensor in expected.weights.items():
        assert torch.equal(tensor, got.weights[name]), name
    np.testing.assert_equal(as_arrays(got.state), as_arrays(expected.state))


@pytest.mark.parametrize("ended_by", ["limit", "stop"])
def test_two_halves_make_the_same_whole_where_the_replay_buffer_is_saved(
    training: Callable[..., Training], ended_by: str
) -> None:
    def halves(max_steps: int, **options: Any) -> Training:
        hyper = {
            "save_replay_buffer": True,
            "updates_per_step": 0.3,
            "n_step": 2,
            "random_actions": 0.2,
            "noise": {"type": "ornstein_uhlenbeck", "sigma": 0.2},
        }
        trainer = {
            "trainer_type": "ddpg",
            "max_steps": max_steps,
            "hyperparameters": hyper,
            "network_settings": {"normalize": True},
        }
        return training(trainer, curriculum=LESSONS, **options)

    whole = halves(128, folder="whole")  # more than the buffer takes
    assert whole.train()
    first = (
        halves(80, folder="halves")
        if ended_by == "limit"
        else halves(128, folder="halves", stop_at_step=84)
    )
    first.train()
    assert first.saved[-1] == 80
    second = halves(128, folder="halves")
    second.resume()
    assert second.train()
    expected, got = whole.checkpoints.load_latest(), second.checkpoints.load_latest()
    for name, tensor in expected.weights.items():
        assert torch.equal(tensor, got.weights[name]), name
    np.testing.assert_equal(as_arrays(got.state), as_arrays(expected.state))


def as_arrays(state: Any) -> Any:
    if isinstance(state, torch.Tensor):
        return state.numpy()
    if isinstance(state, dict):
        return {key: as_arrays(value) for key, value in state.items()}
    return [as_arrays(value) for value in state] if isinstance(state, list) else state


def breaking_after(one: Training, steps: int, breakage: Callable[[Any], Any]) -> None:
    step = one.session.env_runner.env.step

    def broken(actions: np.ndarray) -> Any:
        result = step(actions)
        return breakage(result) if one.steps >= steps else result

    one.session.env_runner.env.step = broken  # type: ignore[method-assign]


def test_a_broken_environment_leaves_the_run_saved(training: Callable[..., Training]) -> None:
    one = training({"checkpoint_interval": 1000})

    def breakage(_: Any) -> Any:
        raise EnvironmentFailure("a cable came loose")

    breaking_after(one, 40, breakage)
    with pytest.raises(EnvironmentFailure, match="a cable came loose"):
        one.train()
    assert one.saved == [32]


@pytest.mark.parametrize("bad", [np.nan, 1e30])
def test_numbers_that_are_not_finite_save_nothing_new(
    training: Callable[..., Training], bad: float
) -> None:
    one = training({"checkpoint_interval": 16})

    def breakage(result: Any) -> Any:
        observations, reward, *rest = result
        return observations, reward + bad, *rest

    breaking_after(one, 36, breakage)
    good: dict[int, dict[str, torch.Tensor]] = {}
    save = one.checkpoints.save

    def noted(step: int, weights: Any, *rest: Any) -> Path:
        good[step] = copy.deepcopy(dict(weights))
        return save(step, weights, *rest)

    one.checkpoints.save = noted  # type: ignore[method-assign]
    with pytest.raises(NonFiniteError, match=r"^step (40|48): the (reward|loss)"):
        one.train()
    assert one.saved == [16, 32]
    last = one.checkpoints.load_latest()
    assert all(torch.equal(last.weights[name], tensor) for name, tensor in good[32].items())


def kinds(one: Training) -> dict[int, tuple[float | None, str]]:
    return {e.step: (e.score, e.score_of) for e in one.checkpoints.list_checkpoints()}


def test_an_evaluation_that_is_stopped_saves_the_run_unscored(
    training: Callable[..., Training],
) -> None:
    one = training({"checkpoint_interval": 1000})
    assert one.train(HeldOut(StopRequested())) is False
    assert kinds(one) == {32: (None, "evaluation.success")}
    assert one.checkpoints.load_latest().state["interaction"]["step_count"] == 32
    assert one.ending.reason == "stopped, and saved"


def test_an_evaluation_whose_environment_breaks_leaves_the_run_saved(
    training: Callable[..., Training],
) -> None:
    one = training({"checkpoint_interval": 1000})
    with pytest.raises(EnvironmentFailure, match="a cable came loose"):
        one.train(HeldOut(EnvironmentFailure("a cable came loose")))
    assert kinds(one) == {32: (None, "evaluation.success")}
    again = training()
    assert again.resume().step == 32
    assert again.train() is True


def test_an_evaluation_scores_the_policy_that_it_is_of_alone(
    training: Callable[..., Training],
) -> None:
    one = training({"checkpoint_interval": 16}, stop_at_step=52)
    one.train(HeldOut())
    none = (None, "evaluation.success")
    assert kinds(one) == {16: none, 32: (0.5, "evaluation.success"), 48: none}
    one = training({"checkpoint_interval": 999}, stop_at_step=36, folder="stopped_at_once")
    one.train(HeldOut())
    assert kinds(one) == {32: (0.5, "evaluation.success")}


def test_without_evaluations_the_reward_since_the_last_checkpoint_is_the_score(
    training: Callable[..., Training], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = training({"checkpoint_interval": 32, "summary_freq": 1000})
    rewards: list[list[float]] = []
    add_episodes = Summary.add_episodes

    def noted(summary: Summary, episodes: Any) -> None:
        rewards.append(list(episodes.rewards))
        add_episodes(summary, episodes)

    monkeypatch.setattr(Summary, "add_episodes", noted)
    one.train()
    first, second, third, fourth = rewards
    assert kinds(one) == {
        32: (pytest.approx(np.mean(first + second)), "reward"),
        64: (pytest.approx(np.mean(third + fourth)), "reward"),
    }
    lessons = training(curriculum=LESSONS, folder="lessons")
    lessons.train()
    assert set(kinds(lessons).values()) == {(None, "age")}


def contents(one: Training) -> dict[str, bytes]:
    folder = one.checkpoints.directory
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("stop_at_step", [0, 48, 52, 64])
def test_a_run_taken_up_and_stopped_at_once_leaves_its_checkpoints_as_they_are(
    training: Callable[..., Training], stop_at_step: int
) -> None:
    trainer = {"checkpoint_interval": 32}
    training(trainer, stop_at_step=stop_at_step).train()
    before, again = contents(training()), training(trainer, stop_at_step=0)
    again.resume()
    again.train()
    assert contents(again) == before


def test_a_stop_right_after_a_checkpoint_saves_nothing_twice(
    training: Callable[..., Training], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, saved = training({"checkpoint_interval": 32}, stop_at_step=36), []
    save = one.checkpoints.save

    def noted(step: int, *rest: Any) -> Path:
        saved.append(step)
        return save(step, *rest)

    monkeypatch.setattr(one.checkpoints, "save", noted)
    one.train()
    assert saved == [32]
    assert kinds(one)[32][0] is not None


@pytest.mark.parametrize("stop_at_step", [20, 36, 52, 68])
def test_scores_and_intervals_are_those_of_a_run_that_was_not_stopped(
    training: Callable[..., Training], stop_at_step: int
) -> None:
    constant = {"learning_rate_schedule": "constant", "beta_schedule": "constant"}
    trainer = {"max_steps": 96, "checkpoint_interval": 32, "hyperparameters": constant}
    whole = training(trainer, folder="whole")
    whole.train()
    training(trainer, stop_at_step=stop_at_step).train()
    again = training(trainer)
    again.resume()
    again.train()
    scores = kinds(again)
    if stop_at_step % 32 > 16:
        scores.pop(stop_at_step // 16 * 16)  # saved because of the stop
    assert scores == kinds(whole)
    assert list(scores) == [32, 64, 96]


def test_an_evaluation_that_was_cut_off_scores_its_checkpoint_when_it_is_made_up_for(
    training: Callable[..., Training],
) -> None:
    training({"checkpoint_interval": 1000}).train(HeldOut(StopRequested()))
    again, made_up_for = training(stop_at_step=0), HeldOut()
    made_up_for.latest = {"step": again.resume().step}
    again.train(made_up_for)
    assert kinds(again) == {32: (0.5, "evaluation.success")}
    assert again.checkpoints.load_latest().state["interaction"]["step_count"] == 32


# -- every way out saves -------------------------------------------------------------------------

SEPARATE = {"critic": "separate", "normalize": True}
ALGORITHMS = {
    "ppo": {"hyperparameters": {"num_epoch": 3}, "network_settings": SEPARATE},
    "trpo": {"hyperparameters": {"num_epoch": 3}, "network_settings": SEPARATE},
    "ddpg": {"hyperparameters": {"save_replay_buffer": True}, "network_settings": SEPARATE},
}


def cut_off(
    one: Training,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException | None,
    after_steps: int,
    optimizer_steps: int,
) -> None:
    """Lets an update fail, or be asked to stop, after so many of its optimizer steps."""
    algorithm: Any = one.session.algorithm
    take, taken = algorithm._optimizer_step, itertools.count(1)

    def step(*arguments: Any) -> Any:
        told = take(*arguments)
        if one.steps > after_steps and next(taken) == optimizer_steps:
            if error is not None:
                raise error
            one.stop_at_step = 0
        return told

    monkeypatch.setattr(algorithm, "_optimizer_step", step)


@pytest.mark.parametrize(
    ("algorithm", "error"),
    [
        *itertools.product(ALGORITHMS, [None, MemoryError()]),
        ("ppo", SystemExit(0)),
        ("ppo", NonFiniteError("the loss is nan")),
    ],
    ids=repr,
)
def test_an_update_that_is_cut_off_leaves_the_run_as_it_was_before(
    training: Callable[..., Training],
    monkeypatch: pytest.MonkeyPatch,
    algorithm: str,
    error: BaseException | None,
) -> None:
    trainer = {
        "trainer_type": algorithm,
        "max_steps": 80,
        "checkpoint_interval": 1000,
        **ALGORITHMS[algorithm],
    }
    whole = training(trainer, folder="whole")
    assert whole.train()
    with monkeypatch.context() as patch:
        first = training(trainer, folder="halves")
        cut_off(first, patch, error, after_steps=48, optimizer_steps=5)
        if error is None:
            assert first.train() is False
        else:
            with pytest.raises(type(error)) as failed:
                first.train()
            assert failed.value is error
            assert not getattr(error, "__notes__", [])
    assert first.steps == 64  # all of the fourth collection was there
    assert first.saved == [48]
    second = training(trainer, folder="halves")
    second.resume()
    assert second.train()
    expected, got = whole.checkpoints.load_latest(), second.checkpoints.load_latest()
    for name, tensor in expected.weights.items():
        assert torch.equal(tensor, got.weights[name]), name
    np.testing.assert_equal(as_arrays(got.state), as_arrays(expected.state))


def test_an_update_that_can_not_be_taken_back_is_not_stopped_and_its_failure_saves_nothing(
    training: Callable[..., Training], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resumable, "LEAST_BYTES", 0)  # now the replay buffer is a large one
    trainer = {
        "trainer_type": "ddpg",
        "checkpoint_interval": 32,
        **ALGORITHMS["ddpg"],
    }
    stopped = training(trainer, folder="stopped")
    cut_off(stopped, monkeypatch, None, after_steps=32, optimizer_steps=1)
    assert stopped.train() is False
    assert stopped.saved == [32, 48]
    failed = training(trainer, folder="failed")
    cut_off(failed, monkeypatch, MemoryError(), after_steps=32, optimizer_steps=1)
    with pytest.raises(MemoryError):
        failed.train()
    assert failed.saved == [32]


@pytest.mark.parametrize("error", [ZeroDivisionError("a plugin's"), SystemExit(0)], ids=repr)
@pytest.mark.parametrize("part", ["env_runner.env.step", "advance_curriculum", "report"])
def test_whatever_fails_leaves_the_run_saved(
    training: Callable[..., Training],
    monkeypatch: pytest.MonkeyPatch,
    part: str,
    error: BaseException,
) -> None:
    one = training({"checkpoint_interval": 1000})
    owner: Any = Summary if part == "report" else one.session
    *path, name = part.split(".")
    for attribute in path:
        owner = getattr(owner, attribute)
    call = getattr(owner, name)

    def failing(*arguments: Any) -> Any:
        if one.steps >= 40:
            raise error
        return call(*arguments)

    monkeypatch.setattr(owner, name, failing)
    with pytest.raises(type(error)):
        one.train()
    assert one.saved == [32]
    assert one.checkpoints.load_latest().state["interaction"]["step_count"] == 32


def test_what_failed_first_is_told_where_the_run_can_not_be_saved(
    training: Callable[..., Training], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = training({"checkpoint_interval": 1000})
    failure = EnvironmentFailure("a cable came loose")

    def breakage(_: Any) -> Any:
        raise failure

    def full(*_: Any) -> None:
        raise OSError("the disk is full")

    breaking_after(one, 40, breakage)
    monkeypatch.setattr(one.checkpoints, "save", full)
    with pytest.raises(EnvironmentFailure) as failed:
        one.train()
    assert failed.value.__cause__ is failure
    assert failed.value.__notes__ == ["the run could not be saved: the disk is full"]


def test_the_second_signal_saves_nothing(training: Callable[..., Training]) -> None:
    one = training({"checkpoint_interval": 1000})

    def breakage(_: Any) -> Any:
        raise KeyboardInterrupt

    breaking_after(one, 40, breakage)
    with pytest.raises(KeyboardInterrupt):
        one.train()
    assert one.saved == []


@pytest.mark.parametrize("interval", [16, 1000])
def test_weights_that_are_not_finite_are_not_saved(
    training: Callable[..., Training], monkeypatch: pytest.MonkeyPatch, interval: int
) -> None:
    one = training({"checkpoint_interval": interval})
    algorithm: Any = one.session.algorithm
    update = algorithm.update

    def overflowing(run_fraction: float) -> Any:
        statistics = update(run_fraction)
        if one.steps == 32:
            algorithm.policy.action_model.log_std.data.fill_(np.inf)
        return statistics

    monkeypatch.setattr(algorithm, "update", overflowing)
    with pytest.raises(NonFiniteError) as failed:
        one.train()
    if interval == 16:
        assert re.fullmatch(r"step 32: the weights '.+' are not finite", str(failed.value))
        assert one.saved == [16]
    else:
        (note,) = failed.value.__notes__
        assert note.startswith("the run could not be saved: step 32: the weights '")
        assert one.saved == []


def test_a_new_lesson_is_announced(training: Callable[..., Training]) -> None:
    wide, narrow = LESSONS["lessons"]  # type: ignore[misc]
    named = {**LESSONS, "lessons": [wide, {**narrow, "name": "fine"}]}  # type: ignore[dict-item]
    one = training(curriculum=named)  # 4 episodes a collection: the ninth is in the third
    one.train()
    assert one.quiet.messages == ["step 48: lesson 2 of 2 (fine) begins"]


@pytest.mark.parametrize(("episode_steps", "told_at"), [(99, [32]), (4, [])])
def test_an_episode_without_an_end_is_told_once_with_what_to_set(
    training: Callable[..., Training],
    monkeypatch: pytest.MonkeyPatch,
    episode_steps: int,
    told_at: list[int],
) -> None:
    # 64 steps of 4 environments are 16 of each, and a third of them is over after two collections.
    monkeypatch.setattr(training_module, "ENDLESS_STEPS", (1, 1000))
    one = training(environment={"type": "target", "episode_steps": episode_steps})
    one.train()
    assert [int(said.split(":")[0].removeprefix("step ")) for said in one.quiet.messages] == told_at
    assert all("for 8 steps" in said for said in one.quiet.messages)
    assert all("environment.max_episode_steps" in said for said in one.quiet.messages)


@pytest.mark.parametrize(("limits", "told_at"), [((9, 1000), 48), ((1, 4), 16)])
def test_an_episode_may_take_some_steps_of_any_run_but_no_more_than_any_takes(
    training: Callable[..., Training],
    monkeypatch: pytest.MonkeyPatch,
    limits: tuple[int, int],
    told_at: int,
) -> None:
    monkeypatch.setattr(training_module, "ENDLESS_STEPS", limits)
    one = training(environment={"type": "target", "episode_steps": 99})
    one.train()
    (message,) = one.quiet.messages
    assert message.startswith(f"step {told_at}: ")


def test_a_finished_run_taken_up_again_is_finished_at_once(
    training: Callable[..., Training],
) -> None:
    training().train()
    again = training()
    again.resume()
    assert again.train() is True
    assert again.steps == 64
