"""what a run of `benchmarks.speed` found, and where."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from benchmarks.speed.figures import Figure, Growth
from benchmarks.speed.processes import Footprint

PACKAGES = ("torch", "numpy", "numba", "pybullet", "stable-baselines3")
CPUINFO = Path("/proc/cpuinfo")


@dataclass
class Report:
    """What a run found, for JSON.

    Attributes:
        machine: where.
        figures: all speeds.
        growth: of the cost of a step with the number of environments.
        parameters: of the networks of the training loops, by the size of the images.
        memory: peak resident sets.
        start_s: from the start of `trainers.learn` to its first step.
    """

    machine: dict[str, Any]
    figures: list[Figure] = field(default_factory=list)
    growth: list[Growth] = field(default_factory=list)
    parameters: dict[int, int] = field(default_factory=dict)
    memory: list[Footprint] = field(default_factory=list)
    start_s: float | None = None

    def plain(self) -> dict[str, Any]:
        """As JSON takes it."""
        return {
            **vars(self),
            "figures": [figure.plain() for figure in self.figures],
            "growth": [asdict(one) for one in self.growth],
            "memory": [asdict(one) for one in self.memory],
        }


def machine() -> dict[str, Any]:
    """Where the figures come from."""
    there = {dist.name.lower().replace("_", "-") for dist in importlib.metadata.distributions()}
    return {
        "cores": len(os.sched_getaffinity(0)),
        "processor": _processor(),
        "python": platform.python_version(),
        "torch_threads": torch.get_num_threads(),
        "packages": {name: importlib.metadata.version(name) for name in PACKAGES if name in there},
    }


def _processor() -> str:
    lines = CPUINFO.read_text().splitlines() if CPUINFO.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
