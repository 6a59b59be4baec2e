"""Values of the command line that make a part another one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run, resolved
from trainers.runfile.yaml_document import SettingsError

CONFIG = Path(__file__).parents[3] / "config"


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    said: list[str] = []
    monkeypatch.setattr("trainers.runfile.overrides.tell", said.append)
    return said


def load(registries: Registries, *overrides: str, config: str = "run.yaml") -> dict[str, Any]:
    return resolved(load_run(CONFIG / config, overrides, registries))


def with_conv(folder: Path, more: str = "") -> Path:
    """A run file with an encoder `conv`, and more of its settings."""
    config = folder / "own.yaml"
    config.write_text(
        f"extends: {CONFIG / 'gymnasium/cartpole_ppo.yaml'}\n"
        f"encoders: {{eye: {{type: conv, layers: [[8, 8, 4]]{more}}}}}\n"
    )
    return config


def test_another_encoder_has_none_of_the_old_one_s_keys(
    registries: Registries, told: list[str], tmp_path: Path
) -> None:
    config = with_conv(tmp_path, ", activation: relu")
    run = resolved(load_run(config, ["encoders.eye.type=simple"], registries))
    assert run["encoders"]["eye"]["type"] == "simple"
    assert told == [
        "command line 'encoders.eye.type=simple': encoders.eye: simple has none of layers, "
        "activation: left out"
    ]


@pytest.mark.parametrize("trainer", ["ddpg", "trpo"])
def test_another_trainer_has_none_of_the_old_one_s_keys_at_any_depth(
    registries: Registries, told: list[str], trainer: str
) -> None:
    run = load(
        registries,
        f"trainer.trainer_type={trainer}",
        "trainer.network_settings.activation=elu",
        config="gymnasium/pendulum_ppo.yaml",
    )["trainer"]
    assert run["trainer_type"] == trainer
    assert run["max_steps"] == 100_000
    assert run["hyperparameters"]["gamma"] == 0.9
    assert run["network_settings"]["activation"] == "elu"
    (line,) = told
    assert "hyperparameters.epsilon" in line
    assert "gamma" not in line


def test_a_part_within_a_component(registries: Registries, told: list[str]) -> None:
    key = "environment.cameras.depth.sensor.type=gaussian"
    cameras = load(registries, key, config="structured_light.yaml")["environment"]["cameras"]
    assert cameras["depth"]["sensor"]["type"] == "gaussian"
    assert cameras["depth"]["width"] == 640
    assert told == [
        f"command line '{key}': environment.cameras.depth.sensor: gaussian has none of strength: "
        "left out"
    ]


def test_what_the_command_line_says_itself_is_not_left_out(
    registries: Registries, told: list[str], tmp_path: Path
) -> None:
    config = with_conv(tmp_path)
    given = ["encoders.eye.channels=3", "encoders.eye.type=simple"]
    with pytest.raises(SettingsError, match=r"encoders\.eye\.channels: unknown key"):
        load_run(config, given, registries)
    assert len(told) == 1


@pytest.mark.parametrize(
    "override", ["encoders.depth.type=kepoints", "encoders.depth.type=3", "trainer.type=ddpg"]
)
def test_of_what_is_no_type_nothing_is_left_out(
    registries: Registries, told: list[str], override: str
) -> None:
    with pytest.raises(SettingsError):
        load(registries, override)
    assert not told


def test_the_same_type_again_changes_nothing(registries: Registries, told: list[str]) -> None:
    assert load(registries, "trainer.trainer_type=ddpg") == load(registries)
    assert not told
