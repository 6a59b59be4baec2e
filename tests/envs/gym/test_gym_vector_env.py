"""Any gymnasium environment: against gymnasium stepped by hand, resumed, and refused."""

from __future__ import annotations

import itertools
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Sequence, Text

from envs.environment import EnvironmentFailure
from envs.gym import vector_env
from envs.gym.episodes import episode_seed
from envs.gym.processes import ProcessVectorEnv
from envs.gym.settings import GymSettings
from envs.gym.vector_env import GymEnvironment
from rewards.gym.environment import EnvironmentReward
from rewards.gym.transition import GymTransition
from rewards.plugin import ventosa_rewards
from rewards.reward import RewardTerm

ROOM_STEPS = 6


class Room(gymnasium.Env[Any, Any]):
    """Observations of three kinds; ends or is cut off after a few steps that its seed decides.

    Args:
        trouble: what befalls the environment in its third step: nothing, an error, or the death of
            its process; or `forgetful`: it draws from elsewhere than `np_random`.
    """

    observation_space = Dict(
        {
            "place": Box(-np.inf, np.inf, (2,), np.float64),
            "door": Discrete(3),
            "view": Box(0, 255, (4, 5, 3), np.uint8),
        }
    )
    action_space = Discrete(3, start=1)
    elsewhere = np.random.default_rng(0)

    def __init__(self, trouble: str | None = None):
        self.trouble = trouble

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.seed, self.steps, self.sum = seed, 0, 0
        self.length = int(self.np_random.integers(2, ROOM_STEPS))
        return self._observation(), {"ignored": "info"}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.steps += 1
        self.sum += int(action)
        if self.steps == 2 and self.trouble == "error":
            raise RuntimeError("the room collapsed")
        if self.steps == 2 and self.trouble == "death":
            os.kill(os.getpid(), signal.SIGKILL)
        over = self.steps == self.length
        info = {"sum": self.sum, "nested": {"steps": self.steps}}
        return self._observation(), float(action), over and self.sum % 2 == 0, over, info

    def _observation(self) -> dict[str, Any]:
        rng = self.elsewhere if self.trouble == "forgetful" else self.np_random
        return {
            "place": np.array([self.sum, rng.normal()]),
            "door": int(rng.integers(3)),
            "view": rng.integers(0, 256, (4, 5, 3), np.uint8),
        }


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gymnasium.register("ventosa_tests/Room-v0", entry_point=Room)
    yield
    del gymnasium.registry["ventosa_tests/Room-v0"]


def make(
    env_id: str = "ventosa_tests/Room-v0",
    count: int = 3,
    rewards: tuple[RewardTerm[Any], ...] | list[RewardTerm[Any]] = (),
    **settings: Any,
) -> GymEnvironment:
    return GymEnvironment(GymSettings(id=env_id, num_envs=count, **settings), rewards, seed=7)


def actions_for(env: GymEnvironment, steps: int) -> list[np.ndarray]:
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(steps)]


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_it_does_what_the_environments_do_one_by_one(vectorization: str) -> None:
    with closing(make(vectorization=vectorization)) as env:
        observations, _ = env.reset()
        alone = [Room() for _ in range(3)]
        begun = [0, 0, 0]
        expected = [room.reset(seed=episode_seed(7, i, 0))[0] for i, room in enumerate(alone)]
        for actions in actions_for(env, 40):
            observations, reward, terminated, truncated, infos = env.step(actions)
            assert env.observation_space.contains(observations)
            for i, room in enumerate(alone):
                expected[i], *rest, _ = room.step(np.int64(actions[i]))
                assert (reward[i], terminated[i], truncated[i]) == tuple(rest)
                if any(rest[1:]):
                    assert infos["_final_obs"][i]
                    np.testing.assert_array_equal(
                        infos["final_obs"]["view"][i], expected[i]["view"]
                    )
                    begun[i] += 1
                    expected[i], _ = room.reset(seed=episode_seed(7, i, begun[i]))
                elif infos:
                    assert not infos["_final_obs"][i]
                np.testing.assert_array_equal(observations["view"][i], expected[i]["view"])
                np.testing.assert_array_equal(
                    observations["place"][i], expected[i]["place"].astype(np.float32)
                )
                assert observations["door"][i].argmax() == expected[i]["door"]
        assert min(begun) > 5


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_the_latest_observations_are_seen_as_one(vectorization: str) -> None:
    with (
        closing(make(vectorization=vectorization, frame_stack=3)) as env,
        closing(make()) as alone,
    ):
        one, _ = alone.reset()
        seen, _ = env.reset()
        past = {name: [values] * 3 for name, values in one.items()}
        for actions in actions_for(env, 30):
            assert env.observation_space.contains(seen)
            assert_same(seen, {k: np.concatenate(v, axis=-1) for k, v in past.items()})
            seen, *_, infos = env.step(actions)
            one, *_, expected = alone.step(actions)
            ended = expected.get("_final_obs", np.zeros(3, bool))
            for name, now in one.items():
                frames = past[name]
                if ended.any():
                    last = np.concatenate([*frames[1:], expected["final_obs"][name]], axis=-1)
                    assert_same(infos["final_obs"][name][ended], last[ended])
                past[name] = [*frames[1:], now]
                for frame in frames[1:]:  # of the episodes before
                    frame[ended] = now[ended]


