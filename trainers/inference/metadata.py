"""Metadata of a saved policy: its spaces, and the plugins that it needs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
from pydantic import BaseModel

from encoders.saved_spaces import space_from_plain, space_to_plain
from envs.deployment import Deployment
from envs.environment import Environment
from trainers.common.errors import UserError, reason
from trainers.runfile.registry import Entry, Registries
from trainers.runfile.settings import RunSettings

FILE = "policy.json"
FORMAT = 1


class Need(BaseModel, frozen=True):
    """A component that the policy's networks are made of."""

    name: str
    distribution: str


class _File(BaseModel, frozen=True, extra="forbid"):
    format: int
    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    privileged: list[str]
    encoders: dict[str, Need]
    trainer: Need
    deployment: Deployment | None = None


@dataclass(frozen=True)
class Metadata:
    """Spaces and components of a policy.

    Attributes:
        observation_space: of one environment.
        action_space: of one environment.
        privileged: names of the observations that only a critic may see.
        encoders: by the name of the observation, as far as the run file names them.
        trainer: the algorithm.
        deployment: what its policies are used by away from the environment; None where it was saved
            before environments declared it.
    """

    observation_space: gymnasium.spaces.Dict
    action_space: gymnasium.Space[Any]
    privileged: frozenset[str]
    encoders: Mapping[str, Need]
    trainer: Need
    deployment: Deployment | None = None

    @classmethod
    def of_run(cls, run: RunSettings, registries: Registries, env: Environment) -> Metadata:
        """Metadata of a run's policies."""
        encoders, trainers = registries.encoders, registries.trainers
        return cls(
            env.single_observation_space,
            env.single_action_space,
            env.privileged,
            {name: _need(c.name, encoders.get(c.name)) for name, c in run.encoders.items()},
            _need(run.trainer.name, trainers.get(run.trainer.name)),
            run.environment.cls.deployment(run.environment.settings),
        )

    def to_json(self) -> str:
        """The content of the file.

        Raises:
            ValueError: a space is of a kind that can't be written.
        """
        file = _File(
            format=FORMAT,
            observation_space=space_to_plain(self.observation_space),
            action_space=space_to_plain(self.action_space),
            privileged=sorted(self.privileged),
            encoders=dict(self.encoders),
            trainer=self.trainer,
            deployment=self.deployment,
        )
        return json.dumps(file.model_dump(), indent=2) + "\n"

    @classmethod
    def from_json(cls, content: bytes | str) -> Metadata:
        """Metadata that a file holds.

        Raises:
            ValueError: it is not such a file's content.
        """
        file = _File.model_validate_json(content, strict=True)
        if file.format != FORMAT:
            raise ValueError(f"format {file.format}, where this version reads {FORMAT}")
        observation_space = space_from_plain(file.observation_space)
        if not isinstance(observation_space, gymnasium.spaces.Dict):
            raise ValueError("observation_space: should be a Dict")
        return cls(
            observation_space,
            space_from_plain(file.action_space),
            frozenset(file.privileged),
            file.encoders,
            file.trainer,
            file.deployment,
        )

    def check_plugins(self, registries: Registries, folder: Path) -> None:
        """Refuses a policy whose plugins are not installed.

        Raises:
            UserError: with the name of the distribution that is missing.
        """
        needed = [("trainer", self.trainer, registries.trainers)]
        needed += [("encoder", need, registries.encoders) for need in self.encoders.values()]
        for kind, need, registry in needed:
            if need.name not in registry.entries:
                raise UserError(
                    f"{folder}: this policy needs the {kind} {need.name!r} of "
                    f"{need.distribution}, which is not installed here: install it with pip"
                )


def read_metadata(folder: Path) -> Metadata | None:
    """The metadata of a policy's folder; None where it was saved before there were any.

    Raises:
        UserError: the file is damaged.
    """
    try:
        return Metadata.from_json((folder / FILE).read_bytes())
    except FileNotFoundError:
        return None
    except Exception as error:  # forged, a file can be wrong in any way
        raise UserError(
            f"{folder / FILE}: can't be used: {reason(error)}; export the policy anew"
        ) from error


def _need(name: str, entry: Entry) -> Need:
    return Need(name=name, distribution=entry.origin.distribution)
