"""PyBullet is imported without a word."""

from __future__ import annotations

import subprocess
import sys

import pytest

IMPORT = """
from envs.grasp.simulators.bullet import pybullet
print(pybullet.connect(pybullet.DIRECT))
"""


def test_it_is_imported_without_a_word() -> None:
    pytest.importorskip("pybullet")
    done = subprocess.run(
        [sys.executable, "-c", IMPORT], capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("0\n", "")
