"""Stepping the environments for a learner, with the books of the episodes kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.environment import Environment, EnvironmentFailure
from trainers.common.timers import timed

SUCCESS = "success"


class StopRequested(Exception):  # noqa: N818 - nothing went wrong
    """The user asked the run to stop."""


class NonFiniteError(FloatingPointError):
    """NaN or infinity where learning can't go on; the message names what, where and when."""


@dataclass(frozen=True)
class Step:
    """What came of one action in each of N environments.

    Attributes:
        reward: (N,).
        terminated: (N,) the episode reached an end of its own: nothing follows.
        truncated: (N,) the episode was cut off: what would follow has a value.
        same_frame: (N,) the images of the new observation are those of the one before.
        final_observations: (N, ...) as they were before the reset, right where an episode ended;
            None where none did. There wherever one was truncated.
    """

    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    same_frame: NDArray[np.bool_]
    final_observations: Mapping[str, NDArray[Any]] | None

    @property
    def done(self) -> NDArray[np.bool_]:
        """(N,) the episode ended, terminated or truncated."""
        return self.terminated | self.truncated


@dataclass(frozen=True)
class EpisodeBatch:
    """k finished episodes, in the order they ended.

    Attributes:
        rewards: (k,) cumulative rewards.
        lengths: (k,) steps.
        terms: (k,) cumulative weighted rewards by term.
        episode_metrics: (k,) what the environment reports of an episode, by name.
    """

    rewards: NDArray[np.float64]
    lengths: NDArray[np.float64]
    terms: dict[str, NDArray[np.float64]]
    episode_metrics: dict[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.rewards)

    def __getitem__(self, rows: NDArray[np.bool_]) -> EpisodeBatch:
        return EpisodeBatch(
            self.rewards[rows],
            self.lengths[rows],
            {name: values[rows] for name, values in self.terms.items()},
            {name: values[rows] for name, values in self.episode_metrics.items()},
        )

    @property
    def successes(self) -> NDArray[np.bool_]:
        """(k,) False where the environment does not report success."""
        return self.episode_metrics.get(SUCCESS, np.zeros(len(self))).astype(bool)


def concatenate(parts: Sequence[EpisodeBatch]) -> EpisodeBatch:
    """EpisodeBatch of several batches, in their order."""
    parts = [part for part in parts if len(part)]
    if not parts:
        return EpisodeBatch(np.zeros(0), np.zeros(0), {}, {})
    return EpisodeBatch(
        np.concatenate([part.rewards for part in parts]),
        np.concatenate([part.lengths for part in parts]),
        {name: np.concatenate([part.terms[name] for part in parts]) for name in parts[0].terms},
        {
            n: np.concatenate([part.episode_metrics[n] for part in parts])
            for n in parts[0].episode_metrics
        },
    )


class EnvRunner:
    """Steps the environments, checks what they return, and adds up the episodes.

    Args:
        env: the environments.
        stop_requested: asked before every step.

    Attributes:
        observations: the present ones, as the environment gave them.
        step_count: steps taken in the run, over all environments.
    """

    def __init__(self, env: Environment, stop_requested: Callable[[], bool] = lambda: False):
        self.env, self._stop_requested = env, stop_requested
        self.step_count = 0
        self.observations: Mapping[str, NDArray[Any]] = {}
        self._reward = np.zeros(env.num_envs)
        self._length = np.zeros(env.num_envs)
        self._terms: dict[str, NDArray[np.float64]] = {}
        self._finished: list[EpisodeBatch] = []

    def reset(self) -> None:
        """Begins an episode everywhere."""
        self.observations, _ = self.env.reset()
        self._check_observations(self.observations)

    def step(self, actions: NDArray[Any]) -> Step:
        """Takes one action (N, ...) in every environment.

        Raises:
            StopRequested: the run is to stop; nothing was done.
            NonFiniteError: a reward or an observation is NaN or infinite.
            EnvironmentFailure: an episode was truncated, and its last observation is not there.
        """
        if self._stop_requested():
            raise StopRequested
        with timed("environment"):
            observations, reward, terminated, truncated, infos = self.env.step(actions)
        self.step_count += self.env.num_envs
        terms = infos.get("reward_terms", {})
        for name, values in terms.items():
            self._check(f"reward {name!r}", values)
        self._check("reward", reward)
        self._check_observations(observations)
        done = terminated | truncated
        final = infos.get("final_obs") if done.any() else None
        if not final and (truncated & ~terminated).any():
            raise EnvironmentFailure(
                f"step {self.step_count}: an episode was truncated, and the infos have no "
                "`final_obs`: what would follow can't be valued without its last observation"
            )
        self._check_observations(final or {}, done)
        self._add_up(reward, terms, infos.get("episode_metrics", {}), done)
        self.observations = observations
        return Step(
            reward,
            terminated,
            truncated,
            infos.get("same_frame", np.zeros(len(reward), bool)),
            final,
        )

    def pop_finished(self) -> EpisodeBatch:
        """The episodes that ended since the last call."""
        parts, self._finished = self._finished, []
        return concatenate(parts)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on exactly; asked for when no finished episode waits."""
        return {
            "env": self.env.state_dict(),
            "step_count": self.step_count,
            "reward": self._reward.copy(),
            "length": self._length.copy(),
            "terms": {name: values.copy() for name, values in self._terms.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state.

        Raises:
            ValueError: it is the state of another number of environments.
        """
        if len(state["reward"]) != self.env.num_envs:
            raise ValueError(
                f"it was saved with {len(state['reward'])} environments, not {self.env.num_envs}"
            )
        self.observations = self.env.load_state_dict(state["env"])
        self.step_count = state["step_count"]
        self._reward, self._length = state["reward"].copy(), state["length"].copy()
        self._terms = {name: values.copy() for name, values in state["terms"].items()}
        self._finished = []

    def _add_up(
        self,
        reward: NDArray[np.float64],
        terms: Mapping[str, NDArray[np.float64]],
        episode_metrics: Mapping[str, NDArray[Any]],
        done: NDArray[np.bool_],
    ) -> None:
        self._reward += reward
        self._length += 1
        for name, values in terms.items():
            self._terms[name] = self._terms.get(name, 0.0) + values
        if done.any():
            self._finished.append(
                EpisodeBatch(
                    self._reward[done],
                    self._length[done],
                    {name: total[done] for name, total in self._terms.items()},
                    {name: np.asarray(v, np.float64)[done] for name, v in episode_metrics.items()},
                )
            )
            for total in (self._reward, self._length, *self._terms.values()):
                total[done] = 0.0

    def _check_observations(
        self, observations: Mapping[str, NDArray[Any]], of: NDArray[np.bool_] | None = None
    ) -> None:
        for name, values in observations.items():
            if np.issubdtype(values.dtype, np.floating):
                self._check(f"observation {name!r}", values, of)

    def _check(self, what: str, values: NDArray[Any], of: NDArray[np.bool_] | None = None) -> None:
        """Refuses what is not finite, in all environments or in those where `of` (N,) is set."""
        finite = np.isfinite(values)
        if finite.all():
            return
        broken = ~finite
        if of is not None:
            broken[~of] = False
        if broken.any():
            environment = int(np.argwhere(broken)[0][0])
            value = np.asarray(values)[broken].flat[0]
            raise NonFiniteError(
                f"step {self.step_count}: the {what} of environment {environment} is {value}"
            )
