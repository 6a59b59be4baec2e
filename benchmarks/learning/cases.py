"""What is learned, by whom, and for how long."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarks.command import ROOT

RUN_FILES = ROOT / "config" / "gymnasium"
PLUGINS = {"sac": Path("examples/ventosa-sac-plugin")}
"""Algorithms that are packages of their own, with run files for each task."""
OURS, PEER = "ventosa", "peer"
SIDES = (OURS, PEER)
PEER_NAMES = {
    "ppo": "Stable-Baselines3 PPO",
    "trpo": "sb3-contrib TRPO",
    "ddpg": "Stable-Baselines3 DDPG",
    "sac": "Stable-Baselines3 SAC",
}


@dataclass(frozen=True)
class Case:
    """An algorithm on a task, for both sides."""

    algorithm: str
    task: str
    """As the run files call it."""
    steps: int
    seeds: int = 10
    """As many runs on each side, with the seeds from 0."""

    @property
    def name(self) -> str:
        """Both, in names of files."""
        return f"{self.task}_{self.algorithm}"

    @property
    def run_file(self) -> Path:
        """Where the hyper-parameters are, for both sides."""
        if self.algorithm in PLUGINS:
            return ROOT / PLUGINS[self.algorithm] / "config" / f"{self.task}.yaml"
        return RUN_FILES / f"{self.name}.yaml"


# Fewer steps than the run files have, where two cores would need days for all the seeds; and fewer
# seeds off-policy, where a step is ten times as dear.
CASES = (
    Case("ppo", "pendulum", 100_000),
    Case("ppo", "half_cheetah", 100_000),
    Case("ppo", "hopper", 100_000),
    Case("trpo", "pendulum", 100_000),
    Case("trpo", "half_cheetah", 100_000),
    Case("trpo", "hopper", 100_000),
    Case("ddpg", "pendulum", 20_000, seeds=5),
    Case("ddpg", "half_cheetah", 30_000, seeds=5),
    Case("ddpg", "hopper", 30_000, seeds=5),
    Case("sac", "pendulum", 20_000, seeds=3),
    Case("sac", "hopper", 100_000, seeds=3),
)
LONG_CASES = (
    Case("ppo", "half_cheetah", 1_000_000, seeds=3),
    Case("ppo", "hopper", 1_000_000, seeds=3),
    Case("ppo", "walker2d", 300_000, seeds=5),
    Case("trpo", "half_cheetah", 1_000_000, seeds=3),
    Case("trpo", "hopper", 1_000_000, seeds=3),
    Case("trpo", "walker2d", 300_000, seeds=5),
)
"""As long as these tasks are usually trained, with fewer seeds."""


@dataclass(frozen=True)
class Entry:
    """One run of one side in a case."""

    case: Case
    side: str
    seed: int

    @property
    def name(self) -> str:
        """Of its file of results."""
        return f"{self.case.name}-{self.case.steps}-{self.side}-{self.seed}"
