"""Sweeps over a small run on CartPole."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trainers.runfile.registry import Registries, load_registries

RUN = """
environment: {type: gymnasium, id: CartPole-v1, num_envs: 2}
trainer:
  trainer_type: ppo
  max_steps: 384
  summary_freq: 128
  hyperparameters: {buffer_size: 64, batch_size: 32, num_epoch: 1}
  network_settings: {hidden_units: 8, num_layers: 1}
evaluation: {interval: 128, episodes: 3}
"""
RATE = "trainer.hyperparameters.learning_rate"
BATCH = "trainer.hyperparameters.batch_size"
SPACE = {RATE: {"log_uniform": [1e-4, 1e-2]}, BATCH: {"choice": [16, 32]}}


@pytest.fixture(scope="session")
def known() -> Registries:
    return load_registries()


@pytest.fixture
def sweep_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a sweep file, of which each key has a line, and the run file that it begins with."""

    def write(**settings: Any) -> Path:
        (tmp_path / "run.yaml").write_text(RUN)
        path = tmp_path / "pole.yaml"
        lines = []
        for key, value in {"run": "run.yaml", "space": SPACE, **settings}.items():
            if isinstance(value, dict) and value:
                lines += [f"{key}:", *(f"  {inner}: {json.dumps(v)}" for inner, v in value.items())]
            else:
                lines += [f"{key}: {json.dumps(value)}"]
        path.write_text("\n".join(lines))
        return path

    return write
