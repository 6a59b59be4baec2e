"""Keys and files of ML-Agents and RL-Zoo: the way out is named."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from trainers.runfile.foreign_keys import RL_ZOO
from trainers.runfile.registry import Registries
from trainers.runfile.settings import SettingsError, load_run
from trainers.runfile.validation import models_at

GOOD = "environment: {type: gymnasium, id: CartPole-v1}\ntrainer: {trainer_type: ppo}\n"


def problems(tmp_path: Path, registries: Registries, text: str) -> list[str]:
    path = tmp_path / "run.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError) as raised:
        load_run(path, [], registries)
    return str(raised.value).replace(f"{path}:", "").splitlines()


@pytest.mark.parametrize(
    ("key", "target"),
    [
        ("n_timesteps", "trainer.max_steps"),
        ("n_steps", "trainer.hyperparameters.buffer_size"),
        ("ent_coef", "trainer.hyperparameters.beta"),
        ("clip_range", "trainer.hyperparameters.epsilon"),
        ("vf_coef", "trainer.hyperparameters.value_coefficient"),
        ("n_epochs", "trainer.hyperparameters.num_epoch"),
        ("gae_lambda", "trainer.hyperparameters.lambd"),
        ("max_grad_norm", "trainer.hyperparameters.max_gradient_norm"),
        ("n_envs", "environment.num_envs"),
        ("policy", "trainer.network_settings"),
    ],
)
def test_a_key_of_rl_zoo_is_answered_with_the_right_one(
    tmp_path: Path, registries: Registries, key: str, target: str
) -> None:
    for section in ("", "hyperparameters: "):
        inner = f"{section}{{{key}: 1}}" if section else f"{key}: 1"
        text = GOOD.replace("ppo", f"ppo, {inner}")
        (said,) = problems(tmp_path, registries, text)
        assert "unknown key; RL-Zoo's; in a run file it is " in said
        assert target in said


@pytest.mark.parametrize("said", RL_ZOO.values())
def test_the_keys_that_are_named_are_there(registries: Registries, said: str) -> None:
    models = {
        "environment": [registries.environments.get("gymnasium").settings],
        "trainer": [registries.trainers.get(name).settings for name in ("ppo", "ddpg")],
    }
    for section, dotted in re.findall(r"\b(environment|trainer)\.([\w.]+\w)", said):
        *around, key = dotted.split(".")
        owners = [
            owner for model in models[section] for owner in models_at(model, tuple(around), {})
        ]
        assert any(key in owner.model_fields for owner in owners), dotted


def test_a_file_of_rl_zoo(tmp_path: Path, registries: Registries) -> None:
    text = "CartPole-v1: {n_envs: 8, n_timesteps: 1e5, policy: MlpPolicy, n_steps: 32}\n"
    (said,) = problems(tmp_path, registries, text)
    assert "1: has RL-Zoo's hyper-parameters" in said
    assert "environment: {type: gymnasium, id: CartPole-v1}" in said


def test_a_file_of_ml_agents(tmp_path: Path, registries: Registries) -> None:
    (said,) = problems(tmp_path, registries, "# Ours.\nbehaviors: {Ball: {trainer_type: ppo}}\n")
    assert said.startswith("2: is ML-Agents' trainer configuration")
    assert f"python -m trainers.convert {tmp_path / 'run.yaml'}" in said


def test_a_curriculum_of_a_parameter(tmp_path: Path, registries: Registries) -> None:
    lessons = [{"name": "low", "value": 1.0}]
    parameters = {"environment_parameters": {"wall": {"curriculum": lessons}}}
    (said,) = problems(tmp_path, registries, GOOD + yaml.safe_dump(parameters))
    assert "environment_parameters.wall: a curriculum is a section of its own" in said
    assert "trainers.convert" in said
    assert "sampler_type" not in said


def test_a_list_is_not_too_short_for_its_items_being_wrong(
    tmp_path: Path, registries: Registries
) -> None:
    lessons = "curriculum: {type: lessons, lessons: [{nam: a}, {name: 2}]}\n"
    said = problems(tmp_path, registries, GOOD + lessons)
    assert len(said) == 2
    assert not any("at least 1 item" in line for line in said)
    (empty,) = problems(tmp_path, registries, GOOD + "curriculum: {type: lessons, lessons: []}\n")
    assert "should have at least 1 item" in empty