def test_every_episode_has_a_seed_of_its_own() -> None:
    runs = (0, 1, 2, 2**32, 2**32 + 1)  # the last two are evaluations
    seeds = {episode_seed(s, i, e) for s in runs for i in range(5) for e in range(40)}
    assert len(seeds) == 1000
    assert all(0 <= seed < 2**31 for seed in seeds)


def test_observations_that_were_handed_out_stay_as_they_were() -> None:
    env = make()
    first, _ = env.reset()
    kept = {name: values.copy() for name, values in first.items()}
    for actions in actions_for(env, 3):
        env.step(actions)
    assert all(np.array_equal(values, kept[name]) for name, values in first.items())


def test_a_seed_given_to_reset_begins_anew() -> None:
    env = make()
    runs = []
    for seed in (3, 4, 3):
        env.reset(seed=seed)
        runs.append([env.step(actions)[0]["view"] for actions in actions_for(env, 20)])
    assert np.array_equal(runs[0], runs[2])
    assert not np.array_equal(runs[0], runs[1])
    with pytest.raises(ValueError, match=r"options .* are not supported"):
        env.reset(options={"low": 1})


# -- going on -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "vectorization", "module"),
    [
        ("ventosa_tests/Room-v0", "sync", None),
        ("ventosa_tests/Room-v0", "async", None),
        ("Blackjack-v1", "sync", None),
        ("Pendulum-v1", "sync", None),
        ("CartPole-v1", "sync", None),
        ("CartPole-v1", "async", None),
        ("Hopper-v5", "sync", "mujoco"),
        ("HalfCheetah-v5", "async", "mujoco"),
        ("LunarLanderContinuous-v3", "sync", "Box2D"),
    ],
)
def test_going_back_to_a_state_goes_on_to_the_last_bit(
    env_id: str, vectorization: str, module: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    if module is not None:
        pytest.importorskip(module)
    with (
        closing(make(env_id, 2, vectorization=vectorization)) as env,
        closing(make(env_id, 2, vectorization=vectorization)) as other,
    ):
        actions = actions_for(env, 300)
        last, _ = env.reset()
        for now in actions[:150]:
            last = env.step(now)[0]
        loaded = other.load_state_dict(env.state_dict())
        assert all(np.array_equal(values, last[name]) for name, values in loaded.items())
        for now in actions[150:]:
            assert_same(env.step(now), other.step(now))
        assert_same(env.state_dict(), other.state_dict())
    assert not caplog.records


def test_going_back_brings_back_the_observations_before_the_last() -> None:
    with closing(make(frame_stack=4)) as env, closing(make(frame_stack=4)) as other:
        *before, after = actions_for(env, 12)
        env.reset()
        for actions in before:
            seen = env.step(actions)[0]
        assert_same(other.load_state_dict(env.state_dict()), seen)
        assert_same(other.step(after), env.step(after))


def lose(env: GymEnvironment, index: int) -> None:
    assert isinstance(env._vector, ProcessVectorEnv)
    process = env._vector.processes[index]
    process.kill()
    process.join()


def test_an_episode_whose_process_was_lost_is_cut_off_where_it_was_seen_last() -> None:
    with closing(make(count=2, vectorization="async")) as env, closing(make(count=2)) as other:
        actions = actions_for(env, 60)
        last, _ = env.reset()
        while env._lengths[1] != 1:
            last = env.step(actions[0])[0]
        begun = int(env._begun[1])
        lose(env, 1)
        observations, reward, terminated, truncated, infos = env.step(actions[0])
        assert (reward[1], terminated[1], truncated[1]) == (0.0, False, True)
        assert infos["_final_obs"][1]
        for name, values in infos["final_obs"].items():
            np.testing.assert_array_equal(values[1], last[name][1])
        # The next one is the one that would have come next, here and wherever the run goes on.
        room, _ = Room().reset(seed=episode_seed(7, 1, begun))
        np.testing.assert_array_equal(observations["view"][1], room["view"])
        other.load_state_dict(env.state_dict())
        for now in actions:
            assert_same(env.step(now), other.step(now))


def test_an_environment_that_is_started_again_has_its_number_in_the_run() -> None:
    with closing(make(count=2, vectorization="async")) as env:
        env.number_from(3)
        env.reset()
        begun = int(env._begun[1])
        lose(env, 1)
        observations = env.step(actions_for(env, 1)[0])[0]
        room, _ = Room().reset(seed=episode_seed(7, 3 + 1, begun))
        np.testing.assert_array_equal(observations["view"][1], room["view"])


def test_a_first_episode_whose_process_was_lost_begins_again() -> None:
    with closing(make(count=2, vectorization="async")) as env, closing(make(count=2)) as other:
        lose(env, 0)
        assert_same(env.reset()[0], other.reset()[0])
        assert_same(env.state_dict(), other.state_dict())


def test_an_episode_whose_process_was_lost_is_no_success() -> None:
    gymnasium.register("ventosa_tests/Telling-v0", entry_point=Telling)
    try:
        env = make("ventosa_tests/Telling-v0", 2, vectorization="async")
        with closing(env):
            env.reset()
            steps = np.zeros(2, int)
            while "episode_metrics" not in env.step(steps)[4]:
                pass
            lose(env, 0)
            infos = env.step(steps)[4]
            assert infos["_final_obs"].tolist()[0]
            assert not infos["episode_metrics"]["success"][0]
    finally:
        del gymnasium.registry["ventosa_tests/Telling-v0"]


def assert_same(one: Any, other: Any) -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        one, other = list(one.values()), list(other.values())
    if isinstance(one, (list, tuple)):
        for part, counterpart in zip(one, other, strict=True):
            assert_same(part, counterpart)
    else:
        np.testing.assert_array_equal(one, other)


def test_a_state_holds_no_more_actions_than_the_longest_running_episode() -> None:
    env = make()
    env.reset()
    for actions in actions_for(env, 50):
        env.step(actions)
        state = env.state_dict()
        assert len(state["actions"]) == state["lengths"].max() < ROOM_STEPS


def test_a_state_is_not_changed_by_what_follows() -> None:
    env = make()
    env.reset()
    actions = actions_for(env, 30)
    for now in actions[:15]:
        env.step(now)
    state = env.state_dict()
    first = [env.step(now) for now in actions[15:]]
    env.load_state_dict(state)
    assert_same(first, [env.step(now) for now in actions[15:]])


def test_an_environment_that_can_not_be_played_again_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    env = make(kwargs={"trouble": "forgetful"})
    env.reset()
    env.load_state_dict(env.state_dict())
    assert "'ventosa_tests/Room-v0' did not come back to where it was" in caplog.text


class Endless(gymnasium.Env[Any, Any]):
    """Sees its seed, less what it holds in no float, and its steps; one of two has an end."""

    observation_space = Box(0.0, np.inf, (2,), np.float32)
    action_space = Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.seen = np.array([int(seed or 0) % 1000, 0], np.float32)
        self.ends = seed != episode_seed(7, 0, 0)
        return self.seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.seen = self.seen + np.array([0, 1])
        return self.seen.astype(np.float32), 0.0, False, self.ends and self.seen[1] == 4, {}


@pytest.fixture
def endless(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(vector_env, "LONGEST_REPLAY_STEPS", 5)
    gymnasium.register("ventosa_tests/Endless-v0", entry_point=Endless)
    yield "ventosa_tests/Endless-v0"
    del gymnasium.registry["ventosa_tests/Endless-v0"]


def test_the_actions_of_an_endless_episode_are_given_up(
    endless: str, caplog: pytest.LogCaptureFixture
) -> None:
    env, other = make(endless, 2), make(endless, 2)
    env.reset()
    kept = []
    for actions in actions_for(env, 50):
        env.step(actions)
        kept.append(len(env._history.actions))
    assert kept[:9] == [1, 2, 3, 4, 5, 2, 3, 0, 1]  # the second one's fourth step ends its episode
    assert max(kept[9:]) == 3
    state = env.state_dict()
    assert state["lengths"].tolist() == [50, 2]
    assert len(state["actions"]) == 2
    loaded = other.load_state_dict(state)["observation"]
    begun = [episode_seed(7, 0, 1) % 1000, 0.0]  # the next episode of the first environment
    assert loaded.tolist() == [begun, state["observations"]["observation"][1].tolist()]
    assert "episodes of 1 of 2 environments" in caplog.text
    assert "longer than 5 steps" in caplog.text
    assert "did not come back" not in caplog.text
    assert other.state_dict()["lengths"].tolist() == [0, 2]
    assert other.state_dict()["begun"].tolist() == [2, 13]
    # From there on it goes on exactly.
    third = make(endless, 2)
    third.load_state_dict(other.state_dict())
    for actions in actions_for(env, 4):
        assert_same(third.step(actions), other.step(actions))


# -- settings -------------------------------------------------------------------------------------


def test_settings_reach_the_environment() -> None:
    env = make("Pendulum-v1", 2, kwargs={"g": 0.0}, max_episode_steps=5)
    env.reset()
    ends = [env.step(np.zeros((2, 1), np.float32))[3].all() for _ in range(10)]
    assert ends == [False] * 4 + [True] + [False] * 4 + [True]
    assert env.single_action_space == Box(-2.0, 2.0, (1,), np.float32)


def test_any_observation_can_be_flattened() -> None:
    env = make("Blackjack-v1", 2, flatten_observations=True)
    assert env.single_observation_space["observation"].shape == (32 + 11 + 2,)
    assert env.observation_space.contains(env.reset()[0])


class Differing(gymnasium.Env[Any, Any]):
    """Its observations are of a space that is given, or of as many numbers as were made before."""

    action_space = Discrete(2)
    made = itertools.count(1)

    def __init__(self, space: Any = None):
        self.observation_space = space or Box(0.0, 1.0, (next(self.made),))


def test_what_gymnasium_can_not_flatten_or_put_side_by_side_is_named() -> None:
    gymnasium.register("ventosa_tests/Differing-v0", entry_point=Differing)
    sequences = {"kwargs": {"space": Sequence(Discrete(2))}}
    try:
        with pytest.raises(ValueError, match=r"^flatten_obs.* no vector.*Sequence.*wraps"):
            make("ventosa_tests/Differing-v0", flatten_observations=True, **sequences)
        with pytest.raises(ValueError, match=r"^3 of '.*Differing-v0' can't be .*: RuntimeError: "):
            make("ventosa_tests/Differing-v0")
    finally:
        del gymnasium.registry["ventosa_tests/Differing-v0"]


@pytest.mark.parametrize("vectorization", ["sync", "async"])
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"id": "Pendulm-v1"}, r"^id: .* no environment 'Pendulm-v1'; did you mean 'Pendulum-v1'"),
        ({"id": "CartPole-v9"}, r"no environment 'CartPole-v9'; did you mean 'CartPole-v1'"),
        ({"id": "ALE/Breakout-v5"}, r"no environment 'ALE/Breakout-v5'; .*MODULE:ID"),
        ({"id": "no_such_module:Env-v0"}, r"lacks a package: No module named 'no_such_module'"),
        ({"id": "two words"}, r"'two words' can't be made: .*Malformed environment ID"),
        (
            {"id": "Pendulum-v1", "kwargs": {"gravity": 1}},
            r"'Pendulum-v1' can't be made with kwargs \{'gravity': 1\}: .*argument 'gravity'",
        ),
        (
            {"id": "ventosa_tests/Text-v0"},
            r"'word': no encoder takes the space Text.*flatten_observations: true",
        ),
    ],
)
def test_what_can_not_be_made_is_the_users_mistake(
    settings: dict[str, Any], message: str, vectorization: Any
) -> None:
    spaces = {"space": Dict({"word": Text(3)})}
    gymnasium.register("ventosa_tests/Text-v0", entry_point=Differing, kwargs=spaces)
    try:
        with pytest.raises(ValueError, match=message):
            GymEnvironment(GymSettings(vectorization=vectorization, **settings), [])
    finally:
        del gymnasium.registry["ventosa_tests/Text-v0"]


