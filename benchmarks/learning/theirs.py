"""Stable-Baselines3's side, with the hyper-parameters of our run files. Needs the extra `bench`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib import TRPO
from stable_baselines3 import DDPG, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from benchmarks.learning.evaluation import Act, Referee
from benchmarks.peers import PeerVecEnv
from trainers.algorithms.ddpg import DDPGSettings
from trainers.algorithms.ppo import PPOSettings
from trainers.algorithms.schedules import Schedule
from trainers.algorithms.trpo import TRPOSettings
from trainers.networks.actions import ActionScaling
from trainers.networks.network import ACTIVATIONS, NetworkSettings
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings
from trainers.session import build_environment


def learn(run: RunSettings, registries: Registries, referee: Referee) -> Act:
    """Learns with the same environment and hyper-parameters; returns the final policy."""
    settings = run.trainer.settings
    env = _normalized(PeerVecEnv(build_environment(run, run.seed)), settings)
    model = build(run, env)
    act = _policy_of(model, env)
    referee.start()
    model.learn(settings.max_steps, _Watch(referee, act))  # type: ignore[attr-defined]
    env.close()
    return act


class _Watch(BaseCallback):
    """Shows the referee the policy after each update."""

    def __init__(self, referee: Referee, act: Act):
        super().__init__()
        self._referee, self._act = referee, act

    def _on_rollout_start(self) -> None:
        self._referee.look(self.num_timesteps, self._act)

    def _on_step(self) -> bool:
        return True


def _normalized(env: VecEnv, settings: Any) -> VecEnv:
    observations = settings.network_settings.normalize
    rewards = getattr(settings.hyperparameters, "normalize_rewards", False)
    if not observations and not rewards:
        return env
    gamma = settings.hyperparameters.gamma
    return VecNormalize(env, norm_obs=observations, norm_reward=rewards, gamma=gamma)


def _policy_of(model: BaseAlgorithm, env: VecEnv) -> Act:
    def act(raw: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
        (observations,) = raw.values()
        if isinstance(env, VecNormalize):
            observations = env.normalize_obs(observations)
        actions, _ = model.predict(observations, deterministic=True)
        return actions

    return act


def build(run: RunSettings, env: VecEnv) -> BaseAlgorithm:
    """The peer of the run's trainer, which is found by its name."""
    cls, options = PEERS[run.trainer.name]
    own = options(run.trainer.settings, env)
    return cls("MlpPolicy", env, seed=run.seed, device="cpu", **own)


def ppo(settings: PPOSettings, env: VecEnv) -> dict[str, Any]:
    """Arguments of Stable-Baselines3's PPO."""
    hyper = settings.hyperparameters
    return {
        **_on_policy(settings, env),
        "n_epochs": hyper.num_epoch,
        "clip_range": _course(hyper.epsilon, hyper.epsilon_schedule),
        "clip_range_vf": hyper.value_clipping,
        "ent_coef": hyper.beta,
        "vf_coef": hyper.value_coefficient,
        "max_grad_norm": hyper.max_gradient_norm,
        "target_kl": hyper.target_kl,
    }


def _trpo(settings: TRPOSettings, env: VecEnv) -> dict[str, Any]:
    hyper = settings.hyperparameters
    # Of a Gaussian policy sb3-contrib takes the mean KL of the action's dimensions, not their sum,
    # and so the mean of their Fisher matrices: both bounds per dimension make it the same step.
    dimensions = math.prod(env.action_space.shape or ())
    return {
        **_on_policy(settings, env),
        "cg_max_steps": hyper.cg_iterations,
        "cg_damping": hyper.damping / dimensions,
        "line_search_shrinking_factor": hyper.backtrack_coefficient,
        "line_search_max_iter": hyper.backtrack_iterations,
        "n_critic_updates": hyper.num_epoch,
        "target_kl": hyper.delta / dimensions,
        "sub_sampling_factor": round(1 / hyper.fisher_fraction),
    }


def _on_policy(settings: PPOSettings | TRPOSettings, env: VecEnv) -> dict[str, Any]:
    hyper, networks = settings.hyperparameters, settings.network_settings
    policy = _networks(networks, eps=1e-5)  # their default, which other arguments take away
    if isinstance(env.action_space, gymnasium.spaces.Box):
        # Theirs acts in the environment's units, ours in halves of the distance of its bounds.
        half_range = ActionScaling(env.action_space, unbounded=True).half_range.mean().item()
        policy["log_std_init"] = math.log(networks.initial_std * half_range)
    return {
        "learning_rate": _course(hyper.learning_rate, hyper.learning_rate_schedule),
        "n_steps": hyper.buffer_size // env.num_envs,
        "batch_size": hyper.batch_size,
        "gamma": hyper.gamma,
        "gae_lambda": hyper.lambd,
        "policy_kwargs": policy,
    }


def _ddpg(settings: DDPGSettings, env: VecEnv) -> dict[str, Any]:
    hyper, size = settings.hyperparameters, env.action_space.shape or ()
    return {
        **_off_policy(settings, env),
        "learning_rate": _course(hyper.learning_rate, hyper.learning_rate_schedule),
        "action_noise": NormalActionNoise(np.zeros(size), np.full(size, hyper.noise.sigma)),
    }


def _sac(settings: Any, env: VecEnv) -> dict[str, Any]:
    hyper = settings.hyperparameters
    return {
        **_off_policy(settings, env),
        "learning_rate": hyper.learning_rate,
        "ent_coef": f"auto_{hyper.init_entropy_coefficient}",
    }


def _off_policy(settings: Any, env: VecEnv) -> dict[str, Any]:
    hyper = settings.hyperparameters
    return {
        "buffer_size": hyper.buffer_size,
        "learning_starts": hyper.buffer_init_steps,
        "batch_size": hyper.batch_size,
        "tau": hyper.tau,
        "gamma": hyper.gamma,
        "train_freq": 1,
        "gradient_steps": round(hyper.updates_per_step * env.num_envs),
        "policy_kwargs": _networks(settings.network_settings),
    }


PEERS: dict[str, tuple[Callable[..., BaseAlgorithm], Callable[[Any, VecEnv], dict[str, Any]]]] = {
    "ppo": (PPO, ppo),
    "trpo": (TRPO, _trpo),
    "ddpg": (DDPG, _ddpg),
    "sac": (SAC, _sac),
}
"""By our trainer's name: the peer, and its arguments from our trainer's settings."""


def _networks(settings: NetworkSettings, **optimizer: float) -> dict[str, Any]:
    return {
        "net_arch": [settings.hidden_units] * settings.num_layers,
        "activation_fn": type(ACTIVATIONS[settings.activation]()),
        # Ours has the same: one call of a fused kernel instead of one for each tensor.
        "optimizer_kwargs": {"fused": True, **optimizer},
        "optimizer_class": torch.optim.Adam,
    }


def _course(initial: float, schedule: Schedule) -> Callable[[float], float]:
    return lambda remaining: schedule.value(initial, 1.0 - remaining)
