"""The run files that ventosa brings along."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run
from trainers.session import Session

CONFIG = Path(__file__).parents[2] / "config"
FILES = sorted({*CONFIG.rglob("*.yaml")} - {*CONFIG.glob("sweeps/*.yaml")})
GYMNASIUM = sorted(CONFIG.glob("gymnasium/*.yaml"))
PAPER = sorted(CONFIG.glob("paper/*.yaml"))
EXPERIMENTS = {
    *("sparse", "two_cameras", "frame_grab", "stream", "curriculum", "lstm", "trpo", "ddpg"),
    *("size_32", "size_80", "size_128", "size_256", "batch_32", "point_cloud"),
}
ON_POLICY = {"buffer_size": 20, "batch_size": 10, "num_epoch": 1}
TINY = {
    "ppo": ON_POLICY,
    "trpo": {**ON_POLICY, "fisher_fraction": 1.0, "cg_iterations": 2},
    "ddpg": {"buffer_size": 100, "batch_size": 4, "buffer_init_steps": 4, "updates_per_step": 0.5},
}


def name(path: Path) -> str:
    return str(path.relative_to(CONFIG))


@pytest.mark.parametrize("path", FILES, ids=name)
def test_it_is_valid(path: Path, registries: Registries) -> None:
    load_run(path, [], registries)


@pytest.mark.parametrize("path", GYMNASIUM, ids=name)
def test_its_parts_fit_each_other(path: Path, registries: Registries) -> None:
    run = load_run(path, [], registries)
    try:
        gymnasium.make(run.environment.settings.id).close()  # type: ignore[attr-defined]
    except gymnasium.error.DependencyNotInstalled as missing:
        pytest.skip(str(missing))
    Session(run, registries).close()


def test_every_experiment_of_the_paper_is_there() -> None:
    assert {path.stem for path in PAPER} == EXPERIMENTS


@pytest.mark.parametrize("path", PAPER, ids=name)
def test_an_experiment_of_the_paper_learns(
    path: Path, registries: Registries, caplog: pytest.LogCaptureFixture
) -> None:
    tiny = TINY[load_run(path, [], registries).trainer.name]
    overrides = [f"trainer.hyperparameters.{key}={value}" for key, value in tiny.items()]
    run = load_run(path, ["environment.num_envs=2", *overrides], registries)
    session = Session(run, registries)
    try:
        session.reset()
        before = {key: weights.clone() for key, weights in session.weights().items()}
        for run_fraction in (0.0, 0.5):
            session.algorithm.collect()
            statistics = session.algorithm.update(run_fraction)
            assert np.isfinite(list(statistics.values())).all()
        after = session.weights()
        learned = {key for key in before if not torch.equal(before[key], after[key])}
        assert any("frame_encoders" in key for key in learned)
        assert not caplog.records
    finally:
        session.close()
