"""A run on k ranks is the run on one: its weights, its lessons, and what it reports."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector.utils import batch_space
from pydantic import BaseModel

from encoders.spaces import DepthImage
from envs.environment import Environment, ObservationArrays, StepResult
from rewards.reward import RewardTerm
from trainers.common.errors import UserError
from trainers.distributed.world import ALONE, World
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings
from trainers.session import Session

ENVIRONMENTS, FEW, UPDATES = 8, 2, 20
STEPS = 10**6
"""Of the whole run, which the schedules hardly move in."""
LARGEST_DIFFERENCE = 1e-5
SIDE_PX = 20


class NumberedSettings(BaseModel, frozen=True, extra="forbid"):
    num_envs: int = ENVIRONMENTS
    seen: bool = False
    choices: bool = False


class NumberedEnvironment(Environment):
    """Hit the point that is named, or seen; episodes are of 1 to 5 steps, which tell nothing of it.

    What an environment draws depends on the seed, its number, and how many episodes it has had.
    """

    Settings = NumberedSettings
    parameter_names = frozenset({"scale"})
    state_axes: ClassVar[Mapping[str, Any]] = {"episode": 0, "step": 0, "scale": 0}

    def __init__(
        self, settings: NumberedSettings, rewards: Sequence[RewardTerm[Any]], seed: int = 0
    ):
        self._settings, self._seed, self._first = settings, seed, 0
        self.num_envs = n = settings.num_envs
        self.single_action_space = Discrete(2) if settings.choices else Box(-1, 1, (1,), np.float32)
        spaces: dict[str, gymnasium.Space[Any]] = {"goal": Box(-50, 50, (2,), np.float32)}
        if settings.seen:
            spaces["camera"] = DepthImage(SIDE_PX, SIDE_PX, (0.5, 40.0))
        self.single_observation_space = gymnasium.spaces.Dict(spaces)
        self.action_space = batch_space(self.single_action_space, n)
        self.observation_space = batch_space(self.single_observation_space, n)
        self._episode, self._step, self._scale = np.zeros(n, int), np.zeros(n, int), np.ones(n)
        self._parameters: Mapping[str, Any] = {"scale": 1.0}

    def number_from(self, first: int) -> None:
        self._first = first

    def set_parameters(self, parameters: Mapping[str, Any]) -> None:
        super().set_parameters(parameters)
        self._parameters = {"scale": 1.0, **parameters}

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[ObservationArrays, dict]:
        self._begin(np.ones(self.num_envs, bool))
        return self._observations(), {}

    def step(self, actions: Any) -> StepResult:
        aim = np.asarray(actions, float).reshape(self.num_envs)
        if self._settings.choices:
            aim = 2 * aim - 1
        reward = -self._scale * np.abs(aim - self._goal[:, 0])
        self._step = self._step + 1
        done = self._step >= self._length
        infos: dict[str, Any] = {
            "reward_terms": {"near": reward},
            "episode_metrics": {"success": reward > -0.5},
            "same_frame": ~done,
        }
        observations = self._observations()
        if done.any():
            infos["final_obs"], infos["_final_obs"] = observations, done
            self._begin(done)
            observations = self._observations()
        hit = done & (reward > -0.3)
        return observations, reward, hit, done & ~hit, infos

    def state_dict(self) -> dict[str, Any]:
        return {"episode": self._episode, "step": self._step, "scale": self._scale}

    def load_state_dict(self, state: dict[str, Any]) -> ObservationArrays:
        self._episode, self._step, self._scale = state["episode"], state["step"], state["scale"]
        self._draw()
        return self._observations()

    def _begin(self, where: np.ndarray) -> None:
        self._episode = self._episode + where
        self._step = np.where(where, 0, self._step)
        self._scale = np.where(where, self._parameters["scale"], self._scale)
        self._draw()

    def _draw(self) -> None:
        drawn = [
            np.random.default_rng([self._seed, self._first + i, episode]).uniform(-1, 1, 3)
            for i, episode in enumerate(self._episode)
        ]
        self._goal = np.stack(drawn)[:, :2]
        self._length = 3 + np.round(2 * np.stack(drawn)[:, 2]).astype(int)

    def _observations(self) -> ObservationArrays:
        goal = (30.0 * self._goal + self._step[:, None]).astype(np.float32)
        if not self._settings.seen:
            return {"goal": goal}
        bar = np.arange(SIDE_PX) == np.round((SIDE_PX - 1) * (1 + self._goal[:, :1]) / 2)
        rows = np.where(bar, 1_000, 40_000).astype(np.uint16)
        image = np.repeat(rows[:, None, :, None], SIDE_PX, axis=1)
        return {"goal": goal, "camera": image}


@dataclass(frozen=True)
class Course:
    """What a run came to: weights, statistics of its updates, rewards of its episodes, lesson."""

    weights: dict[str, torch.Tensor]
    statistics: list[Mapping[str, float]]
    rewards: list[float]
    lesson: int


LESSONS = {
    "type": "lessons",
    "measure": "reward",
    "smoothing_episodes": 10,
    "min_lesson_length": 10,
    "lessons": [
        {"threshold": -100.0, "parameters": {"scale": 1.0}},
        {"threshold": -100.0, "parameters": {"scale": 1.5}},
        {"parameters": {"scale": 2.0}},
    ],
}
NORMALIZED = {"goal": {"type": "vector", "normalize": True}}
ON_POLICY = {"batch_size": 24, "buffer_size": 64, "num_epoch": 3, "normalize_rewards": True}
LSTM = {"memory": {"type": "lstm", "memory_size": 8, "sequence_length": 4}}


def course(session: Session, updates: int = UPDATES) -> Course:
    """Trains for so many updates, as `Training` does."""
    statistics, rewards = [], []
    for _ in range(updates):
        session.algorithm.collect()
        statistics.append(session.algorithm.update(session.env_runner.step_count / STEPS))
        episodes = session.env_runner.pop_finished()
        rewards += episodes.rewards.tolist()
        session.advance_curriculum(episodes, session.env_runner.step_count / STEPS)
    weights = {name: tensor.clone() for name, tensor in session.weights().items()}
    return Course(weights, statistics, rewards, session.lesson)


@pytest.fixture
def begun(
    make_run: Callable[..., RunSettings], registries: Registries
) -> Callable[..., list[Session]]:
    """Sessions of a run, one of each rank: `begun(worlds, trainer, environment, ...)`."""

    def begin(
        worlds: Sequence[World], trainer: Mapping[str, Any], settings: Any = None, **rest: Any
    ) -> list[Session]:
        run = make_run("target", trainer, **rest)
        numbered = NumberedSettings(**(settings or {}))
        component = replace(run.environment, cls=NumberedEnvironment, settings=numbered)
        run = replace(run, environment=component)
        sessions = [Session(run, registries, world=world) for world in worlds]
        for session in sessions:
            session.reset()
        return sessions

    return begin


def largest_difference(one: Course, other: Course) -> float:
    """Of the weights."""
    return max(
        float((tensor.double() - other.weights[name].double()).abs().max())
        for name, tensor in one.weights.items()
    )


CASES: dict[str, tuple[Mapping[str, Any], Mapping[str, Any], Mapping[str, Any]]] = {
    "ppo": (
        {"hyperparameters": {**ON_POLICY, "target_kl": 0.05, "antithetic": True}},
        {"curriculum": LESSONS, "encoders": NORMALIZED},
        {},
    ),
    "ppo with memory": (
        {"hyperparameters": ON_POLICY, "network_settings": LSTM},
        {"curriculum": LESSONS, "encoders": NORMALIZED},
        {},
    ),
    "ppo that sees": ({"hyperparameters": ON_POLICY}, {}, {"seen": True}),
    "ppo that chooses": (
        {"hyperparameters": ON_POLICY},
        {"encoders": NORMALIZED},
        {"choices": True},
    ),
    "ddpg": (
        {
            "trainer_type": "ddpg",
            "time_horizon": 4,
            "hyperparameters": {
                "buffer_size": 400,
                "buffer_init_steps": 64,
                "updates_per_step": 0.5,
                "policy_delay": 2,
                "n_step": 3,
                "random_actions": 0.2,
                "noise": {"type": "ornstein_uhlenbeck"},
            },
        },
        {"curriculum": LESSONS, "encoders": NORMALIZED},
        {},
    ),
    "ddpg that sees": (
        {"trainer_type": "ddpg", "hyperparameters": {"updates_per_step": 0.25}},
        {},
        {"seen": True},
    ),
    "trpo": (
        {
            "trainer_type": "trpo",
            "hyperparameters": {**ON_POLICY, "fisher_fraction": 0.5},
            "network_settings": LSTM,
        },
        {"curriculum": LESSONS, "encoders": NORMALIZED},
        {},
    ),
}


LONG = {"ppo that chooses", "ddpg that sees"}


def compare(expected: Course, found: Sequence[Course]) -> None:
    for one in found:
        assert largest_difference(one, found[0]) == 0.0  # they do not drift apart
        assert largest_difference(one, expected) < LARGEST_DIFFERENCE
        assert one.lesson == expected.lesson
        assert one.rewards == pytest.approx(expected.rewards, abs=1e-4)
        for own, theirs in zip(one.statistics, expected.statistics, strict=True):
            assert own == pytest.approx(theirs, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("case", [case for case in CASES if case not in LONG])
def test_ranks_do_together_what_one_does(
    case: str, begun: Any, ranks: Any, side_by_side: Any
) -> None:
    trainer, rest, settings = CASES[case]
    (alone,) = begun([ALONE], trainer, settings, **rest)
    sessions = begun(ranks(2), trainer, settings, **rest)
    compare(course(alone, FEW), side_by_side(partial(course, updates=FEW), sessions))


def test_ranks_do_so_on_several_machines(begun: Any, ranks: Any, side_by_side: Any) -> None:
    """Where each learns from what its own environments gave."""
    trainer, rest, settings = CASES["ppo that sees"]
    (alone,) = begun([ALONE], trainer, settings, **rest)
    worlds = ranks(4)
    for world in worlds:
        world.shares_memory = False
    found = side_by_side(partial(course, updates=FEW), begun(worlds, trainer, settings, **rest))
    compare(course(alone, FEW), found)


@pytest.mark.soak
@pytest.mark.parametrize("size", [2, 4])
@pytest.mark.parametrize("case", CASES)
def test_ranks_do_so_for_many_updates(
    case: str, size: int, begun: Any, ranks: Any, side_by_side: Any
) -> None:
    trainer, rest, settings = CASES[case]
    (alone,) = begun([ALONE], trainer, settings, **rest)
    expected = course(alone)
    found = side_by_side(course, begun(ranks(size), trainer, settings, **rest))
    print(f"{case}, {size} ranks: {largest_difference(found[0], expected):.1e}")
    compare(expected, found)


@pytest.mark.parametrize(("case", "size"), [("ppo with memory", 4), ("ddpg", 2)])
def test_a_run_goes_on_with_other_ranks(
    case: str, size: int, begun: Any, ranks: Any, side_by_side: Any
) -> None:
    """It was saved by two; a replay buffer is of use to as many alone."""
    trainer, rest, settings = CASES[case]
    trainer = copy.deepcopy(dict(trainer))
    if case == "ddpg":
        trainer["hyperparameters"]["save_replay_buffer"] = True
    (alone,) = begun([ALONE], trainer, settings, **rest)
    expected = course(alone, 2 * FEW)

    def save(session: Session) -> tuple[dict[str, torch.Tensor], Any]:
        course(session, FEW)
        return session.weights(), session.joined_state(session.state_dict())

    weights, state = side_by_side(save, begun(ranks(2), trainer, settings, **rest))[0]
    others = begun(ranks(size), trainer, settings, **rest)
    for session in others:
        session.load_state_dict(weights, session.own_state(copy.deepcopy(state)))
    found = side_by_side(partial(course, updates=FEW), others)
    assert largest_difference(found[0], expected) < LARGEST_DIFFERENCE
    rewards = found[-1].rewards
    assert rewards == pytest.approx(expected.rewards[-len(rewards) :], abs=1e-4)


def test_environments_that_ranks_can_not_share_evenly_are_refused(begun: Any, ranks: Any) -> None:
    with pytest.raises(UserError, match=r"^environment.num_envs: 8 environments can't be divided"):
        begun(ranks(3), {})


def test_what_does_not_say_how_it_is_divided_is_refused(
    make_run: Any, registries: Registries, ranks: Any
) -> None:
    with pytest.raises(UserError, match=r"^environment: 'target' does not say how it is divided"):
        Session(make_run(), registries, world=ranks(2)[0])
