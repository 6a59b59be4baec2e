"""This project's training loop as a contender."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.speed.setup import CAMERA, Setup
from encoders.conv import Paper
from envs.grasp.settings import GraspSettings
from envs.grasp.vector_env import GraspVectorEnv
from rewards.plugin import ventosa_rewards
from trainers.algorithms.ppo import PPO, PPOHyperparameters, PPOSettings
from trainers.algorithms.schedules import Schedule
from trainers.networks.actor_critic import PolicySettings
from trainers.reporting.event_log import RunLog
from trainers.reporting.summary import Summary
from trainers.reporting.terminal import make_display
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import Component, RunSettings, WeightedReward
from trainers.saving.checkpoint import Checkpoints
from trainers.session import Session
from trainers.training import train

CONSTANT = Schedule(type="constant")


class Ventosa:
    """Trains as `trainers.learn` does, summaries included; only checkpoints are left out."""

    def __init__(self, setup: Setup):
        self._buffer_size = setup.buffer_size
        run = _run(setup)
        self._settings: PPOSettings = run.trainer.settings  # type: ignore[assignment]
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            self._session = Session(run, load_registries())
            stack.callback(self._session.close)
            log = RunLog(folder)
            stack.callback(log.close)
            self._session.reset()
            self._summary = Summary(log, "speed", 1, self._settings.summary_freq)
            self._checkpoints = _NoCheckpoints(folder, 1)
            self._progress = make_display("speed", 1, 1, console=Console(quiet=True))
            self._stack = stack.pop_all()
        policy = self._session.algorithm.policy
        self.parameters = sum(parameter.numel() for parameter in policy.parameters())

    def learn(self) -> None:
        """See `Contender`."""
        steps = self._session.env_runner.step_count + self._buffer_size
        settings = self._settings.model_copy(update={"max_steps": steps})
        train(self._session, settings, self._summary, self._checkpoints, self._progress)

    def close(self) -> None:
        """See `Contender`."""
        self._stack.close()


class _NoCheckpoints(Checkpoints):
    """Where nothing is saved, as the peer saves nothing."""

    def save(self, *_: Any, **__: Any) -> Path:
        return Path()


def _run(setup: Setup) -> RunSettings:
    rewards = ventosa_rewards()
    return RunSettings(
        environment=Component(
            "grasp", GraspVectorEnv, GraspSettings.model_validate(setup.environment())
        ),
        rewards=tuple(
            WeightedReward(Component(name, rewards[name], rewards[name].Settings()), weight)  # type: ignore[attr-defined]
            for name, weight in setup.rewards.items()
        ),
        encoders={CAMERA: Component("paper", Paper, Paper.Settings(size=setup.size))},
        curriculum=None,
        environment_parameters={},
        trainer=Component("ppo", PPO, _trainer(setup)),
        seed=0,
        device="cpu",
    )


def _trainer(setup: Setup) -> PPOSettings:
    return PPOSettings(
        hyperparameters=PPOHyperparameters(
            batch_size=setup.batch_size,
            buffer_size=setup.buffer_size,
            num_epoch=setup.num_epochs,
            learning_rate=setup.learning_rate,
            learning_rate_schedule=CONSTANT,
            gamma=setup.gamma,
            lambd=setup.lambd,
            epsilon=setup.epsilon,
            beta=setup.beta,
            beta_schedule=CONSTANT,
        ),
        network_settings=PolicySettings(
            hidden_units=setup.hidden_units, num_layers=setup.num_layers, critic="shared"
        ),
    )
