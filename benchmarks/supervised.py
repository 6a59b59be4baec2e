"""How much of the pose a network can tell from an image: a fit by supervision.

    python -m benchmarks.supervised config/run.yaml [KEY=VALUE ...] [--minutes 3]

The run's policy is shown fresh scenes with the right action in each: no reward, no exploration.
What it reaches bounds what reinforcement learning can hope for with the same images and the same
network, and does so in minutes.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel
from rich.console import Console
from torch import Tensor
from torch.nn import functional as F

from envs.grasp.scene.sampler import heading
from envs.grasp.vector_env import GraspVectorEnv
from trainers.algorithms.ddpg import DDPGSettings
from trainers.algorithms.ppo import PPOSettings
from trainers.algorithms.trpo import TRPOSettings
from trainers.common.command import tells_failures
from trainers.common.errors import UserError
from trainers.evaluation import FIRST_SEED
from trainers.networks.actions import to_environment
from trainers.networks.actor_critic import ActorCritic
from trainers.networks.deterministic import DeterministicActorCritic
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import to_tensors
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import RunSettings, load_run
from trainers.session import build_environment, build_factory, final_parameters

Policy = ActorCritic | DeterministicActorCritic

JUDGED = 2000
REPORTS = 6
WARM_UP_STEPS = 100
MAX_GRADIENT_NORM = 5.0


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Fits, and prints how far it has come."""
    options = parse(arguments)
    registries = load_registries()
    run = load_run(options.config, [*options.overrides, "environment.num_envs=256"], registries)
    torch.manual_seed(options.seed)
    with (
        closing(_environment(run, options.seed)) as training,
        closing(_environment(run, FIRST_SEED)) as unseen,
    ):
        policy = build_policy(run.trainer.settings, build_factory(run, registries, training))
        for share, images in fit(policy, training, options.minutes * 60, options.learning_rate):
            figures = ", ".join(f"{name} {value}" for name, value in judge(policy, unseen).items())
            Console().print(f"{share * options.minutes:.1f} min, {images:,} images: {figures}")
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.supervised", description=__doc__)
    parser.add_argument("config", type=Path, help="a run file with `environment: {type: grasp}`")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--learning-rate", type=float, default=3e-3)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_intermixed_args(arguments)


def build_policy(settings: BaseModel, factory: NetworkFactory) -> Policy:
    """The networks that a run's algorithm would train.

    Raises:
        UserError: it is an algorithm of someone else's.
    """
    match settings:
        case DDPGSettings():
            return DeterministicActorCritic(factory, settings.network_settings)
        case PPOSettings() | TRPOSettings():
            return ActorCritic(factory, settings.network_settings)
    raise UserError("trainer.trainer_type: only policies of ppo, trpo and ddpg can be fitted")


def fit(
    policy: Policy, env: GraspVectorEnv, seconds: float, learning_rate: float
) -> Iterator[tuple[float, int]]:
    """Fits for a time, at a rate that falls along a cosine; now and then tells how far it is.

    Yields:
        The share of the time that is over, and the images seen.
    """
    parameters = list(policy.actor_parameters())
    optimizer = torch.optim.Adam(parameters, fused=True)
    begin, pauses, steps, reports = time.perf_counter(), 0.0, 0, 0
    while True:
        share = (time.perf_counter() - begin - pauses) / seconds
        if share * REPORTS >= reports:
            pause = time.perf_counter()
            yield min(share, 1.0), steps * env.num_envs
            pauses += time.perf_counter() - pause
            reports += 1
        if share >= 1.0:
            return
        warmth = min(1.0, (steps + 1) / WARM_UP_STEPS)
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * warmth * (1.0 + math.cos(math.pi * share)) / 2.0
        error = (_actions(policy, env) - torch.from_numpy(right_actions(env))) / _tolerances(env)
        optimizer.zero_grad()
        F.smooth_l1_loss(error, torch.zeros_like(error)).backward()
        torch.nn.utils.clip_grad_norm_(parameters, MAX_GRADIENT_NORM)
        optimizer.step()
        steps += 1


@torch.no_grad()
def judge(policy: Policy, env: GraspVectorEnv) -> dict[str, str]:
    """Success on unseen scenes, and median / 95th percentile of the errors."""
    env.reset(seed=FIRST_SEED)
    parts: list[dict[str, NDArray[Any]]] = []
    for _ in range(-(-JUDGED // env.num_envs)):
        actions = to_environment(_actions(policy, env), env.single_action_space)
        parts.append(env.step_without_reset(actions)[-1]["episode_metrics"])
    episode_metrics = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def spread(name: str, factor: float = 1.0) -> str:
        median, late = np.percentile(episode_metrics[name] * factor, [50, 95])
        return f"{median:.1f} / {late:.1f}"

    return {
        "success": f"{episode_metrics['success'].mean():.1%}",
        "position mm": spread("position_error_m", 1000.0),
        "yaw deg": spread("yaw_error_deg"),
    }


def right_actions(env: GraspVectorEnv) -> NDArray[np.float32]:
    """The actions (N, 4) that lead to the middles of the goal regions."""
    scenes, gap_m = env.scenes, env.region.middle_m[:, 2:]
    goal_m = scenes.target_m - gap_m * heading(scenes.target_yaw_rad)
    return env.action_for(goal_m, scenes.target_yaw_rad).astype(np.float32)


def _actions(policy: Policy, env: GraspVectorEnv) -> Tensor:
    """The policy's actions (N, 4) before new scenes."""
    observations, _ = env.reset()
    seen = to_tensors(observations, env.single_observation_space, torch.device("cpu"))
    if isinstance(policy, DeterministicActorCritic):
        return policy.act(seen)
    return policy.distribution(seen).mode()


def _tolerances(env: GraspVectorEnv) -> Tensor:
    """How large errors (N, 4) of the actions the goal regions allow."""
    region, workspace = env.region, env.settings.workspace
    depth_m = (region.gap_limit_m - region.gap_min_m) / 2
    allowed = [depth_m, region.lateral_limit_m, region.vertical_limit_m, region.yaw_limit_deg]
    parts = [2.0 * a / (high - low) for a, (_, (low, high)) in zip(allowed, workspace, strict=True)]
    return torch.from_numpy(np.stack(parts, axis=1).astype(np.float32))


def _environment(run: RunSettings, seed: int) -> GraspVectorEnv:
    env = build_environment(run, seed)
    if not isinstance(env, GraspVectorEnv):
        env.close()
        raise UserError(
            "environment.type: only the grasp task knows the right actions; fit a run file with "
            "`environment: {type: grasp}`"
        )
    env.set_parameters(final_parameters(run))
    return env


if __name__ == "__main__":
    raise SystemExit(main())
