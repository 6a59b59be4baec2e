"""From a last layer to actions of every space, and of what former policies said."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from pydantic import ValidationError
from torch import Tensor

from trainers.common.errors import UserError
from trainers.inference.construction import load_weights
from trainers.networks.action_models import (
    ActionModel,
    GaussianActions,
    GaussianSettings,
    action_model,
)
from trainers.networks.actions import ActionScaling, to_environment
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.distributions import DiagonalGaussian, MultiCategorical, TanhGaussian
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import Observations

MakeFactory = Callable[..., NetworkFactory]
INF = np.inf
UNEQUAL = Box(np.array([-400.0, 0.0]), np.array([400.0, 5.0]), dtype=np.float64)


def gaussian(space: Box, **settings: Any) -> GaussianActions:
    return GaussianActions(space, GaussianSettings(**settings))


def test_bounds_are_at_minus_one_and_one() -> None:
    draws = torch.tensor([[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0], [0.5, 2.0]])
    expected = [[-400.0, 0.0], [0.0, 2.5], [400.0, 5.0], [200.0, 7.5]]
    assert gaussian(UNEQUAL).actions(draws).tolist() == expected
    assert ActionScaling(UNEQUAL)(draws).tolist() == expected
    assert to_environment(gaussian(UNEQUAL).actions(draws), UNEQUAL)[3].tolist() == [200.0, 5.0]


def test_actions_within_one_of_zero_stay_what_they_are_to_the_last_bit() -> None:
    draws = torch.randn(1000, 3)
    assert torch.equal(gaussian(Box(-1.0, 1.0, (3,))).actions(draws), draws)


@pytest.mark.parametrize("most", [INF, np.finfo(np.float32).max])
def test_what_lacks_a_bound_stays_in_its_own_units(most: float) -> None:
    space = Box(np.array([-most, 0.0, -2.0]), np.array([most, most, 4.0]), dtype=np.float32)
    model, draws = gaussian(space), torch.tensor([[-3.0, -3.0, -3.0], [7.0, 7.0, 1.0]])
    assert model.actions(draws).tolist() == [[-3.0, -3.0, -8.0], [7.0, 7.0, 4.0]]
    assert to_environment(model.actions(draws), space).tolist() == [[-3, 0, -2], [7, 7, 4]]
    with pytest.raises(UserError, match=r"squash: tanh needs bounds.*Box.*leave it out"):
        gaussian(space, squash="tanh")
    with pytest.raises(UserError, match="a policy of bounded actions needs"):
        ActionScaling(space)


def test_squashed_actions_stay_within_their_bounds() -> None:
    model = gaussian(UNEQUAL, squash="tanh")
    distribution = model(torch.tensor([[0.0, math.atanh(0.6)]]))
    assert isinstance(distribution, TanhGaussian)
    assert model.actions(distribution.mode()).tolist()[0] == pytest.approx([0.0, 4.0])
    drawn = model.actions(100.0 * torch.randn(1000, 2))
    assert drawn.amin(0).tolist() == [-400.0, 0.0]
    assert drawn.amax(0).tolist() == [400.0, 5.0]


def test_a_deviation_that_depends_on_the_observation_is_said_by_the_network() -> None:
    model = gaussian(UNEQUAL, state_dependent_std=True, initial_std=0.5, min_std=0.1)
    assert model.outputs == 4
    assert not list(model.parameters())
    distribution = model(torch.tensor([[0.1, 0.2, 0.0, 0.0], [0.3, 0.4, -99.0, math.log(2.0)]]))
    assert isinstance(distribution, DiagonalGaussian)
    torch.testing.assert_close(distribution.mean, torch.tensor([[0.1, 0.2], [0.3, 0.4]]))
    # std = 0.1 + 0.4 exp(said)
    torch.testing.assert_close(distribution.log_std.exp(), torch.tensor([[0.5, 0.5], [0.1, 0.9]]))


def test_noise_is_known_in_the_environments_units_where_it_is_added_to_actions() -> None:
    std = gaussian(UNEQUAL, initial_std=0.5).exploration_std()
    assert std is not None
    torch.testing.assert_close(std, torch.tensor([200.0, 1.25]))
    assert gaussian(UNEQUAL, squash="tanh").exploration_std() is None
    assert gaussian(UNEQUAL, state_dependent_std=True).exploration_std() is None


@pytest.mark.parametrize(
    ("space", "sizes"),
    [
        (MultiDiscrete([3, 2], start=[1, 7]), (3, 2)),
        (MultiDiscrete([4]), (4,)),
        (MultiBinary(3), (2, 2, 2)),
    ],
)
def test_choices_of_all_numbers_are_drawn_as_the_space_has_them(
    space: gymnasium.Space[Any], sizes: tuple[int, ...]
) -> None:
    model = action_model(space, GaussianSettings())
    assert model.outputs == sum(sizes)
    distribution = model(torch.zeros(300, sum(sizes)))
    assert isinstance(distribution, MultiCategorical)
    assert distribution.entropy()[0].item() == pytest.approx(math.log(math.prod(sizes)))
    draws = model.actions(distribution.sample(torch.Generator().manual_seed(0)))
    taken = to_environment(draws, space)
    assert len(np.unique(taken, axis=0)) == math.prod(sizes)
    assert all(space.contains(row) for row in taken.astype(space.dtype))


@pytest.mark.parametrize("space", [Discrete(3), MultiDiscrete([3, 2]), MultiBinary(2)])
def test_a_gaussians_settings_are_refused_where_there_is_none(space: Any) -> None:
    for name, value in (("squash", "tanh"), ("state_dependent_std", True)):
        settings = GaussianSettings.model_validate({name: value})
        with pytest.raises(UserError, match=f"network_settings.{name}: is of continuous actions"):
            action_model(space, settings)
    with pytest.raises(UserError, match=r"bounded actions needs continuous.*use trainer_type: ppo"):
        ActionScaling(space)


def test_a_fixed_deviation_depends_on_nothing() -> None:
    with pytest.raises(ValidationError, match="state_dependent_std learns the deviation, which"):
        GaussianSettings(state_dependent_std=True, initial_std=0.3, min_std=0.3)


# -- policies of before --------------------------------------------------------------------------


def policy(make_factory: MakeFactory, space: Any, **settings: Any) -> ActorCritic:
    seen = {"x": Box(-1.0, 1.0, (3,), np.float32)}
    small = PolicySettings(hidden_units=8, num_layers=1, **settings)
    return ActorCritic(make_factory(seen, action_space=space), small)


def former(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights as they were saved before Gaussians were scaled."""
    names = {"action_model.log_std": "log_std"}
    return {names.get(k, k): v for k, v in weights.items() if "action_model.scale" not in k}


