"""Environment parameters of gymnasium environments: declared or by attribute, drawn and resumed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.spaces import Box, Discrete

from curricula.samplers import UniformParameters, UniformSampler
from envs.environment import EnvironmentFailure
from envs.gym import vector_env
from envs.gym.parameters import AttributeParameters
from envs.gym.processes import ProcessVectorEnv
from envs.gym.settings import GymSettings
from envs.gym.vector_env import GymEnvironment
from trainers.common.errors import UserError

STEPS = 3
SHOWN = ("mass", "count", "limit")


class Wall(gymnasium.Env[Any, Any]):
    """Shows the values that its attributes had when its episode began."""

    observation_space = Box(-np.inf, np.inf, (3,), np.float64)
    action_space = Discrete(2)
    limit = 2.5
    flag = True
    _hidden = 1.0

    def __init__(self, render_mode: str | None = None):
        self.mass, self.count, self.label = 1.5, 4, "wall"

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = STEPS
        self.shown = np.array([getattr(self, name) for name in SHOWN], np.float64)
        return self.shown.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        return self.shown.copy(), float(self.np_random.random()), self.left == 0, False, {}


class Declaring(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Declares one parameter, which is a property."""

    parameter_names = ("heaviness",)

    @property
    def heaviness(self) -> float:
        return float(self.env.unwrapped.mass) / 10.0

    @heaviness.setter
    def heaviness(self, value: float) -> None:
        if value < 0.0:
            raise ValueError(f"nothing weighs {value}")
        self.env.unwrapped.mass = 10.0 * value


DOCUMENT = (Path(__file__).parents[3] / "docs/gymnasium.md").read_text()
DOCUMENTED = DOCUMENT.partition("## Environment parameters")[2]


