"""Runs of what ML-Agents' configurations are converted to, in environments that stand in."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium.spaces import Box, Discrete

from trainers.convert.conversion import convert
from trainers.runfile.registry import Registries
from trainers.saving.checkpoint import Checkpoints, Loaded

Learn = Callable[..., Any]
EPISODE_STEPS = 10
JUMP = "ventosa_tests/Jump-v0"
LOW, HIGH = (
    {"sampler_type": "uniform", "sampler_parameters": {"min_value": low, "max_value": low + 2.0}}
    for low in (0.0, 4.0)
)


class Jump(gymnasium.Env[Any, Any]):
    """A wall of some height in every episode; nothing that is done there matters."""

    observation_space = Box(-10.0, 10.0, (2,), np.float32)
    action_space = Discrete(2)
    parameter_names = ("wall_height",)
    wall_height = -1.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = EPISODE_STEPS
        return self._observation(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        return self._observation(), self.wall_height, self.left == 0, False, {}

    def _observation(self) -> Any:
        return np.array([self.wall_height, self.left], np.float32)


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gymnasium.register(JUMP, entry_point=Jump)
    yield
    del gymnasium.registry[JUMP]


def behavior(**network: Any) -> dict[str, Any]:
    return {
        "trainer_type": "ppo",
        "hyperparameters": {
            "batch_size": 32,
            "buffer_size": 128,
            "learning_rate": 3e-4,
            "beta": 1e-3,
            "epsilon": 0.2,
            "lambd": 0.95,
            "num_epoch": 1,
            "learning_rate_schedule": "constant",
            "beta_schedule": "constant",
            "epsilon_schedule": "constant",
        },
        "network_settings": {"hidden_units": 8, "num_layers": 1, **network},
        "reward_signals": {"extrinsic": {"gamma": 0.99, "strength": 1.0}},
        "max_steps": 512,
        "time_horizon": 64,
        "summary_freq": 128,
        "threaded": True,
    }


def lessons(measure: str, *thresholds: float) -> dict[str, Any]:
    return {
        "wall_height": {
            "curriculum": [
                {
                    "name": f"below {threshold}",
                    "value": LOW,
                    "completion_criteria": {
                        "behavior": "A",
                        "measure": measure,
                        "threshold": threshold,
                        "min_lesson_length": 5,
                    },
                }
                for threshold in thresholds
            ]
            + [{"name": "high", "value": HIGH}]
        }
    }


@pytest.fixture
def converted(tmp_path: Path, registries: Registries) -> Callable[..., Path]:
    def write(env_id: str, own: dict[str, Any], **rest: Any) -> Path:
        source, path = tmp_path / "ours.yaml", tmp_path / "run.yaml"
        source.write_text(yaml.safe_dump({"behaviors": {"A": own}, **rest}))
        path.write_text(convert(source, None, env_id, registries))
        return path

    return write


def latest(results: Path, run_id: str) -> Loaded:
    return Checkpoints(results / run_id / "checkpoints", keep=9).load_latest()


@pytest.mark.parametrize(
    ("env_id", "network", "rest"),
    [
        ("Pendulum-v1", {"normalize": True}, {}),
        ("CartPole-v1", {"memory": {"sequence_length": 8, "memory_size": 16}}, {}),
        (JUMP, {}, {"environment_parameters": lessons("progress", 0.2, 0.5)}),
    ],
    ids=["ball", "hallway", "wall"],
)
def test_a_converted_file_trains(
    learn: Learn,
    converted: Callable[..., Path],
    env_id: str,
    network: dict[str, Any],
    rest: dict[str, Any],
) -> None:
    done = learn(converted(env_id, behavior(**network), env_settings={"num_envs": 4}, **rest))
    assert done.code == 0, done.errors
    status = json.loads((done.results / "run/status.json").read_text())
    assert (status["state"], status["step"]) == ("finished", 512)
    if rest:
        # Lessons begin after the updates at 128 and 384 of 512 steps: over 0.2 and over 0.5.
        assert [line for line in done.output.splitlines() if "begins" in line] == [
            "step 128: lesson 2 of 3 (below 0.5) begins",
            "step 384: lesson 3 of 3 (high) begins",
        ]


def test_a_run_with_lessons_goes_on_exactly(learn: Learn, converted: Callable[..., Path]) -> None:
    config = converted(
        JUMP,
        behavior(),
        env_settings={"num_envs": 4},
        # The walls are some 1 m high, and all of an episode's ten steps are rewarded by it.
        environment_parameters=lessons("reward", 5.0),
    )
    assert learn(config, "--run-id", "whole").code == 0
    halves = learn(config, "trainer.max_steps=128", "--run-id", "halves")
    assert "lesson 2 of 2 (high) begins" in halves.output
    assert learn(config, "--run-id", "halves", "--resume").code == 0
    whole, half = (latest(halves.results, run_id) for run_id in ("whole", "halves"))
    assert whole.step == half.step == 512
    for name in ("weights.safetensors", "state.safetensors", "state.json"):
        assert (half.path / name).read_bytes() == (whole.path / name).read_bytes(), name
