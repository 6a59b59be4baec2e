"""What tests of installed packages share."""

from __future__ import annotations

import sysconfig
import venv
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def borrowing_venv() -> Callable[[Path], Path]:
    """Makes a virtual environment that borrows all packages from this one: its scripts' folder."""

    def make(home: Path) -> Path:
        venv.create(home)
        paths = {"base": str(home), "platbase": str(home)}
        borrowed = Path(sysconfig.get_path("purelib", "venv", vars=paths)) / "borrowed.pth"
        ours = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
        borrowed.write_text("\n".join(ours))
        return Path(sysconfig.get_path("scripts", "venv", vars=paths))

    return make
