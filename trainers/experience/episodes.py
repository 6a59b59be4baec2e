"""Finished episodes: what is known of them, and when they may be counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.evaluation import SUCCESS


@dataclass(frozen=True)
class EpisodeBatch:
    """k finished episodes.

    Attributes:
        number: (k,) each one's place in the order in which the run's episodes began, from 0; its
            place in the order in which they ended, as long as the former is not known.
        rewards: (k,) cumulative rewards.
        lengths: (k,) steps.
        terms: (k,) cumulative weighted rewards by term.
        episode_metrics: (k,) what the environment reports of an episode, by name.
    """

    number: NDArray[np.int64]
    rewards: NDArray[np.float64]
    lengths: NDArray[np.float64]
    terms: dict[str, NDArray[np.float64]]
    episode_metrics: dict[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.number)

    def __getitem__(self, rows: NDArray[Any] | slice) -> EpisodeBatch:
        return EpisodeBatch(
            self.number[rows],
            self.rewards[rows],
            self.lengths[rows],
            {name: values[rows] for name, values in self.terms.items()},
            {name: values[rows] for name, values in self.episode_metrics.items()},
        )

    @property
    def successes(self) -> NDArray[np.bool_]:
        """(k,) False where the environment does not report success."""
        return self.episode_metrics.get(SUCCESS.metric, np.zeros(len(self))).astype(bool)


def concatenate(parts: Sequence[EpisodeBatch]) -> EpisodeBatch:
    """Episodes of several batches, in their order.

    Where one lacks a metric of another, its episodes are no successes, and other metrics are NaN.
    """
    parts = [part for part in parts if len(part)]
    if not parts:
        return EpisodeBatch(np.zeros(0, np.int64), np.zeros(0), np.zeros(0), {}, {})
    return EpisodeBatch(
        np.concatenate([part.number for part in parts]),
        np.concatenate([part.rewards for part in parts]),
        np.concatenate([part.lengths for part in parts]),
        {name: np.concatenate([part.terms[name] for part in parts]) for name in parts[0].terms},
        {
            name: np.concatenate([_metric(part, name) for part in parts])
            for name in dict.fromkeys(name for part in parts for name in part.episode_metrics)
        },
    )


def following(
    number: NDArray[np.int64], environment: NDArray[np.int64], begun: int
) -> NDArray[np.int64]:
    """Numbers (k,) of episodes that ended one after the other, in each of whose place one begins.

    Args:
        number: (N,) of the episodes that run; afterwards of those that run then.
        environment: (k,) in which one ends.
        begun: episodes that have begun; they are numbered in this order.
    """
    begins = begun + np.arange(len(environment))
    order = np.argsort(environment, kind="stable")
    where, begins = environment[order], begins[order]
    again = where[1:] == where[:-1]  # the episode that ends is one that began here
    first, last = np.r_[True, ~again][: len(where)], np.r_[~again, True][: len(where)]
    ended = np.empty_like(begins)
    ended[order] = np.where(first, number[where], np.roll(begins, 1))
    number[where[last]] = begins[last]
    return ended


def _metric(episodes: EpisodeBatch, name: str) -> NDArray[np.float64]:
    unknown = 0.0 if name == SUCCESS.metric else np.nan
    return episodes.episode_metrics.get(name, np.full(len(episodes), unknown))


class Cohorts:
    """Holds finished episodes back until they can be counted without favour to short ones.

    Of N environments side by side the first episodes to *end* are the short ones: where success
    ends an episode, a policy that hardly ever succeeds begins with nothing but successes. So
    episodes count in the order in which they *began*, each after all that began before it. Which
    number an episode has is settled before it is played; hence the k-th has the distribution of
    any other, for every k and whatever the lengths, and the sequence is that of one environment
    that plays its episodes one by one. Any estimate from the first n, from n in a row, or from the
    rule by which a lesson ends, has exactly the expectation it has there, whatever N is.

    Who asks at a certain time, as summaries do, could still meet a few that are there because they
    were short. They are therefore released in whole cohorts: the numbers 0 to N - 1, which are all
    environments' first episodes, N to 2N - 1, and so on. What is left is of the order of one
    cohort's deviation, over all that was released.

    Nothing is dropped, and a cohort is late by one longest episode at most. An episode without an
    end keeps all that began after it waiting, for what it will come to belongs to the estimate:
    such environments need a limit of steps.

    Args:
        size: N, episodes in a cohort.
    """

    def __init__(self, size: int):
        self._size = size
        self._waiting: list[EpisodeBatch] = []

    def add(self, episodes: EpisodeBatch) -> None:
        """Adds episodes that ended, in any order."""
        self._waiting.append(episodes)

    def pop(self, first_running: int) -> EpisodeBatch:
        """The episodes of the cohorts that were completed since the last call, by their number.

        Args:
            first_running: the lowest number of an episode that has not ended.
        """
        waiting = concatenate(self._waiting)
        complete = waiting.number < first_running // self._size * self._size
        self._waiting = [waiting[~complete]]
        released = waiting[complete]
        return released[np.argsort(released.number)]

    def state_dict(self) -> dict[str, Any]:
        """The episodes that wait."""
        return dict(vars(concatenate(self._waiting)))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state.

        Raises:
            ValueError: its episodes have more of one thing than of another.
        """
        waiting = EpisodeBatch(**state)
        named = (*waiting.terms.values(), *waiting.episode_metrics.values())
        for values in (waiting.rewards, waiting.lengths, *named):
            if np.shape(values) != (len(waiting),):
                raise ValueError(f"{np.shape(values)} values for {len(waiting)} finished episodes")
        self._waiting = [waiting]
