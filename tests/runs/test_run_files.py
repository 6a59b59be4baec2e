"""The run files that ventosa brings along."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import pytest

from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run
from trainers.session import Session

CONFIG = Path(__file__).parents[2] / "config"
FILES = sorted({*CONFIG.rglob("*.yaml")} - {*CONFIG.glob("sweeps/*.yaml")})
GYMNASIUM = sorted(CONFIG.glob("gymnasium/*.yaml"))


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