@pytest.mark.parametrize(
    ("env_id", "module", "missing", "extra"),
    [
        ("Hopper-v5", "gymnasium.envs.mujoco.mujoco_env", "mujoco", "mujoco"),
        ("LunarLander-v3", "gymnasium.envs.box2d.lunar_lander", "Box2D", "box2d"),
    ],
)
def test_a_missing_package_is_named_with_what_installs_it(
    monkeypatch: pytest.MonkeyPatch, env_id: str, module: str, missing: str, extra: str
) -> None:
    package = module.rpartition(".")[0]
    for name in list(sys.modules):
        if name.startswith(package) or name.partition(".")[0] == missing:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ValueError, match=rf"'{env_id}' lacks a package.*'ventosa\[{extra}\]'"):
        make(env_id)


# -- rewards --------------------------------------------------------------------------------------


class Diary:
    """A reward that keeps what it is shown; pays 1 in the first environment, 2 in the second."""

    snapshot = GymTransition

    def __init__(self) -> None:
        self.shown: list[GymTransition] = []

    def __call__(self, transition: GymTransition) -> np.ndarray:
        self.shown.append(transition)
        return np.arange(1.0, len(transition.rewards) + 1.0)


def own_reward(weight: float) -> RewardTerm[GymTransition]:
    return RewardTerm("environment", weight, EnvironmentReward(EnvironmentReward.Settings()))