def documented(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", DOCUMENTED, re.DOTALL)
    assert found
    return found[1]


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gymnasium.register("ventosa_tests/Wall-v0", entry_point=Wall)
    gymnasium.register("ventosa_tests/Declaring-v0", entry_point=lambda: Declaring(Wall()))
    yield
    for name in ("Wall", "Declaring"):
        del gymnasium.registry[f"ventosa_tests/{name}-v0"]


def make(name: str = "Wall", vectorization: Any = "sync", seed: int = 7) -> GymEnvironment:
    settings = GymSettings(
        id=f"ventosa_tests/{name}-v0", num_envs=4, vectorization=vectorization, timeout_s=30
    )
    return GymEnvironment(settings, (), seed)


def uniform(low: float, high: float) -> UniformSampler:
    bounds = UniformParameters(min_value=low, max_value=high)
    return UniformSampler(sampler_type="uniform", sampler_parameters=bounds)


def shown(observations: Mapping[str, Any], name: str) -> np.ndarray:
    column: np.ndarray = observations["observation"][:, SHOWN.index(name)]
    return column


def play(env: GymEnvironment, steps: int) -> list[Any]:
    return [env.step(np.zeros(env.num_envs, np.int64))[:2] for _ in range(steps)]


def test_the_parameters_are_numbers_of_its_own_or_what_it_declares() -> None:
    assert AttributeParameters(Wall()).names == {"mass", "count", "limit"}
    assert AttributeParameters(Declaring(Wall())).names == {"heaviness"}
    limited = gymnasium.wrappers.TimeLimit(Declaring(Wall()), 5)
    assert AttributeParameters(limited).names == {"heaviness"}
    with closing(make()) as env:
        assert env.parameter_names == {"mass", "count", "limit"}
        with pytest.raises(ValueError, match=r"\['height'\]; there are: \['count', 'limit', 'ma"):
            env.set_parameters({"height": 1.0})


def test_a_process_that_was_lost_has_them_when_it_is_started_again() -> None:
    with closing(make(vectorization="async")) as env:
        env.reset()
        env.set_parameters({"mass": 9.0})
        assert isinstance(env._vector, ProcessVectorEnv)
        process = env._vector.processes[2]
        process.kill()
        process.join()
        play(env, 1)
        assert shown(play(env, STEPS)[-1][0], "mass").tolist() == [9.0] * 4


def test_whole_numbers_stay_whole_where_the_attribute_is() -> None:
    wall = Wall()
    AttributeParameters(wall).apply({"count": 6.0, "mass": 2.0, "limit": 3.0})
    assert (wall.count, wall.mass, wall.limit) == (6, 2.0, 3.0)
    assert [type(value) for value in (wall.count, wall.mass)] == [int, float]
    AttributeParameters(wall).apply({"count": 6.5})
    assert wall.count == 6.5


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_they_hold_from_each_environment_s_next_reset_on(vectorization: str) -> None:
    with closing(make(vectorization=vectorization)) as env:
        env.set_parameters({"mass": uniform(2.0, 3.0), "count": 9})
        observations, _ = env.reset()
        first = shown(observations, "mass").copy()
        assert ((first >= 2.0) & (first < 3.0)).all()
        assert len(set(first)) == 4
        np.testing.assert_array_equal(shown(observations, "count"), 9)
        np.testing.assert_array_equal(shown(observations, "limit"), 2.5)
        env.set_parameters({"mass": -1.0, "count": 9})
        *running, (last, _) = play(env, STEPS)
        for observations, _ in running:
            np.testing.assert_array_equal(shown(observations, "mass"), first)
        np.testing.assert_array_equal(shown(last, "mass"), -1.0)


def test_a_declared_parameter_is_set_where_it_is_declared() -> None:
    with closing(make("Declaring")) as env:
        env.set_parameters({"heaviness": 0.75})
        np.testing.assert_array_equal(shown(env.reset()[0], "mass"), 7.5)
        env.set_parameters({"heaviness": -2.0})
        with pytest.raises(
            EnvironmentFailure, match=r"the reset of its episode 2: ValueError: not"
        ):
            env.reset()


def test_they_are_drawn_evenly_and_by_the_seed() -> None:
    values = []
    for seed in (7, 7, 8):
        with closing(make(seed=seed)) as env:
            env.set_parameters({"mass": uniform(0.0, 1.0)})
            seen = [shown(env.reset()[0], "mass").copy()]
            seen += [shown(observed, "mass").copy() for observed, _ in play(env, 100 * STEPS)]
            values.append(np.concatenate(seen[::STEPS]))
    np.testing.assert_array_equal(values[0], values[1])
    assert not np.isclose(values[0], values[2]).any()
    # The mean of 404 uniform draws, within four of its standard deviations.
    assert abs(values[0].mean() - 0.5) < 4.0 / np.sqrt(12 * len(values[0]))


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_a_running_episode_comes_back_with_what_was_drawn_for_it(
    vectorization: str, caplog: pytest.LogCaptureFixture
) -> None:
    lessons = [{"mass": uniform(0.0, 1.0)}, {"mass": uniform(5.0, 6.0)}]
    with closing(make(vectorization=vectorization)) as env:
        env.set_parameters(lessons[0])
        env.reset()
        play(env, STEPS + 1)
        env.set_parameters(lessons[1])  # a lesson begins while episodes run
        state = env.state_dict()
        expected = play(env, 3 * STEPS)
    with closing(make(vectorization=vectorization)) as env:
        env.set_parameters(lessons[1])
        env.reset()
        again = env.load_state_dict(state)
        assert (shown(again, "mass") < 1.0).all()
        for (one, reward), (other, expected_reward) in zip(
            play(env, 3 * STEPS), expected, strict=True
        ):
            np.testing.assert_array_equal(one["observation"], other["observation"])
            np.testing.assert_array_equal(reward, expected_reward)
    assert not caplog.records


def test_an_episode_that_can_not_be_played_again_is_followed_by_one_of_this_lesson(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(vector_env, "LONGEST_REPLAY_STEPS", 1)
    with closing(make()) as env:
        env.set_parameters({"mass": 1.0})
        env.reset()
        play(env, 2)
        env.set_parameters({"mass": 2.0})
        np.testing.assert_array_equal(shown(env.load_state_dict(env.state_dict()), "mass"), 2.0)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"step": np.zeros(4)}, "parameters ['step'], which the environment does not have"),
        ({"mass": np.zeros(3)}, "not one value for each of 4 environments"),
    ],
)
def test_states_of_other_parameters_are_refused(parameters: Any, said: str) -> None:
    with closing(make()) as env:
        env.reset()
        with pytest.raises(ValueError, match=re.escape(said)):
            env.load_state_dict({**env.state_dict(), "parameters": parameters})


def test_a_curriculum_over_what_is_not_there_is_refused_before_the_run(
    make_session: Callable[..., Any],
) -> None:
    lessons = [
        {"threshold": 0.5, "parameters": {"masscar": 1.0}},
        {"parameters": {"masscar": 2.0}},
    ]
    curriculum = {"type": "lessons", "measure": "progress", "lessons": lessons}
    environment = {"type": "gymnasium", "id": "CartPole-v1"}
    with pytest.raises(UserError) as raised:
        make_session(environment, curriculum=curriculum)
    said = str(raised.value)
    assert said.startswith("curriculum: the environment has no parameter 'masscar'; did you mean")
    assert "'masscart'" in said


def test_the_documented_curriculum_and_declaration(make_session: Callable[..., Any]) -> None:
    sections = yaml.safe_load(documented("yaml"))
    environment = {"type": "gymnasium", "id": "CartPole-v1"}
    session = make_session(environment, **sections)
    session.reset()
    cart = session.env_runner.env._vector.envs[0].unwrapped
    assert cart.length == 0.3
    assert 8 <= cart.force_mag < 12
    session.close()
    names: dict[str, Any] = {"CartPoleEnv": CartPoleEnv}
    exec(documented("python"), names)
    declared = names["Cart"]()
    parameters = AttributeParameters(declared)
    assert parameters.names == {"length"}
    parameters.apply({"length": 2.0})
    assert declared.polemass_length == pytest.approx(0.2)
