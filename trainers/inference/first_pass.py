"""The first observations through the networks, once: what a plugin gives is held against its word.

A wrong shape or type would otherwise be found deep in what is not the plugin's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from envs.environment import Environment
from trainers.common.origin import Origin, blaming
from trainers.networks.network import Network, evaluation_mode
from trainers.networks.observations import Observations, to_tensors
from trainers.networks.policy_network import PolicyNetwork
from trainers.networks.recurrent import Sequences
from trainers.runfile.registry import PluginError, Registries, Registry
from trainers.runfile.settings import RunSettings

ROWS = 2


@torch.no_grad()
def check_first_pass(
    policy: PolicyNetwork,
    env: Environment,
    observations: Mapping[str, NDArray[Any]],
    *,
    run: RunSettings,
    registries: Registries,
) -> None:
    """Checks what environment, encoders and policy give, by the first observations (N, ...).

    Raises:
        PluginError: one of them gives other shapes or types than it says.
        PluginFailure: an installed plugin's encoder or policy fails.
    """
    _check_observations(env, observations, run.environment.name, registries.environments)
    rows = np.arange(min(ROWS, env.num_envs))
    device = next(policy.parameters()).device
    seen = to_tensors(observations, env.single_observation_space, device, rows)
    with evaluation_mode(policy):
        for network in policy.modules():
            if isinstance(network, Network):
                _check_encoders(network, seen, registries.encoders)
        origin = registries.trainers.get(run.trainer.name).origin
        _check_policy(policy, seen, env.single_action_space, run.trainer.name, origin)


def _check_observations(
    env: Environment, observations: Mapping[str, NDArray[Any]], name: str, registry: Registry
) -> None:
    for key, space in env.single_observation_space.spaces.items():
        found = np.asarray(observations[key]) if key in observations else None
        wanted = (env.num_envs, *(space.shape or ()))
        if found is None or found.shape != wanted or found.dtype != space.dtype:
            raise PluginError(
                registry.get(name).origin,
                f"environment '{name}': the observation '{key}' is {_described(found)}, and by its "
                f"space {wanted} {space.dtype}",
            )


def _check_encoders(network: Network, seen: Observations, registry: Registry) -> None:
    encoders = (*network.frame_encoders.items(), *network.vector_encoders.items())
    raw = {**seen.frames, **seen.vectors}
    for observation, encoder in encoders:
        name, origin = _named(encoder, registry)
        with blaming(origin):
            features = encoder(raw[observation])
        wanted = (len(raw[observation]), encoder.features_dim)
        if _described(features) != f"{wanted} float32":
            raise PluginError(
                origin,
                f"encoder '{name}' makes {_described(features)} of the observation "
                f"'{observation}', {_described(raw[observation])}; by its features_dim they should "
                f"be {wanted} float32",
            )


def _named(encoder: nn.Module, registry: Registry) -> tuple[str, Origin]:
    """The name and the origin that an encoder is registered with."""
    entries = registry.entries.items()
    return next((name, entry.origin) for name, entry in entries if entry.cls is type(encoder))


def _check_policy(
    policy: PolicyNetwork,
    seen: Observations,
    space: gymnasium.Space[Any],
    name: str,
    origin: Origin,
) -> None:
    count = len(next(iter({**seen.frames, **seen.vectors}.values())))
    with blaming(origin):
        hidden_state = policy.initial_state(count)
        observations = Observations(
            {key: frames for key, frames in seen.frames.items() if key in policy.sees},
            {key: vectors for key, vectors in seen.vectors.items() if key in policy.sees},
            sequences=Sequences.single(hidden_state) if policy.state_size else None,
        )
        generator = torch.Generator(hidden_state.device)
        actions, after = policy.act(observations, deterministic=False, generator=generator)
    wanted = (count, *(space.shape or ()))
    is_continuous = np.issubdtype(space.dtype, np.floating)
    if _shape(actions) != wanted or actions.is_floating_point() != is_continuous:
        kind = "numbers" if is_continuous else "whole numbers"
        raise PluginError(
            origin,
            f"trainer '{name}': its policy's actions for {count} observations are "
            f"{_described(actions)}, and should be {wanted} {kind} for {space}",
        )
    if _shape(after) != (count, policy.state_size):
        raise PluginError(
            origin,
            f"trainer '{name}': its policy's hidden states after {count} observations are "
            f"{_described(after)}, and by its state_size {(count, policy.state_size)}",
        )


def _shape(value: Any) -> tuple[int, ...] | None:
    return tuple(value.shape) if isinstance(value, Tensor) else None


def _described(value: Any) -> str:
    """Shape and type of an array or a tensor, or what else it is."""
    if not isinstance(value, Tensor | np.ndarray):
        return "missing" if value is None else type(value).__name__
    return f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