def test_the_reward_is_the_weighted_sum_of_the_terms() -> None:
    plain, env = make(), make(rewards=[own_reward(0.5), RewardTerm("diary", -3.0, Diary())])
    plain.reset()
    env.reset()
    for actions in actions_for(env, 20):
        expected = plain.step(actions)
        observations, reward, *ends, infos = env.step(actions)
        terms = infos.pop("reward_terms")
        np.testing.assert_array_equal(terms["environment"], 0.5 * expected[1])
        np.testing.assert_array_equal(terms["diary"], [-3.0, -6.0, -9.0])
        np.testing.assert_array_equal(reward, terms["environment"] + terms["diary"])
        assert_same([observations, *ends, infos], [expected[0], *expected[2:]])
    assert_same(env.state_dict(), plain.state_dict())


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_a_reward_sees_what_one_environment_by_itself_does(vectorization: Any) -> None:
    """With infos and observations of the very step, even where it ended an episode."""
    diary = Diary()
    with closing(
        make(rewards=[RewardTerm("diary", 1.0, diary)], vectorization=vectorization)
    ) as env:
        env.reset()
        actions = actions_for(env, 20)
        for now in actions:
            env.step(now)
    assert len(diary.shown) == 20
    for i in range(3):
        room, begun, ends = Room(), 0, 0
        before, _ = room.reset(seed=episode_seed(7, i, begun))
        for shown, now in zip(diary.shown, actions, strict=True):
            after, reward, terminated, truncated, info = room.step(np.int64(now[i]))
            np.testing.assert_array_equal(shown.observations["view"][i], before["view"])
            np.testing.assert_array_equal(shown.next_observations["view"][i], after["view"])
            assert shown.actions[i] == now[i]  # as the environment counts them
            assert (shown.rewards[i], shown.terminated[i], shown.truncated[i]) == (
                reward,
                terminated,
                truncated,
            )
            assert shown.infos["sum"][i] == info["sum"]
            assert shown.infos["_sum"].all()
            assert set(shown.infos) == {"sum", "_sum", "nested", "_nested"}
            assert shown.infos["nested"]["steps"][i] == info["nested"]["steps"]
            before = after
            if terminated or truncated:
                begun, ends = begun + 1, ends + 1
                before, _ = room.reset(seed=episode_seed(7, i, begun))
        assert ends > 2


