"""What the compared training runs have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.speed.figures import FRAME_GRAB, MODES
from envs.grasp.env import DEFAULT_REWARDS
from envs.grasp.settings import Camera

CAMERA = "depth"


@dataclass(frozen=True)
class Setup:
    """A training run: images of one depth camera, the paper's encoder, a trunk, PPO.

    Attributes:
        size: side of the images in pixels; chooses the paper's encoder, too.
        mode: one of `benchmarks.speed.figures.MODES`.
        num_envs: environments stepped together, on the simulator `fast`.
        num_steps: of each environment between two updates.
        batch_size: transitions in one step of gradient descent.
        num_epochs: passes over the buffer in an update.
        learning_rate: of Adam, fused.
        gamma: discount factor.
        lambd: of the advantage estimate.
        epsilon: how far the probability ratio may move.
        beta: weight of the entropy bonus.
        hidden_units: of each layer of the trunk, which actor and critic share.
        num_layers: of the trunk.
    """

    size: int = 80
    mode: str = FRAME_GRAB
    num_envs: int = 256
    num_steps: int = 32
    batch_size: int = 512
    num_epochs: int = 4
    learning_rate: float = 3e-4
    gamma: float = 0.99
    lambd: float = 0.95
    epsilon: float = 0.2
    beta: float = 1e-3
    hidden_units: int = 256
    num_layers: int = 2

    @property
    def buffer_size(self) -> int:
        """Transitions collected before an update."""
        return self.num_envs * self.num_steps

    def environment(self) -> dict[str, Any]:
        """Settings of the grasp environment; `uint8` is what Stable-Baselines3 scales itself."""
        camera = Camera(type="depth", width=self.size, height=self.size, encoding="uint8")
        return {
            "simulator": "fast",
            "num_envs": self.num_envs,
            "frame_grab": MODES[self.mode],
            "cameras": {CAMERA: camera},
        }

    @property
    def rewards(self) -> dict[str, float]:
        """Weights of the rewards, the paper's."""
        return DEFAULT_REWARDS
