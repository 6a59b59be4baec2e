"""The grasp task for `gymnasium.make` and `gymnasium.make_vec`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from envs.grasp.settings import GraspSettings
from envs.grasp.vector_env import GraspVectorEnv
from rewards.grasp.transition import GraspTransition
from rewards.plugin import ventosa_rewards
from rewards.reward import RewardTerm, fits

DEFAULT_REWARDS = dict.fromkeys(
    ("touch", "collision", "position", "rotation", "approach", "facing"), 1.0
)


def built_in_rewards() -> dict[str, type]:
    """The built-in rewards of the grasp task by name."""
    return {name: cls for name, cls in ventosa_rewards().items() if fits(cls, GraspTransition)}


def make_vector_env(
    num_envs: int = 1,
    rewards: Mapping[str, float] = DEFAULT_REWARDS,
    seed: int = 0,
    render_mode: str | None = None,
    **settings: Any,
) -> GraspVectorEnv:
    """Builds N grasp environments stepped together.

    Args:
        num_envs: N.
        rewards: weights of the built-in rewards, by name.
        seed: until `reset(seed=...)` gives another.
        render_mode: None, `rgb_array` or `human`.
        settings: fields of `GraspSettings`.

    Raises:
        ValueError: a setting or a reward that does not exist, or does not fit.
    """
    built_in = built_in_rewards()
    if unknown := sorted(set(rewards) - set(built_in)):
        raise ValueError(f"unknown rewards {unknown}; there are {sorted(built_in)}")
    terms = [
        RewardTerm(name, weight, built_in[name](built_in[name].Settings()))  # type: ignore[attr-defined]
        for name, weight in rewards.items()
    ]
    return GraspVectorEnv(
        GraspSettings(num_envs=num_envs, **settings), terms, seed, render_mode=render_mode
    )


class GraspEnv(gymnasium.Env[Any, NDArray[Any]]):
    """One grasp environment: the N = 1 view of `GraspVectorEnv`, which leaves resets to its user.

    Args:
        render_mode: None, `rgb_array` or `human`.
        options: as for `make_vector_env`.
    """

    metadata = GraspVectorEnv.metadata

    def __init__(self, render_mode: str | None = None, **options: Any):
        self._batch = make_vector_env(1, render_mode=render_mode, **options)
        self.render_mode = render_mode
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Begins a new episode."""
        super().reset(seed=seed)
        observations, _ = self._batch.reset(seed=seed)
        return _first(observations), {}

    def step(
        self, action: NDArray[Any]
    ) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Moves the robot; `info` holds reward terms and episode metrics as plain numbers."""
        observations, reward, terminated, truncated, infos = self._batch.step_without_reset(
            np.asarray(action)[None]
        )
        info = {
            key: {name: float(values[0]) for name, values in infos[key].items()}
            for key in ("reward_terms", "episode_metrics")
        }
        return (
            _first(observations),
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            info,
        )

    def render(self) -> NDArray[np.uint8] | None:
        """A picture (480, 640, 3); None where PyBullet's window shows it."""
        pictures = self._batch.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Ends the simulator."""
        self._batch.close()


def _first(observations: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The only environment's observations, copied: the user may write to them."""
    return {name: values[0].copy() for name, values in observations.items()}
