"""Whether a run file is still that of the run that was begun."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from trainers.runfile.changes import changeable, changes
from trainers.runfile.settings import RunSettings

EVALUATION = {"interval": 32, "episodes": 8}
LESSONS = {
    "type": "lessons",
    "measure": "reward",
    "lessons": [{"threshold": -1.0, "parameters": {"scale": 2.0}}, {"parameters": {"scale": 1.0}}],
}


def told(make_run: Callable[..., RunSettings], *changed: Any, **rest: Any) -> list[str]:
    begun = make_run("target", {"max_steps": 64}, evaluation=EVALUATION, curriculum=LESSONS)
    sections = {"evaluation": EVALUATION, "curriculum": LESSONS, **rest}
    return changes(begun, make_run(*(changed or ("target", {"max_steps": 64})), **sections))


def test_how_long_it_runs_and_what_it_reports_may_change(
    make_run: Callable[..., RunSettings],
) -> None:
    trainer = {
        "max_steps": 96,
        "summary_freq": 7,
        "checkpoint_interval": 9,
        "keep_checkpoints": 2,
    }
    stop_when = {"metric": "reward", "at_least": 0.0}
    evaluation = {**EVALUATION, "interval": 99, "stop_when": stop_when}
    rest = {"evaluation": evaluation, "device": "cuda"}
    assert told(make_run, "target", trainer, **rest) == []
    other = [{"type": "tensorboard"}, {"type": "mlflow", "experiment": "other"}]
    assert told(make_run, "target", trainer, **rest, loggers=other) == []
    assert told(make_run, "target", trainer, **rest, loggers=[]) == []


@pytest.mark.parametrize(
    ("changed", "rest", "lines"),
    [
        (
            ({"type": "target", "num_envs": 2}, {"hyperparameters": {"gamma": 0.5}}),
            {},
            [
                "environment.num_envs: 4 then, 2 now",
                "trainer.hyperparameters.gamma: 0.99 then, 0.5 now",
            ],
        ),
        (("darts",), {}, ["environment.type: 'target' then, 'darts' now"]),
        (
            ("target", {"trainer_type": "trpo"}),
            {},
            ["trainer.trainer_type: 'ppo' then, 'trpo' now"],
        ),
        ((), {"seed": 5}, ["seed: 0 then, 5 now"]),
        ((), {"evaluation": {**EVALUATION, "episodes": 9}}, ["evaluation.episodes: 8 then, 9 now"]),
        (
            (),
            {"curriculum": {**LESSONS, "lessons": LESSONS["lessons"][1:]}},  # type: ignore[index]
            ["curriculum.lessons: "],
        ),
        (
            (),
            {"environment_parameters": {"shift": 1.0}},
            ["environment_parameters.shift: null then, 1.0 now"],
        ),
    ],
)
def test_what_it_learns_may_not(
    make_run: Callable[..., RunSettings],
    changed: tuple[Any, ...],
    rest: dict[str, Any],
    lines: list[str],
) -> None:
    found = told(make_run, *changed, **rest)
    assert [line[: len(start)] for line, start in zip(found, lines, strict=True)] == lines


def test_of_a_list_of_sections_the_innermost_value_is_named(
    make_run: Callable[..., RunSettings],
) -> None:
    first, last = LESSONS["lessons"]  # type: ignore[misc]
    lessons = {**LESSONS, "lessons": [{**first, "threshold": -2.0}, last]}  # type: ignore[dict-item]
    found = told(make_run, curriculum=lessons)
    assert found == ["curriculum.lessons.0.threshold: -1.0 then, -2.0 now"]


def test_settings_say_which_of_theirs_may_change(make_run: Callable[..., RunSettings]) -> None:
    trainer = {f"trainer.{key}" for key in ("max_steps", "summary_freq", "checkpoint_interval")}
    expected = {"device", "loggers", "trainer.keep_checkpoints"} | trainer
    assert changeable(make_run("target")) == expected
    assert changeable(make_run("target", evaluation=EVALUATION)) == expected | {
        "evaluation.interval",
        "evaluation.stop_when",
    }
    assert "environment.workers" in changeable(
        make_run({"type": "grasp"}, rewards=[{"type": "touch"}])
    )
