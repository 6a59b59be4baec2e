"""The table of what a policy bears."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks import robustness
from envs.grasp.vector_env import GraspVectorEnv
from trainers.evaluation import Evaluation
from trainers.learn import DONE, MISTAKE
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import load_run

RUN_FILE = Path(__file__).parents[2] / "config" / "run.yaml"


def report(success: float) -> dict[str, Any]:
    return {
        "first_action_success": success,
        "position_error_m": {"median": 0.0024, "p95": 0.006, "x": 0.0},
        "yaw_error_deg": {"median": 0.234, "p95": 0.8},
    }


@pytest.mark.parametrize("fault", robustness.FAULTS, ids=lambda fault: fault.text)
def test_every_fault_is_one_that_the_environment_knows(fault: robustness.Fault) -> None:
    assert set(fault.parameters) <= GraspVectorEnv.parameter_names
    run = load_run(RUN_FILE, fault.overrides(), load_registries())
    assert run.environment_parameters == fault.parameters


def test_there_is_a_row_for_each_fault_on_the_same_scenes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[Any, ...]] = []

    def evaluate(policy: str, *, episodes: int, seed: int, overrides: list[str], **_: Any) -> Any:
        asked.append((policy, episodes, seed, tuple(overrides)))
        return Evaluation(report(1.0 - 0.1 * len(overrides)), {})

    monkeypatch.setattr(robustness, "evaluate", evaluate)
    assert robustness.main(["some/run", "--episodes", "7", "--seed", "3"]) == DONE
    assert {(policy, episodes, seed) for policy, episodes, seed, _ in asked} == {("some/run", 7, 3)}
    assert [overrides for *_, overrides in asked] == [
        tuple(fault.overrides()) for fault in robustness.FAULTS
    ]
    rows = [line for line in capsys.readouterr().out.splitlines() if "/" in line and "%" in line]
    assert len(rows) == len(robustness.FAULTS)
    assert re.search(r"as trained +│ 100.0% +│ 2.4 / 6.0 +│ 0.23 / 0.80", rows[0])
    assert re.search(r"1.0% of the pixels missing +│ 90.0%", rows[2])


def test_a_policy_without_first_actions_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(robustness, "evaluate", lambda *_, **__: Evaluation({"reward": 1.0}, {}))
    assert robustness.main(["some/run"]) == MISTAKE
    assert "environment: {type: grasp}" in capsys.readouterr().err


def test_a_policy_that_is_not_there_is_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    assert robustness.main(["no/such/run", "--episodes", "1"]) == MISTAKE
    assert "no/such/run" in capsys.readouterr().err
