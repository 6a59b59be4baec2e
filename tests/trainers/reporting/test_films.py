"""Films of episodes: which, of what length, and with the last that was seen."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from PIL import Image

from envs.environment import EnvironmentFailure
from envs.gym.settings import GymSettings
from envs.gym.vector_env import GymEnvironment
from trainers.evaluation import evaluate_policy
from trainers.experience.episodes import EpisodeBatch
from trainers.reporting import films as films_module
from trainers.reporting.films import EpisodeCamera, EpisodeFilms, Film

LENGTHS = (3, 5)


class Lamp(gymnasium.Env[Any, Any]):
    """Its picture's gray is 20 times the step; an episode has 3 to 5 steps, a reward of 1 each."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = Box(0.0, 1.0, (1,))
    action_space = Discrete(2)

    def __init__(self, render_mode: str | None = None, height: int = 8):
        self.render_mode, self._height = render_mode, height
        self._step = self._length = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._step, self._length = 0, int(self.np_random.integers(LENGTHS[0], LENGTHS[1] + 1))
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self._step += 1
        return np.zeros(1, np.float32), 1.0, self._step == self._length, False, {}

    def render(self) -> Any:
        return np.full((self._height, 16, 3), 20 * self._step, np.uint8)


class Still:
    def predict(self, observations: Any, state: Any = None, deterministic: bool = True) -> Any:
        return np.zeros(len(observations["observation"]), np.int64), None


@pytest.fixture(autouse=True)
def lamp() -> Iterator[None]:
    gymnasium.register("Lamp-v0", Lamp)
    yield
    gymnasium.registry.pop("Lamp-v0")


def make(vectorization: Any = "sync", **kwargs: Any) -> GymEnvironment:
    kwargs = {"render_mode": "rgb_array", **kwargs}
    return GymEnvironment(
        GymSettings(id="Lamp-v0", num_envs=2, vectorization=vectorization, kwargs=kwargs), ()
    )


def grays(film: Film) -> list[int]:
    """Of the frames, above their captions."""
    return film.frames[:, 0, 0, 0].tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_an_episode_is_there_from_its_first_to_its_last_frame(vectorization: str) -> None:
    env = make(vectorization)
    try:
        films = EpisodeFilms(env)
        report = evaluate_policy(Still(), env, 5, films=films)
        again = evaluate_policy(Still(), env, 5)
    finally:
        env.close()
    assert report == again  # filming changes nothing
    assert env.frames_per_second == 10.0
    assert sorted(films.first.films) == [0, 1]
    for film in (*films.first.films.values(), *films.worst.films.values()):
        assert film.steps == film.reward in range(LENGTHS[0], LENGTHS[1] + 1)
        assert grays(film) == [20 * step for step in range(film.steps + 1)]
    assert min(film.reward for film in films.worst.films.values()) == LENGTHS[0]
    files = dict(films.files())
    assert tuple(files) == films.file_names
    image = Image.open(io.BytesIO(files["first-1.gif"]))
    assert image.info["duration"] == 100
    assert image.n_frames == films.first.films[0].steps + 1  # type: ignore[attr-defined]


def test_the_worst_are_those_that_failed_and_of_those_the_lowest_rewards() -> None:
    env = make()
    rewards = np.array([5.0, 1.0, 4.0, 2.0, 3.0])
    success = np.array([0.0, 1.0, 0.0, 1.0, 0.0])
    try:
        films = EpisodeFilms(env)
        numbers = np.arange(5)
        played = EpisodeBatch(numbers, rewards, rewards, {}, {"success": success})
        assert films.aim_at_worst(played) == 5
        assert films.worst._numbers == {2, 4}
        assert films.aim_at_worst(EpisodeBatch(numbers, rewards, rewards, {}, {})) == 4
        assert films.worst._numbers == {1, 3}
    finally:
        env.close()


def test_a_long_episode_is_thinned_out_and_keeps_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(films_module, "MOST_FRAMES", 10)
    film = Film(30.0)
    for step in range(96):
        film.steps = step
        film.add(np.full((4, 4, 3), step, np.uint8), "")
    assert film.every == 16
    assert grays(film) == [0, 16, 32, 48, 64, 80, 95]
    assert film.fps == 30.0 / 16


def test_nothing_is_rendered_that_is_not_filmed(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make()
    count = 0
    render = Lamp.render

    def counted(self: Lamp) -> Any:
        nonlocal count
        count += 1
        return render(self)

    monkeypatch.setattr(Lamp, "render", counted)
    try:
        camera = EpisodeCamera(env, (0,))
        evaluate_policy(Still(), env, 20, camera=camera)
    finally:
        env.close()
    assert count == camera.films[0].steps + 1


def test_an_environment_that_can_not_be_filmed_is_known_and_one_that_fails_told() -> None:
    env = make(render_mode=None)
    assert env.frames_per_second == 0.0
    env.close()
    env = make(height="tall")
    try:
        with pytest.raises(EnvironmentFailure, match="environment 0 of 'Lamp-v0' failed"):
            evaluate_policy(Still(), env, 2, camera=EpisodeCamera(env, (0,)))
    finally:
        env.close()
