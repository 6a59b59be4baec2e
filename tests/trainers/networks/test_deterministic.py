"""The networks of deterministic policies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch import nn

from trainers.networks.deterministic import (
    DeterministicActorCritic,
    DeterministicPolicy,
    DeterministicSettings,
)
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import Observations

JOINTS = Box(-9.0, 9.0, (3,), np.float32)


def networks(
    make_factory: Callable[..., NetworkFactory], **settings: Any
) -> DeterministicActorCritic:
    torch.manual_seed(0)
    return DeterministicActorCritic(
        make_factory({"joints": JOINTS}),
        DeterministicSettings(hidden_units=16, num_layers=2, **settings),
    )


@pytest.mark.parametrize("part", ["actor", "critic"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_hidden_layers_calculate_in_the_precision_and_heads_in_float32(
    make_factory: Callable[..., NetworkFactory], part: str, precision: str
) -> None:
    online = networks(make_factory, precision=precision)
    layers = [m for m in getattr(online, part).modules() if isinstance(m, nn.Linear)]
    dtypes: list[torch.dtype] = []
    for layer in layers:
        layer.register_forward_hook(lambda _, __, outputs: dtypes.append(outputs.dtype))
    observations = Observations({}, {"joints": torch.randn(5, 3)})
    actions = online.act(observations)
    values = online.value(observations, actions)
    assert dtypes == [getattr(torch, precision)] * 2 + [torch.float32]
    assert actions.dtype == values.dtype == torch.float32
    values.sum().backward()
    assert all(layer.weight.grad.dtype == torch.float32 for layer in layers)


def test_lower_precision_moves_values_by_little_and_keeps_the_weights_names(
    make_factory: Callable[..., NetworkFactory],
) -> None:
    exact, lowered = (networks(make_factory, precision=p) for p in ("float32", "bfloat16"))
    lowered.load_state_dict(exact.state_dict())
    assert {"actor.0.weight", "actor.4.bias", "critic.4.weight"} <= exact.state_dict().keys()
    observations = Observations({}, {"joints": torch.randn(200, 3)})
    actions = torch.rand(200, 1) * 2 - 1
    values, others = (n.value(observations, actions) for n in (exact, lowered))
    error = (values - others).abs().max()
    assert 0 < error < 0.02 * values.abs().max()  # eight bits of a mantissa, three layers


def test_targets_see_the_same_statistics_wherever_the_policy_went(
    make_factory: Callable[..., NetworkFactory],
) -> None:
    settings = DeterministicSettings(hidden_units=4, normalize=True)
    policy = DeterministicPolicy(make_factory({"joints": JOINTS}), settings, tau=0.1)
    policy.float()  # buffers of float64 are replaced, as all are on the way to another device
    policy.update_statistics({"joints": torch.tensor([[3.0, 5.0, 7.0], [5.0, 5.0, 9.0]])})
    means = [values.tolist() for name, values in policy.named_buffers() if name.endswith("mean")]
    assert means == [[4.0, 5.0, 8.0]] * 4  # actor and critic, online and target


def test_exploration_is_told_in_the_units_of_the_space(
    make_factory: Callable[..., NetworkFactory],
) -> None:
    actions = Box(np.array([-2.0, 0.0], np.float32), np.array([1.0, 8.0], np.float32))
    factory = make_factory({"joints": JOINTS}, action_space=actions)
    settings = DeterministicSettings(hidden_units=4)
    policy = DeterministicPolicy(factory, settings, tau=0.1, final_sigma=0.01)
    np.testing.assert_allclose(policy.exploration_std(), [0.015, 0.04], rtol=1e-6)
    observations = Observations({}, {"joints": torch.zeros(20_000, 3)})
    with torch.no_grad():
        drawn, _ = policy.act(observations, deterministic=False, generator=torch.Generator())
    np.testing.assert_allclose(drawn.std(0), policy.exploration_std(), rtol=0.03)
