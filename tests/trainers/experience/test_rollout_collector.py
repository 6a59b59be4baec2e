"""Collecting experience, on scripts whose outcome was worked out by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from pydantic import BaseModel
from torch import Tensor, nn

from encoders.spaces import DepthImage
from trainers.common.share import Share
from trainers.experience.env_runner import EnvRunner
from trainers.experience.reward_normalizer import RewardNormalizer
from trainers.experience.rollout import Rollout
from trainers.experience.rollout_collector import RolloutCollector, SampledActions
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import Observations
from trainers.networks.recurrent import Sequences
from trainers.runfile.settings import Component

MakeFactory = Callable[..., NetworkFactory]
POSITION = Box(-np.inf, np.inf, (1,), np.float32)
CPU = torch.device("cpu")
PLAIN = gymnasium.spaces.Dict({"x": POSITION})


class Probe(nn.Module):
    """Encodes a depth image as its first pixel in metres, and remembers which it was shown."""

    features_dim = 1
    shown: list[int]

    class Settings(BaseModel, frozen=True, extra="forbid"):
        pass

    def __init__(self, space: Any, settings: Any):
        super().__init__()
        self.shown = []

    def forward(self, raw: Tensor) -> Tensor:
        pixel = raw.float()[:, 0, 0]
        self.shown += pixel.flatten().int().tolist()
        return pixel / 1000.0


def collector_on(
    env: Any, make_factory: MakeFactory, steps: int, **settings: Any
) -> tuple[RolloutCollector, ActorCritic]:
    torch.manual_seed(0)
    probe = {"depth": Component("probe", Probe, Probe.Settings())}
    space = env.single_observation_space.spaces
    encoders = probe if "depth" in space else {}
    bare = PolicySettings(num_layers=0, **settings)
    policy = ActorCritic(make_factory(space, encoders), bare)
    env_runner = EnvRunner(env)
    env_runner.reset()
    generator = torch.Generator().manual_seed(0)
    return RolloutCollector(policy, env_runner, steps, generator, CPU), policy


def value_is(policy: ActorCritic, slope: float, intercept: float) -> None:
    with torch.no_grad():
        policy.value_head.weight.fill_(slope)
        policy.value_head.bias.fill_(intercept)


def columns(*rows: list[float]) -> np.ndarray:
    """The rows of each environment as an array (T, N, 1)."""
    return np.array(rows).T[..., None]


def test_truncated_episodes_go_on_in_value_and_terminated_ones_do_not(
    scripted: Any, make_factory: MakeFactory
) -> None:
    nan = np.nan
    env = scripted(
        PLAIN,
        {"x": columns([1, 2, 3, 4], [10, 20, 30, 40])},
        reward=[[1, 4], [2, 5], [3, 6]],
        truncated=[[0, 0], [1, 0], [0, 0]],
        terminated=[[0, 0], [0, 1], [0, 0]],
        final={"x": columns([nan, 0.5, nan], [nan, 100, nan])},
    )
    collector, policy = collector_on(env, make_factory, 3, critic="separate")
    value_is(policy, 2.0, 1.0)  # V(x) = 2 x + 1
    rollout = collector.collect(gamma=0.5, lambd=0.5)
    # First environment: V = 3, 5, 7 and at last 9; the second step truly led to V(0.5) = 2.
    #   A_2 = 3 + 9 / 2 - 7 = 0.5    A_1 = 2 + 2 / 2 - 5 = -2    A_0 = 1 + 5 / 2 - 3 - 2 / 4 = 0
    # Second: V = 21, 41, 61 and at last 81; nothing follows the second step.
    #   A_2 = 6 + 81 / 2 - 61 = -14.5    A_1 = 5 - 41 = -36    A_0 = 4 + 41 / 2 - 21 - 36 / 4 = -5.5
    assert rollout.values.tolist() == [3, 21, 5, 41, 7, 61]
    assert rollout.advantages.tolist() == [0, -5.5, -2, -36, 0.5, -14.5]
    assert rollout.returns.tolist() == [3, 15.5, 3, 5, 7.5, 46.5]
    assert rollout.vectors["x"].flatten().tolist() == [1, 10, 2, 20, 3, 30]


def test_normalized_rewards_are_for_the_learner_alone(
    scripted: Any, make_factory: MakeFactory
) -> None:
    env = scripted(
        PLAIN,
        {"x": columns([0, 0, 0])},
        reward=[[2], [6]],
        truncated=[[0], [1]],
        final={"x": columns([0, 0])},
    )
    torch.manual_seed(0)
    policy = ActorCritic(make_factory(PLAIN.spaces), PolicySettings(num_layers=0))
    value_is(policy, 0.0, 0.0)
    env_runner = EnvRunner(env)
    env_runner.reset()
    normalizer = RewardNormalizer(1, gamma=0.0)
    generator = torch.Generator().manual_seed(0)
    collector = RolloutCollector(policy, env_runner, 2, generator, CPU, normalizer)
    rollout = collector.collect(gamma=0.0, lambd=0.0)
    assert rollout.returns.tolist() == pytest.approx([1.0, 3.0])  # the deviation of 2 and 6 is 2
    assert env_runner.pop_finished().rewards.tolist() == [8.0]
    other = RolloutCollector(policy, env_runner, 2, generator, CPU, RewardNormalizer(1, 0.0))
    other.load_state_dict(collector.state_dict())
    normalizers = [c.state_dict()["reward_normalizer"] for c in (other, collector)]
    assert normalizers[0] == normalizers[1]


def test_an_end_that_is_both_counts_as_terminated(scripted: Any, make_factory: MakeFactory) -> None:
    env = scripted(
        PLAIN,
        {"x": columns([1, 2])},
        reward=[[3]],
        truncated=[[1]],
        terminated=[[1]],
        final={"x": columns([50])},
    )
    collector, policy = collector_on(env, make_factory, 1)
    value_is(policy, 1.0, 0.0)
    values: list[int] = []
    policy.register_forward_hook(lambda *_: values.append(1))
    with pytest.MonkeyPatch.context() as patch:
        value = policy.value
        patch.setattr(policy, "value", lambda seen, *known: values.append(1) or value(seen, *known))
        rollout = collector.collect(gamma=0.5, lambd=0.5)
    assert rollout.advantages.tolist() == [2.0]  # 3 - V(1)
    assert len(values) == 1  # of what follows the last step; that of the end has no meaning


def test_a_collection_goes_on_where_the_one_before_ended(
    scripted: Any, make_factory: MakeFactory
) -> None:
    env = scripted(PLAIN, {"x": columns([0, 1, 2, 3, 4])}, reward=np.zeros((4, 1)))
    collector, _ = collector_on(env, make_factory, 2)
    first, second = collector.collect(0.9, 0.9), collector.collect(0.9, 0.9)
    assert first.vectors["x"].flatten().tolist() == [0, 1]
    assert second.vectors["x"].flatten().tolist() == [2, 3]
    assert first.vectors["x"].flatten().tolist() == [0, 1]


def test_the_environment_gets_the_clipped_actions_and_the_rollout_the_drawn_ones(
    scripted: Any, make_factory: MakeFactory
) -> None:
    env = scripted(PLAIN, {"x": np.zeros((51, 2, 1))}, reward=np.zeros((50, 2)))
    collector, _ = collector_on(env, make_factory, 50, initial_std=3.0)
    rollout = collector.collect(0.9, 0.9)
    drawn = rollout.actions.numpy().reshape(50, 2, 1)
    assert np.abs(drawn).max() > 3
    np.testing.assert_array_equal(np.stack(env.actions_taken), drawn.clip(-1, 1))


CAMERA = gymnasium.spaces.Dict({"depth": DepthImage(2, 2, (0.5, 60.0)), "x": POSITION})


def depth(*rows: list[int]) -> np.ndarray:
    """Flat images in millimetres, of each environment, as an array (T, N, 2, 2, 1)."""
    return np.ones((1, 1, 2, 2, 1)) * np.array(rows).T[..., None, None, None]


def camera_script(scripted: Any) -> Any:
    """Three environments with 5, 2 and 3 distinct images in five steps and the look after them."""
    images = depth(
        [1000, 2000, 3000, 4000, 5000, 5000],
        [40000, 40000, 40000, 50000, 50000, 50000],
        [7000, 7000, 8000, 8000, 9000, 9000],
    )
    same = [[0, 1, 1], [0, 1, 0], [0, 0, 1], [0, 1, 0], [1, 1, 1]]
    ends = [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1], [0, 0, 0]]
    return scripted(
        CAMERA,
        {"depth": images, "x": np.random.default_rng(0).normal(size=(6, 3, 1))},
        reward=np.arange(15.0).reshape(5, 3),
        truncated=ends,
        same_frame=same,
        final={"depth": images[:-1], "x": np.ones((5, 3, 1))},
    )


def in_turn(rollout: Rollout) -> Iterator[list[int]]:
    """The pixels of each step's images in metres."""
    pixels = rollout.frames["depth"].float()[:, 0, 0, 0].int() // 1000
    yield from pixels[rollout.frame_index].reshape(-1, 3).tolist()


