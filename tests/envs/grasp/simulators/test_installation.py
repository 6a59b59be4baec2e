"""Without PyBullet, as on Python 3.12: what needs it says so, and the rest does without."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from envs.grasp.evaluation.evaluator import GraspEvaluator
from envs.grasp.evaluation.report import GraspReport
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.urdf import load_robot
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.factory import make_simulator
from envs.grasp.simulators.fast import FastSimulator
from envs.grasp.simulators.installation import has_pybullet

WAY_OUT = (
    "needs PyBullet, which is not installed: pip install 'ventosa[pybullet]', which needs a C++ "
    "compiler where there is no wheel, as from Python 3.12 on; simulator: fast does without it"
)
ROBOT = load_robot()


@pytest.fixture
def without_pybullet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)  # so an import of it fails
    assert not has_pybullet()


@pytest.mark.usefixtures("without_pybullet")
def test_a_simulator_of_pybullet_is_refused() -> None:
    with pytest.raises(ValueError, match="PyBullet") as refused:
        make_simulator(GraspSettings(simulator="pybullet"), ROBOT, 1)
    assert str(refused.value) == f"simulator: pybullet {WAY_OUT}"
    fast = make_simulator(GraspSettings(simulator="fast", workers=0), ROBOT, 1)
    assert isinstance(fast, FastSimulator)


@pytest.mark.usefixtures("without_pybullet")
@pytest.mark.parametrize(("window", "flag"), [(False, "--pick"), (True, "--window")])
def test_a_pick_is_refused(window: bool, flag: str) -> None:
    settings = GraspSettings()
    evaluator = GraspEvaluator(
        settings, Arm(ROBOT, settings.workspace, standoff_m=0.1), lambda actions: None
    )
    with pytest.raises(ValueError, match="PyBullet") as refused:
        evaluator.physical_check(window=window)
    assert str(refused.value) == f"{flag} {WAY_OUT}"


@pytest.mark.usefixtures("without_pybullet")
def test_pictures_do_without_the_film(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("matplotlib")
    for name in ("contact_sheet", "error_histograms", "workspace"):
        monkeypatch.setattr(f"envs.grasp.evaluation.plots.{name}", lambda *_: b"")
    monkeypatch.setattr("envs.grasp.evaluation.report._concatenate", lambda _: None)
    settings = GraspSettings()
    report = GraspReport(
        settings, Arm(ROBOT, settings.workspace, standoff_m=0.1), lambda actions: None
    )
    with caplog.at_level(logging.WARNING, "ventosa"):
        assert [name for name, _ in report.files()] == list(report.file_names[:-1])
    assert caplog.messages == ["no film.gif: it is made in PyBullet, which is not installed"]


@pytest.mark.usefixtures("without_pybullet")
def test_a_run_that_asks_for_it_is_a_mistake(
    learn: Callable[..., Any], write_run: Callable[..., Path]
) -> None:
    grasp = {"type": "grasp", "simulator": "pybullet", "num_envs": 2}
    done = learn(
        write_run(grasp, rewards=[{"type": "sparse"}], encoders={"depth": {"type": "paper"}})
    )
    assert done.code == 2
    assert done.errors.endswith(f"simulator: pybullet {WAY_OUT}\n")
    assert "Traceback" not in done.errors


def test_the_fast_simulator_imports_nothing_of_it() -> None:
    code = (
        "import sys, envs.grasp.vector_env, envs.grasp.evaluation.report; "
        "print('pybullet' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("False\n", "")
