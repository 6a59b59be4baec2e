"""A policy by itself: loaded from a folder, asked for actions.

policy = Policy.load("results/run")
actions, state = policy.predict({"image": image})
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from envs.deployment import Deployment
from envs.environment import Environment
from trainers.common.devices import resolve_device
from trainers.common.errors import UserError
from trainers.inference.confidence import Confidence, Judgement, read_confidence
from trainers.inference.construction import in_float32, load_weights, network_factory
from trainers.inference.inputs import checked
from trainers.inference.metadata import Metadata, read_metadata
from trainers.networks.actions import to_environment
from trainers.networks.observations import Observations, to_tensors
from trainers.networks.policy_network import PolicyNetwork
from trainers.networks.recurrent import Sequences
from trainers.runfile.registry import load_registries, plugin_manager
from trainers.runfile.settings import Component, load_policy, load_run
from trainers.runfile.trust import check_imports
from trainers.saving.checkpoint import Loaded
from trainers.saving.run_folder import CONFIGURATION, find_checkpoint, run_folder

PLUGINS = ("encoders.plugin", "trainers.plugin")
"""Built-in plugins that a policy is made of; environments and rewards are not loaded."""


@dataclass(frozen=True)
class Answer:
    """First actions (B, ...), and how sure they are; without B for observations without it.

    Attributes:
        actions: as `Policy.predict` gives them.
        errors: (B,) expected, by the metric's name, in its own unit.
        probability: (B,) that all errors are within their limits.
        sure: (B,) bool; see `Policy.confidence`'s card for what that means.
    """

    actions: NDArray[Any]
    errors: dict[str, NDArray[np.float32]]
    probability: NDArray[np.float32]
    sure: NDArray[np.bool_]


class Policy:
    """A network and what goes in and comes out of it.

    Args:
        network: acts.
        observation_space: of one environment; every observation by its name.
        action_space: of one environment.
        seed: of what `predict` draws when it is not deterministic.
        confidence: tells how sure actions are; None: nobody knows.

    Attributes:
        observation_space: the observations that acting needs.
        action_space: of one environment.
        confidence: the same.
    """

    def __init__(
        self,
        network: PolicyNetwork,
        observation_space: gymnasium.spaces.Dict,
        action_space: gymnasium.Space[Any],
        seed: int = 0,
        confidence: Confidence | None = None,
    ):
        self.network, self.action_space = network, action_space
        self.confidence = confidence
        # As pairs, whose order gymnasium keeps; it would sort a dictionary.
        self.observation_space = gymnasium.spaces.Dict(
            [(name, observation_space[name]) for name in network.sees]
        )
        self._ignored = observation_space.spaces.keys() - set(network.sees)
        self._device = next(network.parameters()).device
        self._generator = torch.Generator(self._device).manual_seed(seed)

    @classmethod
    def load(
        cls,
        folder_or_run: str | Path,
        *,
        results_dir: str | Path = "results",
        device: str = "cpu",
        seed: int = 0,
        full_precision: bool = False,
    ) -> Self:
        """Loads an exported policy, a run (its best checkpoint) or a checkpoint's folder.

        Args:
            folder_or_run: a folder, or the id of a run in `results_dir`.
            results_dir: where runs are kept.
            device: torch's name of where the network is to be.
            seed: of what `predict` draws when it is not deterministic.
            full_precision: calculate in float32, even if it was trained with bfloat16.

        Raises:
            UserError: there is no such policy or device, it is damaged, a plugin that it needs is
                not installed here, or its weights don't fit.
        """
        found_device = resolve_device(device)
        loaded = find_checkpoint(str(folder_or_run), Path(results_dir))
        folder = run_folder(loaded.path)
        metadata = find_metadata(folder)
        network = _network(loaded, folder, metadata, full_precision).to(found_device).eval()
        confidence = read_confidence(loaded.path)
        return cls(
            network,
            metadata.observation_space,
            metadata.action_space,
            seed,
            None if confidence is None else confidence.to(found_device),
        )

    @torch.no_grad()
    def predict(
        self,
        observations: NDArray[Any] | Mapping[str, NDArray[Any]],
        state: NDArray[np.float32] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], NDArray[np.float32]]:
        """Chooses actions.

        Args:
            observations: those of `observation_space` by name, each of one environment or with a
                leading axis B; where there is only one, its array alone will do. What only a critic
                sees is left out, or ignored.
            state: what the last call returned; None where an episode begins, and zeros in the rows
                of episodes that begin. Only policies with memory look at it.
            deterministic: the policy's best action; or one drawn as at the end of training.

        Returns:
            Actions as the environment takes them, and the state (B, m) for the next call; without
            the leading axis for observations without it.

        Raises:
            ValueError: observations of the wrong name, shape or type, or a state of the wrong
                shape; the message names all of them, and what is expected.
            NonFiniteError: the network's actions are NaN.
        """
        tensors, is_single = self._tensors(observations, state)
        actions, after = self.network.act(
            tensors, deterministic=deterministic, generator=self._generator
        )
        chosen, next_state = to_environment(actions, self.action_space), after.cpu().numpy()
        return (chosen[0], next_state[0]) if is_single else (chosen, next_state)

    @torch.no_grad()
    def answer(self, observations: NDArray[Any] | Mapping[str, NDArray[Any]]) -> Answer:
        """Best actions where episodes begin, and how sure they are.

        Args:
            observations: see `predict`.

        Raises:
            UserError: nobody has learned how sure the policy is.
            ValueError: see `predict`.
        """
        if self.confidence is None:
            raise UserError(
                "how sure this policy is has not been learned: run "
                "`python -m trainers.calibrate POLICY`, and load it anew"
            )
        tensors, is_single = self._tensors(observations, None)
        actions, features = self._best(tensors)
        judged: Judgement = self.confidence(features)
        row = 0 if is_single else slice(None)
        names = [error.metric for error in self.confidence.card.estimated]
        return Answer(
            actions[row],
            {k: v[row] for k, v in zip(names, judged.errors.cpu().numpy().T, strict=True)},
            judged.probability.cpu().numpy()[row],
            judged.sure.cpu().numpy()[row],
        )

    @torch.no_grad()
    def first_actions(
        self, observations: NDArray[Any] | Mapping[str, NDArray[Any]]
    ) -> tuple[NDArray[Any], torch.Tensor]:
        """Best actions (B, ...) where episodes begin, and the features (B, F) they are chosen by.

        Args:
            observations: see `predict`.

        Raises:
            NotImplementedError: see `PolicyNetwork.features`.
            ValueError: see `predict`.
        """
        return self._best(self._tensors(observations, None)[0])

    def _best(self, tensors: Observations) -> tuple[NDArray[Any], torch.Tensor]:
        """Best actions (B, ...), and the features (B, F) they are chosen by."""
        features, _ = self.network.features(tensors)
        actions = self.network.act_on(features, deterministic=True, generator=self._generator)
        return to_environment(actions, self.action_space), features

    def _tensors(
        self,
        observations: NDArray[Any] | Mapping[str, NDArray[Any]],
        state: NDArray[np.float32] | None,
    ) -> tuple[Observations, bool]:
        """Observations with the hidden states before them; and whether there is but one."""
        batch, is_single = checked(observations, self.observation_space, self._ignored)
        tensors = to_tensors(batch, self.observation_space, self._device)
        hidden_state = self._hidden_state(state, len(next(iter(batch.values()))))
        return replace(tensors, sequences=Sequences.single(hidden_state)), is_single

    def _hidden_state(self, state: NDArray[np.float32] | None, count: int) -> torch.Tensor:
        """The state (B, m) as a tensor."""
        if state is None:
            return self.network.initial_state(count)
        rows = np.atleast_2d(np.asarray(state, np.float32))
        if rows.shape != (count, self.network.state_size):
            raise ValueError(
                f"state: of shape {np.shape(state)}, where {count} observations need "
                f"({count}, {self.network.state_size}): what the last call returned"
            )
        return torch.from_numpy(rows.copy()).to(self._device)


def find_metadata(folder: Path) -> Metadata:
    """Metadata of a policy.

    Where it was saved before policies did, its environment is built to be asked.

    Args:
        folder: of the run, or of an exported policy.

    Raises:
        UserError: the file is damaged, the environment can't be built, or names modules that nobody
            said to import.
    """
    if found := read_metadata(folder):
        return found
    registries = load_registries()
    run = load_run(folder / CONFIGURATION, [], registries).with_environments(1)
    check_imports(run, str(folder / CONFIGURATION))
    try:
        env: Environment = run.environment.cls(run.environment.settings, [], 0)
    except ValueError as error:
        raise UserError(
            f"{folder / CONFIGURATION}: environment ({run.environment.name}): {error}"
        ) from error
    with closing(env):
        return Metadata.of_run(run, registries, env)


def complete_metadata(folder: Path) -> Metadata:
    """Metadata of a policy with what its environment declares for use away from it.

    Where the policy was saved before environments did, the class of its environment is asked; one
    that is not installed here has declared nothing.

    Args:
        folder: of the run, or of an exported policy.

    Raises:
        UserError: see `find_metadata`.
    """
    metadata = find_metadata(folder)
    if metadata.deployment is not None:
        return metadata
    try:
        environment = load_run(folder / CONFIGURATION, [], load_registries()).environment
    except UserError:
        return replace(metadata, deployment=Deployment())
    return replace(metadata, deployment=environment.cls.deployment(environment.settings))


def _network(
    loaded: Loaded, folder: Path, metadata: Metadata, full_precision: bool
) -> PolicyNetwork:
    registries = load_registries(plugin_manager(PLUGINS))
    metadata.check_plugins(registries, folder)
    settings = load_policy(folder / CONFIGURATION, registries)
    encoders, trainer = settings.encoders, settings.trainer
    if full_precision:
        encoders = {name: _in_float32(encoder) for name, encoder in encoders.items()}
        trainer = _in_float32(trainer)
    factory = network_factory(
        metadata.observation_space,
        metadata.action_space,
        metadata.privileged,
        encoders,
        registries.encoders,
    )
    network: PolicyNetwork = trainer.cls.build_policy(factory, trainer.settings)
    try:
        load_weights(network, loaded.weights)
    except ValueError as error:
        raise UserError(
            f"{loaded.path}: these weights do not fit the networks of its {CONFIGURATION}: {error}"
        ) from error
    return network


def _in_float32(component: Component) -> Component:
    return replace(component, settings=in_float32(component.settings))