def test_without_rewards_no_infos_are_gathered() -> None:
    env = make()
    env.reset()
    seen = [set(env._vector.step(env._act(now))[4]) for now in actions_for(env, 10)]
    assert seen[0] == set()
    assert {"sum", "_sum"}.isdisjoint(set().union(*seen))


def test_going_on_with_rewards_is_exact() -> None:
    terms = [own_reward(1.0), RewardTerm("diary", 0.1, Diary())]
    env, other = make(rewards=terms), make(rewards=terms)
    env.reset()
    actions = actions_for(env, 30)
    for now in actions[:15]:
        env.step(now)
    other.load_state_dict(env.state_dict())
    for now in actions[15:]:
        assert_same(env.step(now), other.step(now))


def test_a_reward_for_another_snapshot_is_refused() -> None:
    touch = ventosa_rewards()["touch"]
    term = RewardTerm("touch", 1.0, touch(touch.Settings()))  # type: ignore[attr-defined]
    with pytest.raises(
        ValueError, match=r"'touch' is computed from a GraspTransition, .* a GymTransition: leave"
    ):
        make("CartPole-v1", rewards=[term])


# -- success --------------------------------------------------------------------------------------


class Telling(gymnasium.Env[Any, Any]):
    """Episodes of 2, 3 and 2 steps in turn, of which the second is a success.

    Args:
        tells: in each info, at the end of an episode, at that of a success alone, or never.
        word: what says that it is one.
    """

    observation_space = Box(0.0, 9.0, (1,), np.float32)
    action_space = Discrete(2)

    def __init__(self, tells: str = "always", word: Any = True):
        self.tells, self.word, self.episode = tells, word, -1

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode, self.steps = self.episode + 1, 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        ends, good = self.steps == 2 + self.episode % 2, self.episode == 1
        told = {"always": True, "end": ends, "success": ends and good}.get(self.tells, False)
        info = {"is_success": type(self.word)(self.word if ends and good else 0)} if told else {}
        return np.full(1, self.steps, np.float32), 0.0, ends, False, info


