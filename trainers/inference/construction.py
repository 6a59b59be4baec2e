"""From settings to what builds networks: the encoder of each observation, by the run file."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral
from typing import Any, TypeVar

import gymnasium
from pydantic import BaseModel
from torch import Tensor, nn

from encoders.spaces import PointCloud
from trainers.common.errors import UserError, first_lines
from trainers.networks.factory import NetworkFactory
from trainers.networks.network import NetworkSettings
from trainers.networks.observations import is_frame
from trainers.networks.policy_network import PolicyNetwork
from trainers.runfile.registry import PluginError, Registry
from trainers.runfile.settings import Component
from trainers.saving.serialization import mismatch

Model = TypeVar("Model", bound=BaseModel)

DEFAULT_IMAGE_ENCODER = "simple"
DEFAULT_CLOUD_ENCODER = "pointnet"
DEFAULT_VECTOR_ENCODER = "vector"


def network_factory(
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.Space[Any],
    privileged: frozenset[str],
    encoders: Mapping[str, Component],
    registry: Registry,
) -> NetworkFactory:
    """Factory of the networks of a run, or of a saved policy.

    Args:
        observation_space: of one environment.
        action_space: of one environment.
        privileged: names of the observations that only a critic may see.
        encoders: the run file's, by the name of the observation.
        registry: of encoders, where that of an observation which the run file does not mention is
            found.

    Raises:
        UserError: the run file names an observation that there is not.

    What it builds raises a PluginError for an encoder without a `features_dim`.
    """

    def build_encoder(
        name: str, space: gymnasium.Space[Any], settings: NetworkSettings
    ) -> nn.Module:
        component = encoders.get(name) or _default_encoder(space, settings, registry)
        try:
            encoder: nn.Module = component.cls(space, component.settings)
        except ValueError as error:
            raise UserError(f"encoders.{name} ({component.name}): {error}") from error
        size = getattr(encoder, "features_dim", None)
        if not (isinstance(size, Integral) and int(size) > 0):
            raise PluginError(
                registry.get(component.name).origin,
                f"encoder '{component.name}': its features_dim is {size!r}, and should be a whole "
                "number over 0: how many features there are",
            )
        return encoder

    factory = NetworkFactory(observation_space, action_space, build_encoder, privileged)
    for name in encoders:
        factory.check_name(name, "encoders")
    return factory


def load_weights(network: PolicyNetwork, weights: Mapping[str, Tensor]) -> None:
    """Gives a network saved weights, if they are its own, of now or of before.

    Raises:
        ValueError: they have other names, shapes or types, or are not finite.
    """
    current = network.current_weights(weights)
    if wrong := mismatch(current, network.state_dict(), "weights"):
        raise ValueError(wrong)
    try:
        network.load_state_dict(current)
    except RuntimeError as error:
        raise ValueError(first_lines(error, 3)) from error
    check_weights(network)


def check_weights(network: nn.Module) -> None:
    """Raises ValueError where a parameter is not finite; what else a network keeps may be so."""
    for name, parameter in network.named_parameters():
        if not parameter.isfinite().all():
            raise ValueError(f"{name} has values that are not finite")


def in_float32(settings: Model) -> Model:
    """Settings whose networks calculate in float32 throughout, with the same weights.

    Args:
        settings: of an encoder or an algorithm: what says bfloat16 in them, or in a part of them,
            is changed.
    """
    changed: dict[str, Any] = {}
    for name, value in settings:
        if isinstance(value, BaseModel):
            changed[name] = in_float32(value)
        elif value == "bfloat16":
            changed[name] = "float32"
    return settings.model_copy(update=changed)


def _default_encoder(
    space: gymnasium.Space[Any], settings: NetworkSettings, registry: Registry
) -> Component:
    if isinstance(space, PointCloud):
        name = DEFAULT_CLOUD_ENCODER
    else:
        name = DEFAULT_IMAGE_ENCODER if is_frame(space) else DEFAULT_VECTOR_ENCODER
    entry = registry.get(name)
    options = {} if is_frame(space) else {"normalize": settings.normalize}
    return Component(name, entry.cls, entry.settings(**options))