def test_a_policy_of_before_goes_on_in_the_environments_units(make_factory: MakeFactory) -> None:
    space = Box(-2.0, 2.0, (1,), np.float32)
    new, old = policy(make_factory, space), policy(make_factory, space)
    load_weights(old, former(new.state_dict()))
    observations = Observations({}, {"x": torch.randn(9, 3)})
    how: dict[str, Any] = {"deterministic": True, "generator": torch.Generator()}
    scaled, unscaled = (net.act(observations, **how)[0] for net in (new, old))
    torch.testing.assert_close(scaled, 2.0 * unscaled)
    assert isinstance(old.action_model, GaussianActions)
    assert isinstance(new.action_model, GaussianActions)
    stds = new.exploration_std(), old.exploration_std()
    assert [std.item() for std in stds if std is not None] == [2.0, 1.0]
    again = policy(make_factory, space)
    load_weights(again, old.state_dict())  # saved anew, it stays what it was
    torch.testing.assert_close(again.act(observations, **how)[0], unscaled)


@pytest.mark.parametrize("space", [Discrete(3), MultiBinary(2)])
def test_weights_of_choices_are_what_they_were(make_factory: MakeFactory, space: Any) -> None:
    weights = policy(make_factory, space).state_dict()
    assert former(weights).keys() == weights.keys()
    load_weights(policy(make_factory, space), weights)


def test_the_order_of_what_is_learned_is_that_of_former_optimizers(
    make_factory: MakeFactory,
) -> None:
    network = policy(make_factory, Box(-1.0, 1.0, (2,), np.float32))
    names = {id(parameter): name for name, parameter in network.named_parameters()}
    *_, weight, bias, log_std = (names[id(p)] for p in network.actor_parameters())
    assert (weight, bias) == ("action_head.weight", "action_head.bias")
    assert log_std == "action_model.log_std"
    assert isinstance(network.action_model, ActionModel)