@pytest.mark.parametrize("vectorization", ["sync", "async"])
@pytest.mark.parametrize(
    ("tells", "word", "expected"),
    [
        ("always", True, [False, True, False]),
        ("end", 1.0, [False, True, False]),
        ("end", np.bool_(True), [False, True, False]),
        ("success", True, [None, True, False]),
        ("never", True, [None, None, None]),
    ],
)
@pytest.mark.parametrize("rewards", [[], [own_reward(1.0)]])
def test_what_gymnasium_calls_is_success_is_success(
    tells: str, word: Any, expected: list[Any], rewards: Any, vectorization: str
) -> None:
    gymnasium.register("ventosa_tests/Telling-v0", entry_point=Telling)
    kwargs = {"tells": tells, "word": word}
    made = {"rewards": rewards, "vectorization": vectorization, "kwargs": kwargs}
    try:
        env = make("ventosa_tests/Telling-v0", 2, **made)
    finally:
        del gymnasium.registry["ventosa_tests/Telling-v0"]
    with closing(env):
        env.reset()
        infos = [env.step(np.zeros(2, int))[4] for _ in range(7)]
    ends = [infos[step] for step in (1, 4, 6)]
    metrics = [info.get("episode_metrics", {}).get("success") for info in ends]
    assert [m if m is None else m.tolist() for m in metrics] == [
        e if e is None else [e, e] for e in expected
    ]
    assert not any("episode_metrics" in infos[step] for step in (0, 2, 3, 5))


# -- arrays of the environment's own --------------------------------------------------------------