@pytest.mark.parametrize("memory", [None, {}])
def test_each_distinct_frame_is_stored_and_encoded_once(
    scripted: Any, make_factory: MakeFactory, memory: Any
) -> None:
    settings = {"critic": "separate", "critic_observations": ("x",), "memory": memory}
    collector, policy = collector_on(camera_script(scripted), make_factory, 5, **settings)
    rollout = collector.collect(0.9, 0.9)
    assert len(rollout.frames["depth"]) == 5 + 2 + 3
    (probe,) = policy.actor.frame_encoders.values()
    assert isinstance(probe, Probe)
    everything = [1000, 2000, 3000, 4000, 5000, 7000, 8000, 9000, 40000, 50000]
    assert sorted(probe.shown) == everything
    assert list(in_turn(rollout)) == [
        [1, 40, 7],
        [2, 40, 7],
        [3, 40, 8],
        [4, 50, 8],
        [5, 50, 9],
    ]


def test_frames_are_encoded_anew_in_the_next_collection(
    scripted: Any, make_factory: MakeFactory
) -> None:
    settings = {"critic": "separate", "critic_observations": ("x",)}
    collector, policy = collector_on(camera_script(scripted), make_factory, 2, **settings)
    (probe,) = policy.actor.frame_encoders.values()
    assert isinstance(probe, Probe)
    collector.collect(0.9, 0.9)
    probe.shown.clear()
    rollout = collector.collect(0.9, 0.9)  # the encoder may have changed: 40 m is shown again
    assert sorted(probe.shown) == [3000, 4000, 8000, 40000, 50000]
    assert list(in_turn(rollout)) == [[3, 40, 8], [4, 50, 8]]


