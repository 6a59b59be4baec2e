"""PPO: its losses by hand, its settings by their effect, and that it learns."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from pydantic import ValidationError
from torch import Tensor
from torch.optim.optimizer import register_optimizer_step_pre_hook

from trainers.algorithms.ppo import (
    PPO,
    PPOHyperparameters,
    PPOSettings,
    clipped_value_loss,
    rate_change,
    surrogate_loss,
)
from trainers.common.errors import NonFiniteError, UserError
from trainers.experience.env_runner import EnvRunner
from trainers.experience.episodes import concatenate
from trainers.inference.policy import Policy
from trainers.networks.distributions import Categorical, DiagonalGaussian
from trainers.networks.factory import NetworkFactory
from trainers.session import Session

MakePPO = Callable[..., PPO]
SEPARATE = {"critic": "separate"}
CONSTANT = {"learning_rate_schedule": "constant", "beta_schedule": "constant"}


# -- losses --------------------------------------------------------------------------------------


def chances(*of_the_first: float) -> Categorical:
    first = torch.tensor(of_the_first)
    return Categorical(torch.stack([first.log(), (1 - first).log()], dim=1))


def test_the_surrogate_takes_the_worse_of_the_free_and_the_clipped_ratio() -> None:
    # Action 0 had probability 0.5 and has 0.6, 0.75, 0.75, 0.25, 0.25: ratios 1.2, 1.5, 0.5.
    distribution = chances(0.6, 0.75, 0.75, 0.25, 0.25)
    advantages = torch.tensor([2.0, 2.0, -2.0, 2.0, -2.0])
    loss, divergence, clip_fraction = surrogate_loss(
        distribution,
        torch.zeros(5, dtype=torch.int64),
        torch.full((5,), math.log(0.5)),
        advantages,
        epsilon=0.3,
    )
    # min(r A, clip(r, 0.7, 1.3) A) = 2.4, 2.6, -3, 1, -1.4
    assert loss.item() == pytest.approx(-(2.4 + 2.6 - 3.0 + 1.0 - 1.4) / 5)
    assert clip_fraction.item() == pytest.approx(4 / 5)
    logs = [math.log(ratio) for ratio in (1.2, 1.5, 1.5, 0.5, 0.5)]
    expected = (0.2 + 0.5 + 0.5 - 0.5 - 0.5 - sum(logs)) / 5
    assert divergence.item() == pytest.approx(expected)


def test_clipped_ratios_push_no_further() -> None:
    logits = torch.zeros(2, 2, requires_grad=True)
    actions, old = torch.tensor([0, 0]), torch.log(torch.tensor([0.25, 0.5]))  # ratios 2 and 1
    loss, *_ = surrogate_loss(Categorical(logits), actions, old, torch.ones(2), 0.2)
    loss.backward()
    assert logits.grad is not None
    assert logits.grad[0].tolist() == [0.0, 0.0]
    assert logits.grad[1].tolist() == pytest.approx([-0.25, 0.25])  # r (1 - p) / 2, and against it


def test_one_ratio_stands_for_the_whole_action() -> None:
    distribution = DiagonalGaussian(torch.zeros(1, 2), torch.zeros(2))
    old = distribution.log_prob(torch.zeros(1, 2)) - math.log(1.5)
    loss, *_ = surrogate_loss(distribution, torch.zeros(1, 2), old, torch.ones(1), 10.0)
    assert loss.item() == pytest.approx(-1.5)


def test_the_measured_divergence_is_never_negative_and_near_the_true_one() -> None:
    torch.manual_seed(0)
    old = DiagonalGaussian(torch.randn(20_000, 2) * 0.1, torch.full((2,), -0.1))
    new = DiagonalGaussian(torch.zeros(20_000, 2), torch.zeros(2))
    actions = old.sample()
    _, divergence, _ = surrogate_loss(new, actions, old.log_prob(actions), torch.ones(20_000), 0.2)
    assert divergence.item() == pytest.approx(old.kl(new).mean().item(), rel=0.05)
    for few in range(50):
        part = slice(few, few + 2)
        one = surrogate_loss(
            new[part], actions[part], old.log_prob(actions)[part], torch.ones(2), 1
        )
        assert one[1].item() >= 0


def test_the_value_loss_takes_the_worse_of_the_free_and_the_held_back_value() -> None:
    values = torch.tensor([3.0, 3.0, 0.6, -1.0])
    old = torch.tensor([1.0, 1.0, 1.0, 1.0])
    returns = torch.tensor([3.0, 1.0, 0.0, 2.0])
    # Held within 0.5 of 1: 1.5, 1.5, 0.6, 0.5. Squared errors, free: 0, 4, 0.36, 9; held: 2.25,
    # 0.25, 0.36, 2.25.
    assert clipped_value_loss(values, old, returns, None).item() == pytest.approx(13.36 / 4)
    assert clipped_value_loss(values, old, returns, 0.5).item() == pytest.approx(15.61 / 4)


def test_values_that_moved_far_enough_are_pushed_no_further() -> None:
    values = torch.tensor([2.0, 1.2], requires_grad=True)
    clipped_value_loss(values, torch.ones(2), torch.full((2,), 9.0), 0.5).backward()
    assert values.grad is not None
    assert values.grad[0] == 0
    assert values.grad[1] == pytest.approx(1.2 - 9.0)


def test_the_rate_changes_by_the_root_of_the_divergence_and_little_at_a_time() -> None:
    # steps of sqrt(0.02 / 0.0225) = 0.943 of their size diverge by 0.02
    assert rate_change(0.0225, 0.02) == pytest.approx(math.sqrt(8.0) / 3.0)
    assert rate_change(0.0, 0.02) == pytest.approx(1.2)
    assert rate_change(9.0, 0.02) == pytest.approx(1 / 1.2)


# -- settings ------------------------------------------------------------------------------------


def test_a_desired_divergence_scales_the_policys_rate_alone(make_ppo: MakePPO) -> None:
    hyper = {**CONSTANT, "learning_rate": 1e-3, "critic_learning_rate": 2e-3, "desired_kl": 1e-9}
    algorithm = make_ppo("target", hyper, SEPARATE)
    rates = []
    for _ in range(3):
        statistics, _ = one_round(algorithm)
        rates.append(statistics["Policy/Learning Rate"])
        assert statistics["Policy/Critic Learning Rate"] == 2e-3
    assert rates == pytest.approx([1e-3, 1e-3 / 1.2, 1e-3 / 1.44])
    other = make_ppo("target", hyper, SEPARATE)
    other.load_state_dict(algorithm.policy.state_dict(), algorithm.state_dict())
    assert one_round(other)[0]["Policy/Learning Rate"] == pytest.approx(1e-3 / 1.2**3)


def test_divergence_comes_near_what_is_desired(make_ppo: MakePPO) -> None:
    hyper = {**CONSTANT, "learning_rate": 1e-5, "num_epoch": 4, "desired_kl": 0.01}
    algorithm = make_ppo("target", hyper)
    divergences = [one_round(algorithm)[0]["Policy/KL"] for _ in range(80)]
    assert divergences[0] < 1e-3
    assert 0.005 < sum(divergences[-20:]) / 20 < 0.02


@dataclass
class Descent:
    """What the optimizer was asked to do, step by step."""

    rates: list[list[float]] = field(default_factory=list)
    norms: list[float] = field(default_factory=list)

    @property
    def steps(self) -> int:
        return len(self.rates)


@contextmanager
def watched() -> Iterator[Descent]:
    descent = Descent()

    def before(optimizer: torch.optim.Optimizer, *_: Any) -> None:
        groups = optimizer.param_groups
        descent.rates.append([group["lr"] for group in groups])
        gradients = [p.grad for group in groups for p in group["params"] if p.grad is not None]
        descent.norms.append(math.sqrt(sum(float(g.square().sum()) for g in gradients)))

    handle = register_optimizer_step_pre_hook(before)
    try:
        yield descent
    finally:
        handle.remove()


def one_round(algorithm: PPO, progress: float = 0.0) -> tuple[dict[str, float], Descent]:
    algorithm.collect()
    with watched() as descent:
        return dict(algorithm.update(progress)), descent


def snapshot(parameters: Iterator[Tensor]) -> list[Tensor]:
    return [parameter.detach().clone() for parameter in parameters]


def changed(before: list[Tensor], parameters: Iterator[Tensor]) -> bool:
    return any(not torch.equal(a, b) for a, b in zip(before, parameters, strict=True))


def test_every_epoch_passes_over_the_whole_buffer(make_ppo: MakePPO) -> None:
    algorithm = make_ppo("target", {"buffer_size": 30, "batch_size": 8, "num_epoch": 3})
    _, descent = one_round(algorithm)
    # 30 steps of 4 environments are rounded up to 32: four batches of 8.
    assert descent.steps == 3 * 4


def test_update_needs_a_collection_of_its_own(make_ppo: MakePPO) -> None:
    algorithm = make_ppo()
    with pytest.raises(RuntimeError, match="after collect"):
        algorithm.update(0.0)
    one_round(algorithm)
    with pytest.raises(RuntimeError, match="after collect"):
        algorithm.update(0.0)


def test_schedules_reach_the_optimizer_and_the_statistics(make_ppo: MakePPO) -> None:
    hyperparameters = {
        "learning_rate": 4e-3,
        "critic_learning_rate": 8e-3,
        "learning_rate_schedule": "linear",
        "epsilon": 0.4,
        "epsilon_schedule": "linear",
        "beta": 0.02,
        "beta_schedule": {"type": "polynomial", "power": 2},
    }
    algorithm = make_ppo("target", hyperparameters, SEPARATE)
    for progress, weight in ((0.0, 1.0), (0.75, 0.25)):
        statistics, descent = one_round(algorithm, progress)
        assert descent.rates[0] == pytest.approx([4e-3 * weight, 8e-3 * weight])
        assert descent.rates[-1] == descent.rates[0]
        assert statistics["Policy/Learning Rate"] == pytest.approx(4e-3 * weight)
        assert statistics["Policy/Critic Learning Rate"] == pytest.approx(8e-3 * weight)
        assert statistics["Policy/Epsilon"] == pytest.approx(0.4 * weight)
        assert statistics["Policy/Beta"] == pytest.approx(0.02 * weight**2)


def test_the_critic_has_the_policys_learning_rate_unless_it_has_its_own(
    make_ppo: MakePPO,
) -> None:
    algorithm = make_ppo("target", {"learning_rate": 1e-2}, SEPARATE)
    policy = algorithm.policy
    actor, critic = snapshot(policy.actor_parameters()), snapshot(policy.critic_parameters())
    statistics, descent = one_round(algorithm)
    assert {rate for rates in descent.rates for rate in rates} == {1e-2}
    assert statistics["Policy/Critic Learning Rate"] == 1e-2
    assert changed(actor, policy.actor_parameters())
    assert changed(critic, policy.critic_parameters())


@pytest.mark.parametrize(
    ("rates", "moved"),
    [
        ({"learning_rate": 1e-30, "critic_learning_rate": 1e-2}, [False, True]),
        ({"learning_rate": 1e-2, "critic_learning_rate": 1e-30}, [True, False]),
    ],
)
def test_each_learning_rate_moves_its_own_networks(
    make_ppo: MakePPO, rates: dict[str, float], moved: list[bool]
) -> None:
    algorithm = make_ppo("target", rates, SEPARATE)
    policy = algorithm.policy
    with torch.no_grad():  # a zero moves however small the step is
        for parameter in policy.parameters():
            parameter.add_(0.01)
    actor, critic = snapshot(policy.actor_parameters()), snapshot(policy.critic_parameters())
    one_round(algorithm)
    now = [changed(actor, policy.actor_parameters()), changed(critic, policy.critic_parameters())]
    assert now == moved


def test_gradients_are_clipped_to_their_norm(make_ppo: MakePPO) -> None:
    _, free = one_round(make_ppo("target", {"max_gradient_norm": 1e9}))
    _, clipped = one_round(make_ppo("target", {"max_gradient_norm": 0.01}))
    assert max(free.norms) > 0.1
    assert max(clipped.norms) <= 0.01 * 1.001
    assert clipped.norms[0] == pytest.approx(0.01, rel=1e-3)


def test_an_update_ends_when_the_policy_has_moved_far_enough(make_ppo: MakePPO) -> None:
    hasty = {"num_epoch": 50, "learning_rate": 0.1, "learning_rate_schedule": "constant"}
    _, free = one_round(make_ppo("target", hasty))
    statistics, stopped = one_round(make_ppo("target", {**hasty, "target_kl": 0.05}))
    assert free.steps == 50 * 2
    assert 1 < stopped.steps < 20
    assert statistics["Policy/KL"] > 0.05 / stopped.steps
    _, patient = one_round(make_ppo("target", {**hasty, "target_kl": 1e9}))
    assert patient.steps == free.steps


def after_one_round(make_ppo: MakePPO, **hyperparameters: Any) -> list[Tensor]:
    many = {"num_epoch": 8, "learning_rate": 0.01, **CONSTANT}
    algorithm = make_ppo("target", {**many, **hyperparameters}, SEPARATE)
    one_round(algorithm)
    return snapshot(algorithm.policy.parameters())


def test_a_round_is_the_same_each_time(make_ppo: MakePPO) -> None:
    first, second = after_one_round(make_ppo), after_one_round(make_ppo)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_value_clipping_holds_the_critic_back_and_not_the_policy(make_ppo: MakePPO) -> None:
    moves = {}
    for clipping in (None, 1e9, 1e-3):
        hyper = {"num_epoch": 30, "learning_rate": 0.01, "value_clipping": clipping, **CONSTANT}
        # One batch an epoch, a norm never reached: the critic's loss does not touch the policy.
        hyper |= {"batch_size": 16, "max_gradient_norm": 1e9}
        algorithm = make_ppo("target", hyper, SEPARATE)
        policy = algorithm.policy
        algorithm.collect()
        observations = algorithm._rollout.observations(torch.arange(16))  # type: ignore[union-attr]
        before = policy.value(observations).detach()
        algorithm.update(0.0)
        moved = (policy.value(observations).detach() - before).abs().mean().item()
        moves[clipping] = moved, snapshot(policy.actor_parameters())
    assert moves[1e9][0] == moves[None][0]
    assert moves[1e-3][0] < moves[None][0] / 2
    assert all(torch.equal(a, b) for a, b in zip(moves[1e-3][1], moves[None][1], strict=True))


def spread(make_ppo: MakePPO, **hyperparameters: Any) -> float:
    base = {"learning_rate": 0.02, "num_epoch": 10, "batch_size": 16, **CONSTANT}
    algorithm = make_ppo("target", {**base, **hyperparameters})
    one_round(algorithm)
    return algorithm.policy.state_dict()["action_model.log_std"].mean().item()


def test_the_entropy_bonus_widens_the_policy(make_ppo: MakePPO) -> None:
    assert spread(make_ppo, beta=10.0) > spread(make_ppo, beta=0.0) + 0.1
    assert spread(make_ppo, beta=10.0) > 0.1


def test_the_penalty_on_divergence_holds_the_policy_back(make_ppo: MakePPO) -> None:
    divergence = {}
    for weight in (0.0, 1e3):
        hyper = {"learning_rate": 0.01, "num_epoch": 20, "kl_penalty": weight, "epsilon": 10.0}
        divergence[weight] = one_round(make_ppo("target", hyper))[0]["Policy/KL"]
    assert 0 <= divergence[1e3] < divergence[0.0] / 2


def test_batch_size_over_buffer_size_is_refused() -> None:
    with pytest.raises(ValidationError, match="batch_size 64 is over buffer_size 32: lower"):
        PPOHyperparameters(batch_size=64, buffer_size=32)


# -- one update ----------------------------------------------------------------------------------


def test_statistics_name_everything_that_ml_agents_users_look_for(make_ppo: MakePPO) -> None:
    statistics, _ = one_round(make_ppo())
    assert set(statistics) == {
        "Losses/Policy Loss",
        "Losses/Value Loss",
        "Policy/Entropy",
        "Policy/KL",
        "Policy/Clip Fraction",
        "Policy/Learning Rate",
        "Policy/Critic Learning Rate",
        "Policy/Epsilon",
        "Policy/Beta",
        "Policy/Explained Variance",
    }
    assert all(type(value) is float and math.isfinite(value) for value in statistics.values())
    # Two dimensions of standard deviation 1: log(2 pi e), hardly changed by one update.
    assert statistics["Policy/Entropy"] == pytest.approx(math.log(2 * math.pi * math.e), abs=0.05)
    assert statistics["Policy/KL"] >= 0


def test_first_look_at_a_batch_finds_the_policy_unmoved(make_ppo: MakePPO) -> None:
    statistics, _ = one_round(make_ppo("target", {"batch_size": 16}))
    assert statistics["Policy/KL"] == pytest.approx(0.0, abs=1e-10)
    assert statistics["Policy/Clip Fraction"] == 0.0
    assert statistics["Losses/Policy Loss"] == pytest.approx(0.0, abs=1e-6)  # mean of normalised A


def test_normalisation_learns_from_a_rollout_after_the_update(make_ppo: MakePPO) -> None:
    algorithm = make_ppo(
        "target", {"batch_size": 16, "learning_rate": 1e-30}, {"normalize": True}, seed=3
    )
    counts = [buffer for name, buffer in algorithm.policy.named_buffers() if "count" in name]
    for collected in (16, 32):
        algorithm.collect()
        assert [int(count) for count in counts] == [collected - 16]
        statistics = algorithm.update(0.0)
        # Had the statistics come first, the same weights would have meant another policy.
        assert statistics["Policy/KL"] == pytest.approx(0.0, abs=1e-10)
        assert [int(count) for count in counts] == [collected]


def test_a_batch_in_which_all_is_equal_changes_the_critic_alone(
    scripted: Any, make_factory: Callable[..., NetworkFactory]
) -> None:
    space = gymnasium.spaces.Dict({"x": Box(-1.0, 1.0, (1,), np.float32)})
    ones = np.ones((9, 2, 1))
    env = scripted(
        space,
        {"x": ones},
        reward=np.full((8, 2), 3.0),
        terminated=np.ones((8, 2)),
        final={"x": ones[1:]},
    )
    env_runner = EnvRunner(env)
    env_runner.reset()
    settings = PPOSettings(
        hyperparameters=PPOHyperparameters(
            batch_size=4, buffer_size=16, beta=0.0, learning_rate=0.1
        ),
        network_settings={"critic": "separate", "hidden_units": 4},
    )
    generator = torch.Generator().manual_seed(0)
    factory = make_factory(space.spaces)
    algorithm = PPO(factory, settings, env_runner, generator, torch.device("cpu"))
    actor = snapshot(algorithm.policy.actor_parameters())
    critic = snapshot(algorithm.policy.critic_parameters())
    statistics, _ = one_round(algorithm)
    assert all(math.isfinite(value) for value in statistics.values())
    assert statistics["Policy/Explained Variance"] == 0.0
    assert not changed(actor, algorithm.policy.actor_parameters())
    assert changed(critic, algorithm.policy.critic_parameters())


def test_a_loss_that_is_not_finite_stops_the_run_before_the_weights_change(
    make_session: Callable[..., Session],
) -> None:
    session = make_session()
    algorithm, env = session.algorithm, session.env_runner.env
    step = env.step

    def huge(actions: np.ndarray) -> Any:
        observations, reward, *rest = step(actions)
        return observations, np.full_like(reward, 1e30), *rest  # its square is no float32

    env.step = huge  # type: ignore[method-assign]
    before = snapshot(iter(algorithm.policy.state_dict().values()))
    algorithm.collect()
    with pytest.raises(
        NonFiniteError, match=r"step 16: the loss is (inf|nan), its gradient's norm"
    ):
        algorithm.update(0.0)
    assert not changed(before, iter(algorithm.policy.state_dict().values()))


def test_going_back_to_a_state_repeats_everything(make_ppo: MakePPO) -> None:
    algorithm = make_ppo("target", CONSTANT)
    one_round(algorithm)
    weights = {name: t.clone() for name, t in algorithm.policy.state_dict().items()}
    state = copy.deepcopy(algorithm.state_dict())
    env_runner = algorithm._env_runner
    world = copy.deepcopy(env_runner.state_dict())
    one_round(algorithm)
    after = snapshot(algorithm.policy.parameters())
    algorithm.load_state_dict(weights, state)
    env_runner.load_state_dict(world)
    assert changed(after, algorithm.policy.parameters())
    one_round(algorithm)
    assert not changed(after, algorithm.policy.parameters())


# -- learning ------------------------------------------------------------------------------------


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU: PPO on CUDA")
@pytest.mark.parametrize("memory", [None, {"type": "lstm", "memory_size": 4}])
def test_it_learns_and_goes_back_on_cuda(make_ppo: MakePPO, memory: Any) -> None:
    """From images in uint16, which torch has fewer operations for on a GPU."""
    camera = {"camera": {"type": "conv", "layers": [[8, 8, 1]]}}
    algorithm = make_ppo("picture", {}, {"memory": memory}, encoders=camera, device="cuda")
    before = snapshot(algorithm.policy.parameters())
    statistics, _ = one_round(algorithm)
    assert all(math.isfinite(value) for value in statistics.values())
    assert changed(before, algorithm.policy.parameters())
    env = algorithm._env_runner.env
    policy = Policy(algorithm.policy, env.single_observation_space, env.single_action_space)
    actions, _ = policy.predict(algorithm._env_runner.observations)
    weights = {k: v.clone() for k, v in algorithm.policy.state_dict().items()}
    algorithm.load_state_dict(weights, copy.deepcopy(algorithm.state_dict()))
    again, _ = policy.predict(algorithm._env_runner.observations)
    np.testing.assert_array_equal(actions, again)
    one_round(algorithm)


def learned(algorithm: PPO, rounds: int) -> tuple[float, float]:
    """Mean reward of the episodes of the first and of the last two rounds."""
    parts = []
    for number in range(rounds):
        algorithm.collect()
        algorithm.update(number / rounds)
        parts.append(algorithm._env_runner.pop_finished())
    first, last = parts[0], concatenate(parts[-2:])
    return float((first.rewards / first.lengths).mean()), float(
        (last.rewards / last.lengths).mean()
    )


BIG = {"batch_size": 64, "buffer_size": 256, "num_epoch": 4, "gamma": 0.0, "beta": 0.0}


@pytest.mark.parametrize("critic", ["shared", "separate"])
def test_it_learns_to_hit_a_point(make_ppo: MakePPO, critic: str) -> None:
    network = {"hidden_units": 32, "initial_std": 0.5, "critic": critic}
    environment = {"type": "target", "num_envs": 16, "privileged": critic == "separate"}
    algorithm = make_ppo(environment, {**BIG, "learning_rate": 1e-2}, network)
    first, last = learned(algorithm, 25)
    assert first < -0.6
    assert last > -0.25


@pytest.mark.parametrize("settings", [{"squash": "tanh"}, {"state_dependent_std": True}])
def test_it_learns_to_hit_a_point_with_another_gaussian(
    make_ppo: MakePPO, settings: dict[str, Any]
) -> None:
    network = {"hidden_units": 32, "initial_std": 0.5, "critic": "separate", **settings}
    algorithm = make_ppo(
        {"type": "target", "num_envs": 16}, {**BIG, "learning_rate": 1e-2}, network
    )
    first, last = learned(algorithm, 25)
    assert first < -0.6
    assert last > -0.25


@pytest.mark.parametrize("kind", ["choice", "choices"])
def test_it_learns_to_choose(make_ppo: MakePPO, kind: str) -> None:
    environment = {"type": kind, "num_envs": 16}
    first, last = learned(make_ppo(environment, {**BIG, "learning_rate": 1e-2}), 13)
    assert first < -0.5  # two wrong of three, or of three and of two in the mean
    assert last > -0.05


def test_it_learns_from_images(make_ppo: MakePPO) -> None:
    environment = {"type": "picture", "num_envs": 16}
    camera = {"camera": {"type": "conv", "layers": [[8, 8, 1]]}}
    algorithm = make_ppo(
        environment, {**BIG, "learning_rate": 5e-3}, {"initial_std": 0.5}, encoders=camera
    )
    first, last = learned(algorithm, 25)
    assert first < -0.55
    assert last > -0.25


# -- many tries at a frame -----------------------------------------------------------------------


def test_a_baseline_of_other_tries_needs_independent_ones() -> None:
    with pytest.raises(ValidationError, match=r"baseline: frame needs gamma: 0, not 0\.99"):
        PPOHyperparameters(baseline="frame")


def test_mirrored_noise_is_of_continuous_actions(make_session: Callable[..., Session]) -> None:
    with pytest.raises(UserError, match="antithetic: mirrored noise is of continuous actions"):
        make_session("choice", {"hyperparameters": {"antithetic": True}})


def test_tries_at_a_picture_tell_where_its_bar_stands(
    make_session: Callable[..., Session],
) -> None:
    hyper = {
        "gamma": 0.0,
        "baseline": "frame",
        "antithetic": True,
        "buffer_size": 256,
        "batch_size": 64,
        "learning_rate": 1e-2,
        "beta": 0.0,
        **CONSTANT,
    }
    network = {"initial_std": 0.3, "hidden_units": 32}
    environment = {"type": "picture", "num_envs": 32, "episode_steps": 8}
    camera = {"camera": {"type": "conv", "layers": [[4, 3, 1]]}}
    trainer = {"hyperparameters": hyper, "network_settings": network}
    session = make_session(environment, trainer, encoders=camera)
    rewards = []
    for _ in range(40):
        session.algorithm.collect()
        session.algorithm.update(0.0)
        rewards.append(float(session.env_runner.pop_finished().rewards.mean()))
    # Of 8 tries, minus the distance each: guessing costs 4, noise of 0.3 costs 1.9 by itself.
    assert rewards[0] < -4.0
    assert rewards[-1] > -2.0, rewards