class Reusing(gymnasium.Env[Any, Any]):
    """Hands out the same array each time, and scales in place the action that it is given."""

    observation_space = Box(-np.inf, np.inf, (1,), np.float64)
    action_space = Box(-10.0, 10.0, (1,), np.float64)

    def __init__(self) -> None:
        self.seen = np.zeros(1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.seen[:] = 0.0
        self.steps = 0
        return self.seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        action *= 0.5
        self.seen += action
        self.steps += 1
        return self.seen, 0.0, False, self.steps == 5, {"seen": self.seen}


@pytest.fixture
def reusing() -> Iterator[str]:
    gymnasium.register("ventosa_tests/Reusing-v0", entry_point=Reusing)
    yield "ventosa_tests/Reusing-v0"
    del gymnasium.registry["ventosa_tests/Reusing-v0"]


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_the_last_observation_is_not_overwritten_by_the_reset(
    reusing: str, vectorization: Any
) -> None:
    diary = Diary()
    rewards = [RewardTerm("diary", 1.0, diary)]
    with closing(make(reusing, 2, rewards, vectorization=vectorization)) as env:
        env.reset()
        for _ in range(5):
            observations, *_, infos = env.step(np.array([[2.0], [4.0]]))
    assert infos["final_obs"]["observation"].tolist() == [[5.0], [10.0]]
    assert observations["observation"].tolist() == [[0.0], [0.0]]
    assert diary.shown[-1].next_observations["observation"].tolist() == [[5.0], [10.0]]
    assert diary.shown[-1].infos["seen"].tolist() == [[5.0], [10.0]]


class Sharing(Reusing):
    """Hands out one array that all the environments of a process write to."""

    shared = np.zeros(1)

    def __init__(self) -> None:
        self.seen = self.shared


def test_environments_that_share_an_array_see_their_own_observations() -> None:
    gymnasium.register("ventosa_tests/Sharing-v0", entry_point=Sharing)
    try:
        env, other = (make("ventosa_tests/Sharing-v0", 3) for _ in range(2))
    finally:
        del gymnasium.registry["ventosa_tests/Sharing-v0"]
    env.reset()
    # Each environment adds half of its action to what is in the array that all of them have.
    observations, *_ = env.step(np.array([[2.0], [4.0], [6.0]]))
    assert observations["observation"].tolist() == [[1.0], [3.0], [6.0]]
    # Played again, each begins with a reset of the array.
    loaded = other.load_state_dict(env.state_dict())
    assert loaded["observation"].tolist() == [[1.0], [2.0], [3.0]]


def test_an_action_written_to_is_played_again_as_it_was(reusing: str) -> None:
    env, other = make(reusing, 2), make(reusing, 2)
    env.reset()
    actions = np.array([[2.0], [4.0]])
    for _ in range(3):
        env.step(actions)
    state = env.state_dict()
    assert actions.tolist() == [[2.0], [4.0]]
    assert state["actions"].tolist() == [[[2.0], [4.0]]] * 3
    for _ in range(2):  # and playing them again changes nothing, either
        assert other.load_state_dict(state)["observation"].tolist() == [[3.0], [6.0]]
    assert other.state_dict()["actions"].tolist() == [[[2.0], [4.0]]] * 3


def test_an_action_that_a_reward_writes_to_is_played_again_as_it_was(reusing: str) -> None:
    def scaled(transition: GymTransition) -> np.ndarray:
        transition.actions[:] = -9.0
        return np.zeros(2)

    env, other = make(reusing, 2, [RewardTerm("scaled", 1.0, scaled)]), make(reusing, 2)
    env.reset()
    actions = np.array([[2.0], [4.0]])
    for _ in range(3):
        observations, *_ = env.step(actions)
    assert actions.tolist() == [[2.0], [4.0]]
    assert observations["observation"].tolist() == [[3.0], [6.0]]
    state = env.state_dict()
    assert state["actions"].tolist() == [[[2.0], [4.0]]] * 3
    assert_same(other.load_state_dict(state), observations)


# -- failures -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("vectorization", "trouble", "message"),
    [
        (
            "sync",
            "error",
            "Room-v0' failed in step 2 of its episode 1: RuntimeError: the room coll",
        ),
        ("async", "error", "Room-v0' failed in step 2 of its episode 1: RuntimeError: the room co"),
        ("async", "death", r"Room-v0': its process \d+ was killed by SIGKILL .* asked to step"),
    ],
)
def test_an_environment_that_breaks_down_is_named_and_can_be_closed(
    vectorization: str, trouble: str, message: str
) -> None:
    strict = {"vectorization": vectorization, "max_lifetime_restarts": 0}
    env = make(**strict, kwargs={"trouble": trouble})
    env.reset()
    actions = actions_for(env, 2)
    env.step(actions[0])
    with pytest.raises(EnvironmentFailure, match=message):
        env.step(actions[1])
    env.close()
    processes = getattr(env._vector, "processes", ())
    assert not any(process.is_alive() for process in processes)


def test_processes_leave_ctrl_c_to_the_learner() -> None:
    with closing(make(vectorization="async")) as env:
        env.reset()
        for process in env._vector.processes:  # type: ignore[union-attr]
            os.kill(process.pid, signal.SIGINT)
        for actions in actions_for(env, 3):
            env.step(actions)


def test_there_are_only_so_many_processes() -> None:
    GymSettings(id="CartPole-v1", num_envs=1025)
    with pytest.raises(ValueError, match=r"num_envs 1025 .* 1024 at most, or vectorization: sync"):
        GymSettings(id="CartPole-v1", num_envs=1025, vectorization="async")
