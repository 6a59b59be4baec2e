"""The table of what a policy bears."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks import robustness
from envs.grasp.sensors.structured_light import StructuredLight
from envs.grasp.settings import Camera, GraspSettings
from trainers.common.command import DONE, MISTAKE
from trainers.evaluation import Evaluation
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import load_run

RUN_FILE = Path(__file__).parents[2] / "config" / "run.yaml"
FAULTS = robustness.load_faults()


def report(success: float) -> dict[str, Any]:
    return {
        "first_action_success": success,
        "position_error_m": {"median": 0.0024, "p95": 0.006, "x": 0.0},
        "yaw_error_deg": {"median": 0.234, "p95": 0.8},
        "sure": 0.8,
        "sure_right": 0.995,
    }


def camera(fault: robustness.Fault) -> Camera:
    run = load_run(RUN_FILE, fault.of_cameras(["depth"]), load_registries())
    assert isinstance(run.environment.settings, GraspSettings)
    return run.environment.settings.cameras["depth"]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.text}-{fault.strength}")
def test_every_fault_is_one_that_the_run_file_knows(fault: robustness.Fault) -> None:
    camera(fault)


def test_a_fault_alone_leaves_every_other_one_out() -> None:
    faultless = robustness.yaml.safe_load(robustness.FAULTS_FILE.read_text())["faultless"]
    clean, usual = StructuredLight.model_validate(faultless), StructuredLight()
    # Whatever is a fault by default is none here, but for what only says how a fault looks.
    shape = {"type", "strength", "baseline_m", "window_px", "blob_px", "dark_missing"}
    same = {name for name, value in usual if getattr(clean, name) == value}
    assert same == shape
    alone = camera(next(f for f in FAULTS if f.text == "ragged edges" and f.strength == "usual"))
    assert isinstance(alone.sensor, StructuredLight)
    changed = {name for name, value in clean if getattr(alone.sensor, name) != value}
    assert changed == {"jitter_px", "min_support"}
    assert alone.sensor.jitter_px == usual.jitter_px


def test_there_is_a_row_for_each_fault_and_simulator_on_the_same_scenes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    asked: list[tuple[Any, ...]] = []

    def evaluate(policy: str, *, episodes: int, seed: int, overrides: list[str], **_: Any) -> Any:
        asked.append((policy, episodes, seed, overrides[-1]))
        return Evaluation(report(0.9), {})

    monkeypatch.setattr(robustness, "evaluate", evaluate)
    page = tmp_path / "card.md"
    page.write_text("<!-- robustness -->\n<!-- end of robustness -->\n")
    arguments = ["policies/grasp", "--episodes", "7", "--seed", "3", "--page", str(page)]
    assert robustness.main([*arguments, "--simulators", "fast", "pybullet"]) == DONE
    assert {(policy, *rest) for policy, *rest, _ in asked} == {("policies/grasp", 7, 3)}
    assert len(asked) == 2 * len(FAULTS)
    assert [last for *_, last in asked[:2]] == [
        "environment.simulator=fast",
        "environment.simulator=pybullet",
    ]
    rows = page.read_text().splitlines()[3:-1]
    assert len(rows) == 2 * len(FAULTS)
    assert rows[0] == "| as trained |  | fast | 90.0% | 2.4 / 6.0 | 0.23 / 0.80 | 80.0% | 99.5% |"
    assert re.search(r"│ half +│ fast +│ +90.0%", capsys.readouterr().out)


def test_the_picture_has_a_bar_for_each_strength(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "bars.png"
    robustness.plot([(fault, "fast", report(0.5)) for fault in FAULTS], path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_policy_without_first_actions_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    other = load_run(RUN_FILE.parent / "gymnasium" / "cartpole_ppo.yaml", [], load_registries())
    monkeypatch.setattr(robustness, "find_run", lambda *_: (Path(), other))
    assert robustness.main(["some/run"]) == MISTAKE
    assert "environment: {type: grasp}" in capsys.readouterr().err


def test_a_policy_that_is_not_there_is_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    assert robustness.main(["no/such/run", "--episodes", "1"]) == MISTAKE
    assert "no/such/run" in capsys.readouterr().err


def test_a_policy_that_is_never_sure_has_nothing_right_among_it() -> None:
    fault, never = FAULTS[0], report(0.9) | {"sure": 0.0}
    del never["sure_right"]
    assert robustness.row(fault, "fast", never)[-2:] == ["0.0%", ""]
    del never["sure"]
    assert robustness.row(fault, "fast", never)[-2:] == ["", ""]
