"""Evaluation while a run learns, and what is chosen and ended by it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from trainers.held_out import HeldOutEvaluation
from trainers.learn import DONE, MISTAKE
from trainers.runfile.settings import RunSettings
from trainers.saving.checkpoint import Checkpoints
from trainers.session import Session

Learn = Callable[..., Any]
WriteRun = Callable[..., Path]
EVERY_32 = {"interval": 32, "episodes": 4}  # a collection has 16 steps


def status(learned: Any) -> Mapping[str, Any]:
    (path,) = learned.results.glob("*/status.json")
    said: Mapping[str, Any] = json.loads(path.read_text())
    return said


def points(learned: Any, tag: str) -> dict[int, float]:
    (folder,) = learned.results.glob("*")
    events = EventAccumulator(str(folder)).Reload()
    return {event.step: event.value for event in events.Scalars(tag)}


def scores(learned: Any) -> dict[int, float | None]:
    (folder,) = learned.results.glob("*/checkpoints")
    return {entry.step: entry.score for entry in Checkpoints(folder, 9).list_checkpoints()}


def test_it_is_evaluated_at_the_start_at_each_interval_and_at_the_end(
    learn: Learn, write_run: WriteRun
) -> None:
    learned = learn(write_run("target", {"max_steps": 80}, evaluation=EVERY_32))
    assert learned.code == DONE, learned.errors
    rewards = points(learned, "Evaluation/Reward")
    assert list(rewards) == [0, 32, 64, 80]
    said = status(learned)["evaluation"]
    assert said["step"] == 80
    assert said["episodes"] == 4
    assert said["reward"] == pytest.approx(rewards[80])


def test_each_evaluated_policy_is_saved_with_its_own_score(
    learn: Learn, write_run: WriteRun
) -> None:
    trainer = {"max_steps": 80, "checkpoint_interval": 16, "keep_checkpoints": 9}
    learned = learn(write_run("target", trainer, evaluation=EVERY_32))
    found, successes = scores(learned), points(learned, "Evaluation/Success")
    assert list(found) == [16, 32, 48, 64, 80]
    assert found[16] is None
    assert found[48] is None
    for step in (32, 64, 80):
        assert found[step] == pytest.approx(successes[step])


def test_training_is_not_touched_by_it(learn: Learn, write_run: WriteRun) -> None:
    weights = []
    for name, evaluation in (("with", EVERY_32), ("without", None)):
        learned = learn(write_run("target", evaluation=evaluation), "--run-id", name)
        path = learned.results / name / "checkpoints"
        weights.append(Checkpoints(path, 9).load_latest().weights)
    for name, tensor in weights[0].items():
        assert tensor.equal(weights[1][name]), name


def test_a_run_ends_at_its_target(learn: Learn, write_run: WriteRun) -> None:
    target = {"metric": "reward", "at_least": -1e9}
    learned = learn(write_run("target", evaluation={**EVERY_32, "stop_when": target}))
    assert learned.code == DONE
    said = status(learned)
    assert (said["state"], said["step"]) == ("finished", 32)
    assert said["reason"].startswith("evaluation.stop_when: reward is ")


@pytest.mark.parametrize(
    ("evaluation", "message"),
    [
        ({"interval": 15}, "evaluation.interval: 15 is under the 16 steps"),
        (
            {**EVERY_32, "stop_when": {"metric": "sucess", "at_least": 1}},
            "evaluation.stop_when.metric: 'sucess' is not among the figures of this environment's "
            "evaluation; did you mean 'success'?",
        ),
        ({**EVERY_32, "episodes": 0}, "evaluation.episodes"),
    ],
)
def test_what_can_not_be_is_refused_before_anything_is_written(
    learn: Learn, write_run: WriteRun, evaluation: Any, message: str
) -> None:
    learned = learn(write_run("target", evaluation=evaluation))
    assert learned.code == MISTAKE
    assert message in learned.errors
    assert not list(learned.results.glob("*"))


def test_its_environments_are_no_more_than_its_episodes_and_have_the_last_lesson(
    make_run: Callable[..., RunSettings], registries: Any
) -> None:
    lessons = [{"threshold": 9.0, "parameters": {"scale": 2.0}}, {"parameters": {"scale": 7.0}}]
    curriculum = {"type": "lessons", "measure": "reward", "lessons": lessons}
    run = make_run("target", curriculum=curriculum, evaluation={"interval": 16, "episodes": 3})
    session = Session(run, registries)
    assert run.evaluation is not None
    held_out = HeldOutEvaluation(session, run, run.evaluation, 0)
    env: Any = held_out._env
    assert env.num_envs == 3
    assert env.parameters == {"scale": 7.0}
    held_out.close()