def is_what_the_policy_says(rollout: Rollout, policy: ActorCritic, rows: Tensor) -> None:
    """Checks what was kept of some transitions against the policy of now."""
    distribution, values = policy(rollout.observations(rows))
    log_probs = distribution.log_prob(rollout.actions[rows])
    torch.testing.assert_close(log_probs, rollout.log_probs[rows], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(values, rollout.values[rows], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("critic", ["shared", "separate"])
def test_what_was_kept_is_what_the_policy_says_of_the_stored_observations(
    scripted: Any, make_factory: MakeFactory, critic: str
) -> None:
    collector, policy = collector_on(camera_script(scripted), make_factory, 5, critic=critic)
    rollout = collector.collect(0.9, 0.9)
    shuffled = torch.randperm(len(rollout), generator=torch.Generator().manual_seed(3))
    is_what_the_policy_says(rollout, policy, shuffled)
    assert rollout.values.unique().numel() == len(rollout)


def test_a_critic_with_eyes_values_the_image_that_an_episode_ended_with(
    scripted: Any, make_factory: MakeFactory
) -> None:
    space = gymnasium.spaces.Dict({"depth": DepthImage(2, 2, (0.5, 60.0))})
    env = scripted(
        space,
        {"depth": depth([1000, 5000], [2000, 2000])},
        reward=[[0, 0]],
        truncated=[[1, 0]],
        same_frame=[[0, 1]],
        final={"depth": depth([50000], [60000])},
    )
    collector, policy = collector_on(env, make_factory, 1, critic="separate")
    value_is(policy, 1.0, 0.0)  # V = the depth in metres
    rollout = collector.collect(gamma=0.5, lambd=1.0)
    assert rollout.advantages.tolist() == [0.5 * 50 - 1, 0.5 * 2 - 2]


def test_the_same_seed_draws_the_same_actions(scripted: Any, make_factory: MakeFactory) -> None:
    first, second = (
        collector_on(camera_script(scripted), make_factory, 5)[0].collect(0.9, 0.9)
        for _ in range(2)
    )
    assert torch.equal(first.actions, second.actions)
    assert len(first.actions.unique()) == 15


# -- memory --------------------------------------------------------------------------------------

STEPS, COUNT = 14, 3


def episodes_of_many_lengths(scripted: Any) -> Any:
    """Environments whose episodes end in all ways, one of them right where a collection ends."""
    rng = np.random.default_rng(0)
    terminated, truncated = rng.random((2, STEPS, COUNT)) < 0.15
    terminated[:, 2] = truncated[:, 2] = False  # one that never ends
    truncated[6, 0] = True
    return scripted(
        PLAIN,
        {"x": rng.normal(size=(STEPS + 1, COUNT, 1))},
        reward=rng.normal(size=(STEPS, COUNT)),
        terminated=terminated,
        truncated=truncated,
        final={"x": rng.normal(size=(STEPS, COUNT, 1))},
    )


def memory_of(kind: str, length: int = 99) -> dict[str, Any]:
    return {"type": kind, "memory_size": 5, "sequence_length": length}


MEMORIES = pytest.mark.parametrize(
    ("kind", "critic"),
    [("lstm", "shared"), ("lstm", "separate"), ("gru", "shared"), ("gru", "separate")],
)


@MEMORIES
@pytest.mark.parametrize("length", [1, 3, 99])
def test_sequences_run_again_from_their_stored_states_say_what_was_kept(
    scripted: Any, make_factory: MakeFactory, kind: str, critic: str, length: int
) -> None:
    memory = memory_of(kind, length)
    collector, policy = collector_on(
        episodes_of_many_lengths(scripted), make_factory, STEPS // 2, critic=critic, memory=memory
    )
    generator = torch.Generator().manual_seed(0)
    for _ in range(2):
        rollout = collector.collect(0.9, 0.9)
        for size in (4, len(rollout)):
            for rows, _ in rollout.minibatches(size, generator):
                is_what_the_policy_says(rollout, policy, rows)
        is_what_the_policy_says(rollout, policy, rollout.in_shuffle_groups().rows)
        forgotten = policy(Observations({}, rollout.vectors))[1]
        assert not torch.allclose(forgotten, rollout.values, atol=1e-3)


@MEMORIES
def test_memory_begins_with_an_episode_and_goes_on_through_collections(
    scripted: Any, make_factory: MakeFactory, kind: str, critic: str
) -> None:
    env = episodes_of_many_lengths(scripted)
    collector, policy = collector_on(
        env, make_factory, STEPS // 2, critic=critic, memory=memory_of(kind)
    )
    rollouts = [collector.collect(gamma=0.5, lambd=0.0) for _ in range(2)]
    for number in range(COUNT):
        state = torch.zeros(1, policy.state_size)
        for t in range(STEPS):
            rollout, row = rollouts[t // 7], (t % 7) * COUNT + number
            assert_near(rollout.hidden_states[row], state[0])
            observation = seen(env.script["x"][t, number], state)
            with torch.no_grad():
                _, value, state = policy.step(observation)
                following = policy.value(seen(env.script["x"][t + 1, number], state))
                if env.truncated[t, number]:  # what it truly led to, and with what it remembers
                    following = policy.value(seen(env.final["x"][t, number], state))
            if env.terminated[t, number]:
                following = torch.zeros(1)
            assert_near(rollout.values[row], value[0])
            # A = r + V(next) / 2 - V, with lambda 0
            delta = env.reward[t, number] + 0.5 * following[0] - value[0]
            assert_near(rollout.advantages[row], delta.float())
            if env.terminated[t, number] or env.truncated[t, number]:
                state = torch.zeros_like(state)
    assert (rollouts[1].hidden_states[0] == 0).all()  # its episode was cut off at the very end
    assert (rollouts[1].hidden_states[2] != 0).all()


def seen(x: np.ndarray, state: Tensor) -> Observations:
    """One observation, and what is remembered before it."""
    return Observations({}, {"x": torch.from_numpy(x)[None]}, None, Sequences.single(state))


def assert_near(answer: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(answer, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("length", [2, 99])
def test_with_memory_too_a_frame_is_kept_once(
    scripted: Any, make_factory: MakeFactory, length: int
) -> None:
    memory = memory_of("gru", length)
    collector, policy = collector_on(camera_script(scripted), make_factory, 5, memory=memory)
    rollout = collector.collect(0.9, 0.9)
    (probe,) = policy.actor.frame_encoders.values()
    assert isinstance(probe, Probe)
    probe.shown.clear()
    is_what_the_policy_says(rollout, policy, rollout.in_shuffle_groups().rows)
    assert len(probe.shown) == len(set(probe.shown)) == 5 + 2 + 3


def test_without_memory_there_is_nothing_to_remember(
    scripted: Any, make_factory: MakeFactory
) -> None:
    collector, policy = collector_on(camera_script(scripted), make_factory, 5)
    rollout = collector.collect(0.9, 0.9)
    assert rollout.hidden_states.shape == (15, 0)
    assert torch.equal(rollout.shuffle_groups, rollout.frame_index)
    assert policy.initial_state(3).shape == (3, 0)


@pytest.mark.parametrize("antithetic", [True, False])
def test_every_second_step_mirrors_the_noise_of_the_one_before(
    make_factory: MakeFactory, antithetic: bool
) -> None:
    policy = ActorCritic(make_factory(PLAIN.spaces), PolicySettings(num_layers=0, initial_std=2.0))
    generator, everywhere = torch.Generator().manual_seed(0), Share.whole(500)
    behavior = SampledActions(policy, generator, everywhere, antithetic=antithetic)

    def noise(x: float) -> Tensor:
        observations = Observations({}, {"x": torch.full((500, 1), x)}, None)
        acted = behavior.act(observations, policy.encode_frames({}))
        return acted.output.draws - acted.output.distribution.mode()

    with torch.no_grad():
        behavior.begin()
        first, mirrored, second = noise(0.0), noise(3.0), noise(0.0)
        behavior.begin()
        third = noise(0.0)
    assert torch.allclose(first, -mirrored, atol=1e-5) == antithetic
    for one, other in ((first, second), (second, third)):
        assert abs(float((one * other).mean())) < 1.0  # 4 of the same; its deviation is 0.18
    assert float(mirrored.std()) == pytest.approx(2.0, rel=0.2)
