"""Films of whole episodes, of environments that can be seen from outside."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from envs.drawing import captioned
from envs.environment import Environment
from trainers.experience.episodes import EpisodeBatch
from trainers.loggers.animation import animated_gif

FILMED = 2
"""Of the first episodes, and of the worst."""
WIDTH_PX = 320
MOST_FRAMES = 300
"""Of a film; of a longer one every second is left out, or three of four, and so on."""

Frame = NDArray[np.uint8]


@dataclass
class Film:
    """An episode as it is filmed.

    Attributes:
        full_fps: frames a second, where none is left out.
        every: one frame is kept of so many.
        steps: steps of the episode so far.
        reward: their sum.
    """

    full_fps: float
    every: int = 1
    steps: int = 0
    reward: float = 0.0
    _kept: list[Frame] = field(default_factory=list)
    _last: Frame | None = None

    def add(self, frame: Frame, caption: str) -> None:
        """Adds what is seen after so many steps."""
        self._last = captioned(_fitted(frame), caption)
        if self.steps % self.every == 0:
            self._kept.append(self._last)
        if len(self._kept) > MOST_FRAMES:
            self._kept, self.every = self._kept[::2], 2 * self.every

    @property
    def fps(self) -> float:
        """Frames a second."""
        return self.full_fps / self.every

    @property
    def frames(self) -> Frame:
        """(T, height, width, 3), with how it ended."""
        kept = self._kept
        ends = [] if self._last is None or kept[-1] is self._last else [self._last]
        return np.stack([*kept, *ends])


class EpisodeCamera:
    """Films some episodes of an evaluation while they are played.

    Args:
        env: the environments, which can be filmed.
        numbers: which episodes, in the order in which they begin, from 0.

    Attributes:
        films: by the episodes' numbers; those that have begun.
    """

    def __init__(self, env: Environment, numbers: Collection[int]):
        self._env, self._numbers = env, frozenset(numbers)
        self.films: dict[int, Film] = {}
        self._filmed: dict[int, int] = {}

    def before_step(self, running: NDArray[np.int64]) -> None:
        """Turns to the episodes that run now, by their numbers (N,)."""
        filmed = {row: int(number) for row, number in enumerate(running) if number in self._numbers}
        if filmed == self._filmed:
            return
        self._filmed = filmed
        self._env.film(filmed)
        for row, frames in self._env.pop_frames().items():
            film = self.films.setdefault(filmed[row], Film(self._env.frames_per_second))
            if not film.steps:
                film.add(frames[0], "step 0")

    def after_step(self, actions: NDArray[Any], rewards: NDArray[np.float64]) -> None:
        """Takes the frames of a step with actions (N, ...) and rewards (N,)."""
        for row, frames in self._env.pop_frames().items() if self._filmed else ():
            film = self.films[self._filmed[row]]
            film.steps += 1
            film.reward += float(rewards[row])
            action = np.array2string(actions[row], precision=2, max_line_width=10**6, threshold=8)
            caption = f"step {film.steps}   reward {film.reward:.4g}   action {action}"
            film.add(frames[-1], caption)


class EpisodeFilms:
    """Films of an evaluation's first episodes, and of its worst.

    Args:
        env: the environments, which can be filmed.
    """

    def __init__(self, env: Environment):
        self._env = env
        self.first, self.worst = EpisodeCamera(env, range(FILMED)), EpisodeCamera(env, ())

    def aim_at_worst(self, played: EpisodeBatch) -> int:
        """Has those filmed next that failed, and of those the ones with the lowest rewards.

        Returns:
            How many episodes have to be played again for that.
        """
        worst = np.lexsort((played.rewards, played.successes))[:FILMED]
        self.worst = EpisodeCamera(self._env, worst.tolist())
        return int(worst.max()) + 1

    @property
    def file_names(self) -> tuple[str, ...]:
        """What `files` may make."""
        numbers = range(1, FILMED + 1)
        return tuple(f"{which}-{number}.gif" for which in ("first", "worst") for number in numbers)

    def files(self) -> Iterator[tuple[str, bytes]]:
        """Names and contents of files."""
        for which, camera in (("first", self.first), ("worst", self.worst)):
            for number, film in enumerate(camera.films.values(), 1):
                yield f"{which}-{number}.gif", animated_gif(film.frames, film.fps)


def _fitted(frame: Frame) -> Frame:
    """A frame as wide as films are."""
    height, width, _ = frame.shape
    how = cv2.INTER_AREA if width > WIDTH_PX else cv2.INTER_NEAREST
    size = (WIDTH_PX, round(height * WIDTH_PX / width))
    return np.asarray(cv2.resize(frame, size, interpolation=how), np.uint8)
