"""Run files and saved policies of before still work; what became of their keys is said."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.grasp.observations import observation_space
from envs.grasp.settings import GraspSettings
from trainers.evaluate import main as evaluate
from trainers.export import main as export
from trainers.inference.policy import Policy
from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run
from trainers.runfile.yaml_document import dump, read
from trainers.session import Session

POLICY = Path(__file__).parents[2] / "policies" / "grasp_gaussian"
PRESENT = ("motion", "standoff_m", "contact_resolution_m")


@pytest.fixture
def former_policy(tmp_path: Path) -> Path:
    """The shipped policy as it was saved before motions had legs, and policies said their spaces.

    What its resolved run file had then is written out in it.
    """
    folder = tmp_path / "former"
    shutil.copytree(POLICY, folder)
    (folder / "policy.json").unlink()
    run = read(folder / "configuration.yaml").data
    environment = {k: v for k, v in run["environment"].items() if k not in PRESENT}
    environment["motion_checks"] = 4
    environment["pick"] = {
        **{k: v for k, v in environment["pick"].items() if k != "approach_s"},
        **{"standoff_m": 0.08, "standoff_s": 0.25},
    }
    run = {**run, "environment": environment}
    run.pop("evaluation", None)
    (folder / "configuration.yaml").write_text(dump(run))
    return folder


def test_its_settings_are_those_of_now(
    former_policy: Path, registries: Registries, caplog: pytest.LogCaptureFixture
) -> None:
    file = former_policy / "configuration.yaml"
    settings = load_run(file, [], registries).environment.settings
    assert isinstance(settings, GraspSettings)
    assert (settings.standoff_m, settings.pick.approach_s) == (0.08, 0.25)
    assert settings.motion == "standoff"
    for key, said in {
        "motion_checks": "passed over: contacts are looked for all along a motion",
        "pick.standoff_m": "read as environment.standoff_m",
        "pick.standoff_s": "read as environment.pick.approach_s",
    }.items():
        (line,) = [text for text in caplog.messages if f"environment.{key}: {said}" in text]
        assert line.startswith(f"{file}:")


def test_critics_of_before_see_the_limits_that_they_were_trained_with() -> None:
    assert observation_space(GraspSettings(privileged=True))["privileged"].shape == (22,)


def test_an_override_of_the_present_name_holds(former_policy: Path, registries: Registries) -> None:
    overrides = ["environment.standoff_m=0.05", "environment.motion_checks=100"]
    run = load_run(former_policy / "configuration.yaml", overrides, registries)
    assert isinstance(run.environment.settings, GraspSettings)
    assert run.environment.settings.standoff_m == 0.05


def test_it_is_evaluated_exported_and_loaded(
    former_policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate([str(former_policy), "--episodes", "4", "environment.workers=0"]) == 0
    exported = tmp_path / "exported"
    assert export([str(former_policy), str(exported)]) == 0
    assert "error" not in capsys.readouterr().err
    policies = [Policy.load(folder) for folder in (POLICY, former_policy, exported)]
    image = policies[0].observation_space["depth"].sample()
    actions = [policy.predict({"depth": image})[0] for policy in policies]
    np.testing.assert_array_equal(actions[1:], [actions[0]] * 2)


def test_a_gaussian_of_before_goes_on_in_the_environments_units(
    learn: Callable[..., Any], write_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    pendulum = {"type": "gymnasium", "id": "Pendulum-v1", "num_envs": 2}
    config = write_run(pendulum, {"max_steps": 128, "network_settings": {"initial_std": 0.5}})
    scaled = Session.weights

    def weights(session: Session) -> dict[str, torch.Tensor]:
        """As they were saved before actions were scaled."""
        names = {"action_model.log_std": "log_std"}
        own = {name: v for name, v in scaled(session).items() if "action_model.scale" not in name}
        return {names.get(name, name): values for name, values in own.items()}

    with monkeypatch.context() as patch:
        patch.setattr(Session, "weights", weights)
        assert learn(config, "--run-id", "before").code == 0
    resumed = learn(config, "--run-id", "before", "--resume", "trainer.max_steps=256")
    assert resumed.code == 0, resumed.errors
    initialized = learn(config, "--initialize-from", resumed.results / "before")
    assert initialized.code == 0, initialized.errors
    assert learn(config, "--run-id", "new").code == 0
    stds = [
        Policy.load(resumed.results / run_id).network.exploration_std()
        for run_id in ("before", "toy", "new")
    ]
    torch.testing.assert_close(
        torch.cat([std for std in stds if std is not None]),
        torch.tensor([0.5, 0.5, 1.0]),
        atol=0.05,
        rtol=0.0,
    )
