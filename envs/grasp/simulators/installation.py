"""PyBullet need not be installed: `simulator: fast` does without it."""

from __future__ import annotations

import importlib.util


def has_pybullet() -> bool:
    """Whether PyBullet is installed."""
    return importlib.util.find_spec("pybullet") is not None


def require_pybullet(asked: str) -> None:
    """Refuses what can't be done without PyBullet.

    Args:
        asked: what it is, as the user writes it.

    Raises:
        ValueError: PyBullet is not installed; the message has the way out.
    """
    if not has_pybullet():
        raise ValueError(
            f"{asked} needs PyBullet, which is not installed: pip install 'ventosa[pybullet]', "
            "which needs a C++ compiler where there is no wheel, as from Python 3.12 on; "
            "simulator: fast does without it"
        )
