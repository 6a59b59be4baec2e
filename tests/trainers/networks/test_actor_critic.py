"""The actor and the critic."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Tuple
from pydantic import ValidationError
from torch import nn

from encoders.conv import Conv
from encoders.spaces import RgbImage
from trainers.common.errors import NonFiniteError, UserError
from trainers.networks.action_models import GaussianActions
from trainers.networks.actions import to_environment
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.distributions import Categorical, DiagonalGaussian
from trainers.networks.factory import NetworkFactory
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.observations import Observations
from trainers.networks.recurrent import Sequences
from trainers.runfile.settings import Component

MakeFactory = Callable[..., NetworkFactory]
JOINTS, PRIVILEGED = Box(-9.0, 9.0, (3,), np.float32), Box(-9.0, 9.0, (2,), np.float32)
SPACE: dict[str, gymnasium.Space[Any]] = {
    "eye": RgbImage(6, 6),
    "joints": JOINTS,
    "privileged": PRIVILEGED,
}
CONV = {"eye": Component("conv", Conv, Conv.Settings(layers=((4, 3, 1),)))}
SIZES = {"hidden_units": 8, "num_layers": 1}


def some_observations(count: int, index: torch.Tensor | None = None) -> Observations:
    torch.manual_seed(1)
    frames = {"eye": torch.randint(0, 256, (count, 6, 6, 3), dtype=torch.uint8)}
    rows = count if index is None else len(index)
    vectors = {"joints": torch.randn(rows, 3), "privileged": torch.randn(rows, 2)}
    return Observations(frames, vectors, index)


def make_policy(make_factory: MakeFactory, **settings: Any) -> ActorCritic:
    torch.manual_seed(0)
    return ActorCritic(make_factory(SPACE, CONV), PolicySettings(**(SIZES | settings)))


def gaussian(policy: ActorCritic) -> GaussianActions:
    assert isinstance(policy.action_model, GaussianActions)
    return policy.action_model


def replaced(observations: Observations, name: str, by: torch.Tensor) -> Observations:
    return Observations(
        observations.frames, observations.vectors | {name: by}, observations.frame_index
    )


SEPARATE = {"critic": "separate", "critic_observations": ("privileged",)}


@pytest.mark.parametrize(
    "settings", [{}, {"critic": "separate"}, SEPARATE, {"critic_observations": None}]
)
def test_privileged_observations_never_reach_the_policy(
    make_factory: MakeFactory, settings: dict[str, Any]
) -> None:
    policy = make_policy(make_factory, **settings)
    observations = some_observations(4)
    privileged = observations.vectors["privileged"].requires_grad_()
    joints = observations.vectors["joints"].requires_grad_()
    distribution, values = policy(observations)
    action = distribution.log_prob(torch.ones(4, 1)).sum()
    gradients = torch.autograd.grad(
        action, [joints, privileged], allow_unused=True, retain_graph=True
    )
    assert gradients[0] is not None
    assert gradients[0].abs().sum() > 0
    assert gradients[1] is None
    ablated = replaced(observations, "privileged", torch.full((4, 2), 9.0))
    assert torch.equal(policy.distribution(ablated).mean, distribution.mean)
    if settings == SEPARATE:
        assert not torch.equal(policy.value(ablated), values)
        gradients = torch.autograd.grad(values.sum(), [joints, privileged], allow_unused=True)
        assert gradients[0] is None
        assert gradients[1].abs().sum() > 0
    else:
        assert torch.equal(policy.value(ablated), values)


def test_a_policy_sees_what_it_is_told_to(make_factory: MakeFactory) -> None:
    policy = make_policy(make_factory, actor_observations=("privileged",))
    observations = some_observations(3)
    before = policy.distribution(observations).mean
    other = replaced(observations, "joints", torch.full((3, 3), 9.0))
    assert torch.equal(policy.distribution(other).mean, before)
    other = replaced(observations, "privileged", torch.full((3, 2), 9.0))
    assert not torch.equal(policy.distribution(other).mean, before)


def test_a_shared_critic_trains_the_encoders_and_a_separate_one_does_not(
    make_factory: MakeFactory,
) -> None:
    for critic, reached in (("shared", True), ("separate", False)):
        policy = make_policy(make_factory, critic=critic)
        policy.value(some_observations(3)).sum().backward()
        touched = [parameter.grad is not None for parameter in policy.actor.parameters()]
        assert touched == [reached] * len(touched)
        assert policy.action_head.weight.grad is None


@pytest.mark.parametrize("settings", [{}, SEPARATE, {"memory": {}}, {**SEPARATE, "memory": {}}])
def test_actor_and_critic_share_out_all_parameters(
    make_factory: MakeFactory, settings: dict[str, Any]
) -> None:
    policy = make_policy(make_factory, **settings)
    actor, critic = list(policy.actor_parameters()), list(policy.critic_parameters())
    both = [id(parameter) for parameter in actor + critic]
    assert len(both) == len(set(both))
    assert set(both) == {id(parameter) for parameter in policy.parameters()}
    assert any(parameter is policy.value_head.weight for parameter in critic)
    assert any(parameter is gaussian(policy).log_std for parameter in actor)


@pytest.mark.parametrize("settings", [{}, {"critic": "separate"}])
def test_values_alone_actions_alone_and_both_agree(
    make_factory: MakeFactory, settings: dict[str, Any]
) -> None:
    policy = make_policy(make_factory, **settings)
    observations = some_observations(2, torch.tensor([1, 0, 1]))
    distribution, values = policy(observations)
    assert torch.equal(policy.value(observations), values)
    assert torch.equal(policy.distribution(observations).mean, distribution.mean)
    known = policy.encode_frames(observations.frames)
    rows = observations.frame_index
    assert known.actor is not None
    cached = FrameFeatures(known.actor[rows], None if known.critic is None else known.critic[rows])
    without_frames = Observations({}, observations.vectors)
    distribution_again, values_again = policy(without_frames, cached)
    assert torch.equal(distribution_again.mean, distribution.mean)
    assert torch.equal(values_again, values)


def remembering(make_factory: MakeFactory, **settings: Any) -> tuple[ActorCritic, Observations]:
    """A policy with an LSTM of 4 units, and two sequences of three and one observations for it."""
    policy = make_policy(make_factory, memory={"type": "lstm", "memory_size": 4}, **settings)
    observations = some_observations(2, torch.tensor([1, 0, 1, 1]))
    sequences = Sequences(torch.tensor([3, 1]), torch.randn(2, policy.state_size))
    return policy, replace(observations, sequences=sequences)


@pytest.mark.parametrize(("settings", "size"), [({}, 8), ({"critic": "separate"}, 16)])
def test_with_memory_values_alone_actions_alone_and_both_agree(
    make_factory: MakeFactory, settings: dict[str, Any], size: int
) -> None:
    policy, observations = remembering(make_factory, **settings)
    assert policy.initial_state(5).tolist() == torch.zeros(5, size).tolist()
    distribution, values, state = policy.step(observations)
    assert state.shape == (2, size)
    assert torch.equal(policy.value(observations), values)
    assert torch.equal(policy.distribution(observations).mean, distribution.mean)
    assert torch.equal(policy(observations)[1], values)
    forgetful = replace(observations, sequences=None)
    first = replace(observations, sequences=Sequences.single(policy.initial_state(4)))
    assert torch.equal(policy.value(forgetful), policy.value(first))
    assert not torch.isclose(policy.value(forgetful), values).any()


def test_a_separate_critic_remembers_by_itself(make_factory: MakeFactory) -> None:
    policy, observations = remembering(make_factory, **SEPARATE)
    distribution, values, state = policy.step(observations)
    sequences = observations.sequences
    assert sequences is not None
    for part, same in ((slice(0, 8), (False, True)), (slice(8, 16), (True, False))):
        other = sequences.hidden_state.clone()
        other[:, part] += 1.0
        changed = replace(observations, sequences=replace(sequences, hidden_state=other))
        distribution_now, values_now, _ = policy.step(changed)
        assert (
            torch.equal(distribution_now.mean, distribution.mean),
            torch.equal(values_now, values),
        ) == same
    ablated = replace(
        observations,
        vectors=observations.vectors | {"privileged": torch.full((4, 2), 9.0)},
    )
    state_now = policy.step(ablated)[2]
    assert torch.equal(state_now[:, :8], state[:, :8])
    assert not torch.isclose(state_now[:, 8:], state[:, 8:]).any()


def test_features_are_replaced_row_by_row() -> None:
    old = FrameFeatures(torch.zeros(3, 2), torch.zeros(3, 1))
    fresh = FrameFeatures(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([[5.0], [6.0]]))
    mixed = old.with_rows(torch.tensor([2, 0]), fresh)
    assert mixed.actor is not None
    assert mixed.critic is not None
    assert mixed.actor.tolist() == [[3.0, 4.0], [0.0, 0.0], [1.0, 2.0]]
    assert mixed.critic.flatten().tolist() == [6.0, 0.0, 5.0]
    assert old.actor is not None
    assert old.actor.sum() == 0  # the rollout's earlier steps may still use them
    assert old.with_rows(torch.tensor([0]), FrameFeatures(None, None)).actor is None


def test_continuous_actions_start_near_zero_with_the_asked_for_spread(
    make_factory: MakeFactory,
) -> None:
    policy = make_policy(make_factory, initial_std=0.25)
    distribution = policy.distribution(some_observations(5))
    assert isinstance(distribution, DiagonalGaussian)
    assert distribution.mean.shape == (5, 1)
    assert distribution.mean.abs().max() < 0.1
    assert distribution.log_std.exp().tolist() == pytest.approx([0.25])


def test_the_spread_never_falls_below_its_least(make_factory: MakeFactory) -> None:
    policy = make_policy(make_factory, initial_std=0.5, min_std=0.1)
    learned = gaussian(policy).log_std
    assert learned is not None
    with torch.no_grad():
        learned.fill_(-20.0)
    distribution = policy.distribution(some_observations(2))
    assert isinstance(distribution, DiagonalGaussian)
    assert distribution.log_std.exp().tolist() == pytest.approx([0.1])


@pytest.mark.parametrize("std", [0.001, 0.25, 1.0, 3.0])
def test_a_spread_that_begins_at_its_least_is_fixed(make_factory: MakeFactory, std: float) -> None:
    policy = make_policy(make_factory, initial_std=std, min_std=std)
    distribution = policy.distribution(some_observations(2))
    assert isinstance(distribution, DiagonalGaussian)
    assert torch.equal(distribution.log_std, torch.full((1,), math.log(std)))
    (-distribution.log_prob(torch.ones(2, 1)).mean()).backward()
    learned = gaussian(policy).log_std
    assert learned is not None
    assert learned.grad is None
    assert policy.action_head.weight.grad is not None


@pytest.mark.parametrize("trainer_type", ["ppo", "trpo"])
def test_no_update_moves_a_fixed_spread(
    make_algorithm: Callable[..., Any], trainer_type: str
) -> None:
    algorithm = make_algorithm(trainer_type, network={"initial_std": 0.3, "min_std": 0.3})
    before = {name: values.clone() for name, values in algorithm.policy.state_dict().items()}
    algorithm.collect()
    statistics = algorithm.update(0.0)
    after = algorithm.policy.state_dict()
    assert torch.equal(after["action_model.log_std"], before["action_model.log_std"])
    assert not torch.equal(after["action_head.weight"], before["action_head.weight"])
    # H = A (log sigma + (1 + log 2 pi) / 2) of two dimensions
    entropy = 2 * (math.log(0.3) + (1 + math.log(2 * math.pi)) / 2)
    assert statistics["Policy/Entropy"] == pytest.approx(entropy)


def test_discrete_actions_start_nearly_uniform(make_factory: MakeFactory) -> None:
    torch.manual_seed(0)
    factory = make_factory({"joints": JOINTS}, action_space=Discrete(4))
    policy = ActorCritic(factory, PolicySettings(**SIZES))
    observations = Observations({}, {"joints": torch.randn(6, 3)})
    distribution = policy.distribution(observations)
    assert isinstance(distribution, Categorical)
    entropy = distribution.entropy()
    assert entropy.shape == (6,)
    assert entropy.min() > math.log(4) - 0.01


@pytest.mark.parametrize(
    "space",
    [
        Box(-1.0, 1.0, (2, 2), np.float32),
        Box(-1.0, 1.0, (), np.float32),
        MultiDiscrete([[2, 3], [4, 5]]),
        MultiBinary((2, 2)),
        Tuple([Discrete(2), Discrete(3)]),
    ],
)
def test_other_action_spaces_are_the_users_mistake(
    make_factory: MakeFactory, space: gymnasium.Space[Any]
) -> None:
    with pytest.raises(UserError, match="are not supported; a Box, a MultiDiscrete"):
        ActorCritic(make_factory({"joints": JOINTS}, action_space=space), PolicySettings(**SIZES))


@pytest.mark.parametrize("key", ["actor_observations", "critic_observations"])
def test_unknown_observations_name_their_key_and_the_nearest(
    make_factory: MakeFactory, key: str
) -> None:
    settings = PolicySettings(**SIZES, critic="separate", **{key: ("privilege",)})
    with pytest.raises(UserError) as caught:
        ActorCritic(make_factory(SPACE, CONV), settings)
    assert f"trainer.network_settings.{key}: " in str(caught.value)
    assert "no observation 'privilege'; did you mean 'privileged'?" in str(caught.value)


@pytest.mark.parametrize("key", ["actor_observations", "critic_observations"])
def test_nobody_sees_nothing(key: str) -> None:
    with pytest.raises(ValidationError, match=f"{key}\\n.* at least 1 item"):
        PolicySettings(critic="separate", **{key: ()})


def test_an_environment_that_keeps_everything_for_a_critic_is_refused(
    make_factory: MakeFactory,
) -> None:
    factory = make_factory({"privileged": SPACE["privileged"]})
    with pytest.raises(UserError) as caught:
        ActorCritic(factory, PolicySettings(**SIZES))
    assert str(caught.value) == (
        "trainer.network_settings.actor_observations: the environment keeps all its observations "
        "for a critic, so name those that the policy sees: privileged"
    )
    named = PolicySettings(**SIZES, actor_observations=("privileged",))
    assert ActorCritic(factory, named).sees == ("privileged",)


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValidationError, match="critic_observations needs critic: separate"):
        PolicySettings(critic_observations=("privileged",))
    with pytest.raises(ValidationError, match=r"min_std 0\.5 is over initial_std 0\.1"):
        PolicySettings(initial_std=0.1, min_std=0.5)


def test_statistics_reach_the_actor_and_the_critic(make_factory: MakeFactory) -> None:
    policy = make_policy(make_factory, normalize=True, **SEPARATE)
    observations = some_observations(8)
    policy.update_statistics(observations.vectors)
    counts = {name: int(b) for name, b in policy.named_buffers() if name.endswith("count")}
    assert sorted(counts.values()) == [8, 8]
    assert {name.split(".")[0] for name in counts} == {"actor", "critic"}
    assert isinstance(policy.critic, nn.Module)


def test_actions_are_clipped_to_the_box_and_left_alone_otherwise() -> None:
    space = Box(np.array([-1.0, 0.0]), np.array([1.0, 0.5]), dtype=np.float64)
    actions = torch.tensor([[-3.0, -3.0], [0.5, 0.25], [3.0, 3.0]])
    assert to_environment(actions, space).tolist() == [[-1.0, 0.0], [0.5, 0.25], [1.0, 0.5]]
    assert to_environment(torch.tensor([2, 0]), Discrete(3)).tolist() == [2, 0]


def test_actions_that_are_nan_never_reach_an_environment() -> None:
    space = Box(-1.0, 1.0, (2,))
    assert to_environment(torch.tensor([[math.inf, 0.0]]), space).tolist() == [[1.0, 0.0]]
    with pytest.raises(NonFiniteError, match="the policy's actions are NaN"):
        to_environment(torch.tensor([[0.0, 0.0], [math.nan, 0.0]]), space)
