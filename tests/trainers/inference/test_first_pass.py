"""Plugins whose networks are not what they say are found before a run begins, by name."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from trainers import run as run_module
from trainers.networks.network import evaluation_mode
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import load_run
from trainers.session import Session

CARTPOLE = {"type": "gymnasium", "id": "CartPole-v1", "num_envs": 3}
PLUGIN = """
import numpy as np
import torch
from pydantic import BaseModel
from torch import nn

from envs.gym.vector_env import GymEnvironment
from trainers.algorithms.ppo import PPO
from trainers.hookspecs import hookimpl
from trainers.networks.actor_critic import ActorCritic
from trainers.networks.network import Dense, NetworkSettings


class Odd(nn.Module):
    class Settings(BaseModel, frozen=True, extra="forbid"):
        size: int | float | None = 4

    def __init__(self, space, settings):
        super().__init__()
        self.layer = nn.Linear(4, 4)
        if settings.size is not None:
            self.features_dim = settings.size


class Right(Odd):
    def forward(self, raw):
        return self.layer(raw)


class Double(Odd):
    def forward(self, raw):
        return self.layer(raw).double()


class Deep(Odd):
    def forward(self, raw):
        return self.layer(raw)[:, None, :]


class Narrow(Odd):
    def __init__(self, space, settings):
        super().__init__(space, settings)
        self.layer = Dense(3, 4, 1.0, NetworkSettings())  # ventosa's: its user is wrong

    def forward(self, raw):
        return self.layer(raw)


class Columns(ActorCritic):
    def act_on(self, features, *, deterministic, generator):
        return super().act_on(features, deterministic=deterministic, generator=generator)[:, None]


class Floats(ActorCritic):
    def act_on(self, features, *, deterministic, generator):
        return torch.zeros(len(features))


class Remembering(ActorCritic):
    def features(self, observations):
        hidden, _ = super().features(observations)
        return hidden, hidden.new_zeros(len(hidden), 7)


def algorithm(policy):
    class Algorithm(PPO):
        @staticmethod
        def build_policy(factory, settings):
            return policy(factory, settings.network_settings)

    return Algorithm


class Doubles(GymEnvironment):
    def reset(self, **given):
        observations, infos = super().reset(**given)
        return {k: v.astype(np.float64) for k, v in observations.items()}, infos


class Fewer(GymEnvironment):
    def reset(self, **given):
        observations, infos = super().reset(**given)
        return {k: v[:2] for k, v in observations.items()}, infos


class Nameless(GymEnvironment):
    def reset(self, **given):
        return {}, super().reset(**given)[1]


@hookimpl
def ventosa_encoders():
    return {"right": Right, "double": Double, "deep": Deep, "narrow": Narrow}


@hookimpl
def ventosa_trainers():
    policies = {"columns": Columns, "floats": Floats, "remembering": Remembering}
    return {name: algorithm(policy) for name, policy in policies.items()}


@hookimpl
def ventosa_environments():
    return {"doubles": Doubles, "fewer": Fewer, "nameless": Nameless}
"""

Learn = Callable[..., Any]
WriteRun = Callable[..., Path]
WHO = "plugin 'own' (odd-plugin 1.2)"


@pytest.fixture(autouse=True)
def _installed(
    install_plugin: Callable[[str, str], Path], learn: Learn, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_plugin("odd_plugin", PLUGIN)
    monkeypatch.setattr(run_module, "load_registries", load_registries)


@pytest.mark.parametrize(
    ("encoder", "said"),
    [
        ({"type": "right", "size": None}, "encoder 'right': its features_dim is None, and should"),
        ({"type": "right", "size": 4.5}, "encoder 'right': its features_dim is 4.5, and should be"),
        ({"type": "right", "size": 0}, "encoder 'right': its features_dim is 0, and should be"),
        (
            {"type": "right", "size": 5},
            "encoder 'right' makes (2, 4) float32 of the observation 'observation', (2, 4) "
            "float32; by its features_dim they should be (2, 5) float32",
        ),
        ({"type": "double"}, "encoder 'double' makes (2, 4) float64 of the observation"),
        ({"type": "deep"}, "encoder 'deep' makes (2, 1, 4) float32 of the observation"),
    ],
    ids=["none", "fraction", "zero", "another", "double", "deep"],
)
def test_an_encoder_that_is_not_what_it_says_is_named(
    learn: Learn, write_run: WriteRun, encoder: dict[str, Any], said: str
) -> None:
    done = learn(write_run(CARTPOLE, encoders={"observation": encoder}))
    assert done.errors.startswith(f"error: {WHO}: {said}")
    assert done.code == 2
    assert not done.results.joinpath("toy/checkpoints").exists()


def test_an_encoder_that_fails_is_named_even_where_ventosa_is_nearer(
    learn: Learn, write_run: WriteRun
) -> None:
    done = learn(write_run(CARTPOLE, encoders={"observation": {"type": "narrow"}}))
    first, *lines = done.errors.splitlines()
    assert first.startswith(f"error: {WHO} failed: RuntimeError: mat1 and mat2 shapes")
    assert "return self.layer(raw)" in map(str.strip, lines)
    assert "Traceback" not in done.errors
    assert done.code == 1


@pytest.mark.parametrize(
    ("trainer", "said"),
    [
        (
            "columns",
            "actions for 2 observations are (2, 1) int64, and should be (2,) whole numbers",
        ),
        ("floats", "actions for 2 observations are (2,) float32, and should be (2,) whole numbers"),
        ("remembering", "hidden states after 2 observations are (2, 7) float32, and by its"),
    ],
)
def test_a_policy_whose_actions_or_states_dont_fit_is_named(
    learn: Learn, write_run: WriteRun, trainer: str, said: str
) -> None:
    done = learn(write_run(CARTPOLE, {"trainer_type": trainer}))
    assert done.errors.startswith(f"error: {WHO}: trainer '{trainer}': its policy's {said}")
    assert done.code == 2


@pytest.mark.parametrize(
    ("environment", "said"),
    [("doubles", "(3, 4) float64"), ("fewer", "(2, 4) float32"), ("nameless", "missing")],
)
def test_an_environment_whose_observations_are_not_its_spaces_is_named(
    learn: Learn, write_run: WriteRun, environment: str, said: str
) -> None:
    done = learn(write_run({**CARTPOLE, "type": environment}))
    assert done.errors == (
        f"error: {WHO}: environment '{environment}': the observation 'observation' is {said}, and "
        "by its space (3, 4) float32\n"
    )
    assert done.code == 2


def test_what_is_right_changes_neither_weights_nor_what_is_drawn(write_run: WriteRun) -> None:
    config = write_run(CARTPOLE, encoders={"observation": {"type": "right", "size": 4}})
    registries = load_registries()
    session = Session(load_run(config, [], registries), registries)
    try:
        weights = copy.deepcopy(session.weights())
        drawn = torch.get_rng_state(), session.algorithm.state_dict()["generator"]
        session.reset()
        after = torch.get_rng_state(), session.algorithm.state_dict()["generator"]
        assert all(map(torch.equal, drawn, after))
        assert all(torch.equal(weights[key], now) for key, now in session.weights().items())
        assert session.algorithm.policy.training
    finally:
        session.close()


def test_every_module_is_in_its_own_mode_afterwards() -> None:
    network = nn.Sequential(nn.Dropout(), nn.BatchNorm1d(2).eval(), nn.Linear(2, 2))
    with evaluation_mode(network):
        assert not any(module.training for module in network.modules())
    assert [module.training for module in network] == [True, False, True]
    assert network.training
