"""Evaluation while a run learns, and what is chosen and ended by it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import BaseModel
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor, nn

from trainers.common.command import DONE, MISTAKE
from trainers.common.stopping import StopRequested
from trainers.held_out import HeldOutEvaluation
from trainers.runfile.settings import Component, RunSettings
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


@pytest.fixture
def held_out(
    make_run: Callable[..., RunSettings], registries: Any
) -> Callable[..., HeldOutEvaluation]:
    """Evaluates an untrained policy in darts, where episodes are played with drawn actions."""

    def make(**changes: Any) -> HeldOutEvaluation:
        run = replace(make_run("darts", evaluation=EVERY_32), **changes)
        assert run.evaluation is not None
        return HeldOutEvaluation(Session(run, registries), run, run.evaluation, 0)

    return make


def test_equal_weights_have_equal_reports_though_actions_are_drawn(
    held_out: Callable[..., HeldOutEvaluation],
) -> None:
    with closing(held_out()) as evaluation:
        first = evaluation.latest
        evaluation._evaluate(0)
        assert evaluation.latest == first
        assert evaluation.latest is not first


class Forgetful(nn.Module):
    """An encoder whose features are dropped at random while it learns; one part never learns."""

    class Settings(BaseModel, frozen=True, extra="forbid"):
        pass

    def __init__(self, space: Any, settings: Settings):
        super().__init__()
        self.features_dim = space.shape[0]
        self.dropout, self.frozen = nn.Dropout(0.5), nn.Dropout(0.5).eval()

    def forward(self, values: Tensor) -> Tensor:
        kept: Tensor = self.frozen(self.dropout(values))
        return kept


def test_nothing_is_dropped_while_a_policy_is_evaluated(
    held_out: Callable[..., HeldOutEvaluation],
) -> None:
    encoder = Component("vector", Forgetful, Forgetful.Settings())
    with closing(held_out(encoders={"goal": encoder})) as evaluation:
        random_state, first = torch.get_rng_state(), evaluation.latest
        evaluation._evaluate(0)
        assert evaluation.latest == first
        assert torch.equal(torch.get_rng_state(), random_state)
        network = evaluation._network
        modes = {type(m): m.training for m in network.modules() if not isinstance(m, nn.Dropout)}
        assert all(modes.values())
        (encoding,) = (m for m in network.modules() if isinstance(m, Forgetful))
        assert (encoding.dropout.training, encoding.frozen.training) == (True, False)


def test_training_is_not_touched_by_it(learn: Learn, write_run: WriteRun) -> None:
    weights = []
    for name, evaluation in (("with", EVERY_32), ("without", None)):
        learned = learn(write_run("target", evaluation=evaluation), "--run-id", name)
        path = learned.results / name / "checkpoints"
        weights.append(Checkpoints(path, 9).load_latest().weights)
    for name, tensor in weights[0].items():
        assert tensor.equal(weights[1][name]), name


@pytest.mark.parametrize("stopped", ["at 48", "while it is evaluated at 64"])
def test_a_resumed_run_has_the_points_of_an_uninterrupted_one(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch, stopped: str
) -> None:
    constant = {"learning_rate_schedule": "constant", "beta_schedule": "constant"}
    trainer = {"max_steps": 96, "hyperparameters": constant}
    file = write_run("darts", trainer, evaluation=EVERY_32)
    whole = learn(file, results_dir=file.parent / "whole")
    if stopped == "at 48":
        learn(file, "trainer.max_steps=48")
    else:
        evaluate = HeldOutEvaluation.evaluate

        def stop(self: HeldOutEvaluation, step: int, log: Any) -> None:
            if step == 64:
                raise StopRequested
            evaluate(self, step, log)

        with monkeypatch.context() as patch:
            patch.setattr(HeldOutEvaluation, "evaluate", stop)
            learn(file)
    learned = learn(file, "--resume")
    assert learned.code == DONE, learned.errors
    for name in ("Reward", "First Action Success", "Distance M P95"):
        tag = f"Evaluation/{name}"
        found = points(learned, tag)
        found.pop(48, None)  # the end of the shorter run was evaluated, too
        assert found == points(whole, tag)
        assert sorted(found) == [0, 32, 64, 96]


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
