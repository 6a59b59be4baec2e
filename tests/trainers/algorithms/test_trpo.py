"""TRPO: its steps against dense algebra and by hand, its settings by their effect, and learning."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from encoders.conv import Conv
from encoders.spaces import RgbImage
from encoders.vector import Vector
from trainers.algorithms import trpo
from trainers.algorithms.trpo import (
    TRPO,
    TRPOSettings,
    fisher_product,
    flat_gradient,
    kl_constrained_step,
    line_search,
    surrogate_gain,
)
from trainers.common.errors import NonFiniteError
from trainers.experience.env_runner import EnvRunner
from trainers.experience.episodes import concatenate
from trainers.networks.action_models import GaussianActions
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.distributions import Categorical, DiagonalGaussian, Distribution
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import Observations
from trainers.runfile.settings import Component, SettingsError

MakeTRPO = Callable[..., TRPO]
MakeFactory = Callable[..., NetworkFactory]
SEEDS = st.integers(0, 2**32 - 1)
patient = settings(max_examples=50, deadline=None)


def snapshot(tensors: Iterator[Tensor]) -> list[Tensor]:
    return [tensor.detach().clone() for tensor in tensors]


def changed(before: list[Tensor], tensors: Iterator[Tensor]) -> bool:
    return any(not torch.equal(a, b) for a, b in zip(before, tensors, strict=True))


# -- gain ----------------------------------------------------------------------------------------


def test_the_gain_weighs_advantages_by_how_much_likelier_their_actions_became() -> None:
    # Action 0 had probability 0.5 and has 0.6, 0.75 and 0.25: ratios 1.2, 1.5 and 0.5.
    first = torch.tensor([0.6, 0.75, 0.25])
    distribution = Categorical(torch.stack([first.log(), (1 - first).log()], dim=1))
    actions, old = torch.zeros(3, dtype=torch.int64), torch.full((3,), math.log(0.5))
    gain = surrogate_gain(distribution, actions, old, torch.tensor([2.0, -1.0, 4.0]))
    assert gain.item() == pytest.approx((2.4 - 1.5 + 2.0) / 3)


# -- the Fisher matrix ---------------------------------------------------------------------------


def rows_of(matrix: Callable[[Tensor], Tensor], size: int) -> Tensor:
    """A matrix from its products with the unit vectors."""
    return torch.stack([matrix(unit) for unit in torch.eye(size)])


def score(value: Tensor, parameters: list[nn.Parameter]) -> Tensor:
    return flat_gradient(value, parameters, differentiable=True).detach()


def dense_gaussian(distribution: DiagonalGaussian, parameters: list[nn.Parameter]) -> Tensor:
    """Sum of J^T F J over mean and log std, in which the Fisher matrix is diag(1/std^2) and 2 I."""
    count, size = distribution.mean.shape
    parts = []
    for row in range(count):
        for i in range(size):
            mean = score(distribution.mean[row, i], parameters)
            log_std = score(distribution.log_std[i], parameters)
            precision = torch.exp(-2 * distribution.log_std[i].detach())
            parts.append(precision * torch.outer(mean, mean) + 2 * torch.outer(log_std, log_std))
    return torch.stack(parts).sum(0) / count


def dense_categorical(distribution: Categorical, parameters: list[nn.Parameter]) -> Tensor:
    """Expectation of the score's outer product, with all actions by their probabilities."""
    log_probs = distribution.logits.log_softmax(-1)
    parts = []
    for log_prob in log_probs.flatten():
        gradient = score(log_prob, parameters)
        parts.append(log_prob.exp().detach() * torch.outer(gradient, gradient))
    return torch.stack(parts).sum(0) / len(log_probs)


def small_policy(
    make_factory: MakeFactory, seed: int, action_space: Any, **options: Any
) -> tuple[ActorCritic, Observations]:
    torch.manual_seed(seed)
    small = {"hidden_units": 4, "num_layers": 1, "activation": "tanh", **options}
    space = {"x": Box(-9.0, 9.0, (3,), np.float32)}
    policy = ActorCritic(make_factory(space, action_space=action_space), PolicySettings(**small))
    with torch.no_grad():  # the heads' small beginnings would hide mistakes
        for parameter in policy.actor_parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    return policy, Observations({}, {"x": torch.randn(6, 3)})


ACTIONS = [
    (Box(-1.0, 1.0, (2,), np.float32), dense_gaussian),
    (Discrete(3), dense_categorical),
]


@pytest.mark.parametrize(("action_space", "dense"), ACTIONS)
@pytest.mark.parametrize("options", [{}, {"critic": "separate"}, {"initial_std": 0.1}])
@pytest.mark.parametrize("seed", [0, 1])
def test_products_are_those_of_the_dense_fisher_matrix(
    make_factory: MakeFactory,
    seed: int,
    options: dict[str, Any],
    action_space: Any,
    dense: Callable[[Any, list[nn.Parameter]], Tensor],
) -> None:
    policy, observations = small_policy(make_factory, seed, action_space, **options)
    parameters = list(policy.actor_parameters())
    size = sum(parameter.numel() for parameter in parameters)
    matrix = rows_of(
        fisher_product(policy.distribution(observations), parameters, damping=0.0), size
    )
    expected = dense(policy.distribution(observations), parameters)
    assert torch.linalg.matrix_rank(expected) >= 4
    torch.testing.assert_close(matrix, expected, rtol=1e-4, atol=1e-5 * float(expected.max()))


def test_the_fisher_matrix_knows_the_spread_and_its_floor(make_factory: MakeFactory) -> None:
    box = Box(-1.0, 1.0, (2,), np.float32)
    policy, observations = small_policy(make_factory, 0, box, initial_std=0.5, min_std=0.2)
    assert isinstance(policy.action_model, GaussianActions)
    log_std = policy.action_model.log_std
    assert log_std is not None
    with torch.no_grad():
        log_std.fill_(math.log(0.3))
    product = fisher_product(policy.distribution(observations), [log_std], damping=0.0)
    # std = 0.2 + exp(l), so that d log std / dl = 0.3 / 0.5, and F = 2 (0.3 / 0.5)^2.
    assert product(torch.tensor([1.0, -2.0])).tolist() == pytest.approx([0.72, -1.44])


def test_damping_is_added_to_the_diagonal(make_factory: MakeFactory) -> None:
    policy, observations = small_policy(make_factory, 0, Discrete(3))
    parameters = list(policy.actor_parameters())
    vector = torch.randn(sum(parameter.numel() for parameter in parameters))
    products = [
        fisher_product(policy.distribution(observations), parameters, damping)(vector)
        for damping in (0.0, 0.3)
    ]
    torch.testing.assert_close(products[1] - products[0], 0.3 * vector)


def test_parameters_the_policy_does_not_use_count_as_flat(make_factory: MakeFactory) -> None:
    policy, observations = small_policy(make_factory, 0, Discrete(3))
    parameters = [policy.action_head.bias, nn.Parameter(torch.ones(2))]
    product = fisher_product(policy.distribution(observations), parameters, damping=0.5)
    assert product(torch.ones(5))[3:].tolist() == [0.5, 0.5]


@pytest.mark.parametrize("action_space", [Box(-1.0, 1.0, (2,), np.float32), Discrete(3)])
def test_with_convolutions_too_it_is_the_curvature_of_the_divergence(
    make_factory: MakeFactory, action_space: Any
) -> None:
    torch.manual_seed(0)
    camera = Component("conv", Conv, Conv.Settings(layers=[(4, 3, 2), (4, 2, 1)]))
    factory = make_factory({"eye": RgbImage(9, 9)}, {"eye": camera}, action_space)
    policy = ActorCritic(factory, PolicySettings(hidden_units=8))
    frames = torch.randint(0, 255, (5, 9, 9, 3), dtype=torch.uint8)
    observations = Observations({"eye": frames}, {}, torch.tensor([0, 0, 1, 2, 3, 4, 4, 4]))
    parameters = list(policy.actor_parameters())
    size = sum(parameter.numel() for parameter in parameters)
    old = policy.distribution(observations)
    product = fisher_product(old, parameters, damping=0.0)
    v, w = torch.randn(size), torch.randn(size)
    assert v.dot(product(w)).item() == pytest.approx(w.dot(product(v)).item(), rel=1e-3)
    step = 0.01 * v
    expected = 0.5 * step.dot(product(step)).item()
    moved = nn.utils.parameters_to_vector(parameters).detach() + step
    nn.utils.vector_to_parameters(moved, parameters)
    with torch.no_grad():
        divergence = old.detach().kl(policy.distribution(observations)).mean().item()
    # KL(theta || theta + s) = s^T H s / 2 + O(|s|^3)
    assert divergence == pytest.approx(expected, rel=0.05)


# -- the step ------------------------------------------------------------------------------------


def test_the_step_by_hand() -> None:
    # H = diag(2, 8), g = (2, 8): x = (1, 1), x^T H x = 10, and sqrt(2 * 0.05 / 10) = 0.1.
    fisher = torch.tensor([2.0, 8.0])
    step = kl_constrained_step(
        torch.tensor([2.0, 8.0]), lambda v: fisher * v, 0.05, iterations=10, tolerance=0.0
    )
    assert step.tolist() == pytest.approx([0.1, 0.1])


@patient
@given(seed=SEEDS, size=st.integers(1, 12), delta=st.floats(1e-4, 1.0))
def test_no_other_step_within_the_constraint_gains_more(seed: int, size: int, delta: float) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size))
    fisher = torch.from_numpy(root @ root.T + 0.1 * np.eye(size))
    gradient = torch.from_numpy(rng.normal(size=size))
    step = kl_constrained_step(
        gradient, lambda v: fisher @ v, delta, iterations=20 * size, tolerance=1e-10
    )
    assert (0.5 * step @ fisher @ step).item() == pytest.approx(delta)
    others = torch.from_numpy(rng.normal(size=(100, size)))
    others *= (2 * delta / torch.einsum("ki,ij,kj->k", others, fisher, others)).sqrt()[:, None]
    assert (others @ gradient).max() <= (step @ gradient) * (1 + 1e-6)


def test_without_a_gradient_there_is_no_step() -> None:
    step = kl_constrained_step(torch.zeros(3), lambda v: v, 0.01, iterations=5, tolerance=0.0)
    assert step.tolist() == [0.0, 0.0, 0.0]


# -- the line search -----------------------------------------------------------------------------


class Walk:
    """Two parameters that begin at (1, 2), and a search that moves them towards (9, 2)."""

    def __init__(self, outcome: Callable[[float], tuple[float, float]]):
        self.first, self.second = nn.Parameter(torch.tensor(1.0)), nn.Parameter(torch.tensor([2.0]))
        self.outcome, self.seen = outcome, []

    def measure(self) -> tuple[Tensor, Tensor]:
        assert not torch.is_grad_enabled()
        self.seen.append(self.first.item())
        gain, divergence = self.outcome(self.first.item())
        return torch.tensor(gain), torch.tensor(divergence)

    def search(self) -> trpo.LineSearch:
        return line_search(
            self.measure,
            [self.first, self.second],
            torch.tensor([8.0, 0.0]),
            old_gain=0.5,
            delta=0.25,
            coefficient=0.5,
            iterations=4,
        )


def test_the_search_takes_the_first_step_that_keeps_both_promises() -> None:
    # 9: too far; 5: no gain; 3: both at their limits.
    outcomes = {9.0: (2.0, 0.26), 5.0: (0.5, 0.1), 3.0: (0.75, 0.25), 2.0: (9.0, 0.0)}
    walk = Walk(outcomes.__getitem__)
    assert walk.search() == trpo.LineSearch(0.75, 0.25, trials=3, accepted=True)
    assert walk.seen == [9.0, 5.0, 3.0]
    assert (walk.first.item(), walk.second.tolist()) == (3.0, [2.0])


@pytest.mark.parametrize(
    "bad", [(0.5, 0.0), (0.4, 0.0), (9.0, 0.3), (math.nan, 0.0), (9.0, math.nan), (math.inf,) * 2]
)
def test_where_no_step_keeps_them_the_search_puts_everything_back(bad: tuple[float, float]) -> None:
    walk = Walk(lambda _: bad)
    assert walk.search() == trpo.LineSearch(0.5, 0.0, trials=4, accepted=False)
    assert walk.seen == [9.0, 5.0, 3.0, 2.0]
    assert (walk.first.item(), walk.second.tolist()) == (1.0, [2.0])


@patient
@given(seed=SEEDS, magnitude=st.integers(-30, 30))
def test_what_is_put_back_is_the_same_to_the_last_bit(seed: int, magnitude: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    shapes = [(3, 2), (), (2, 1, 2)]
    parameters = [nn.Parameter(torch.randn(shape, generator=generator)) for shape in shapes]
    before = snapshot(iter(parameters))
    places = [parameter.data_ptr() for parameter in parameters]
    result = line_search(
        lambda: (torch.tensor(-1.0), torch.tensor(0.0)),
        parameters,
        10.0**magnitude * torch.randn(11, generator=generator),
        old_gain=0.0,
        delta=1.0,
        coefficient=0.8,
        iterations=3,
    )
    assert not result.accepted
    assert not changed(before, iter(parameters))
    assert [parameter.data_ptr() for parameter in parameters] == places


# -- one update ----------------------------------------------------------------------------------


def one_round(algorithm: TRPO, progress: float = 0.0) -> dict[str, float]:
    algorithm.collect()
    return dict(algorithm.update(progress))


def all_observations(algorithm: TRPO) -> Observations:
    rollout = algorithm._rollout
    assert rollout is not None
    return rollout.observations(torch.arange(len(rollout)))


@pytest.mark.parametrize("environment", ["target", "choice", "picture"])
@pytest.mark.parametrize("delta", [1e-4, 0.01, 0.3])
def test_the_policy_stays_within_the_trust_region(
    make_trpo: MakeTRPO, environment: str, delta: float
) -> None:
    camera = {"camera": {"type": "conv", "layers": [[4, 4, 2]]}} if environment == "picture" else {}
    algorithm = make_trpo(
        environment, {"delta": delta, "buffer_size": 64, "damping": 1e-3}, encoders=camera
    )
    for _ in range(4):
        algorithm.collect()
        observations = all_observations(algorithm)
        old = algorithm.policy.distribution(observations).detach()
        statistics = algorithm.update(0.0)
        divergence = old.kl(algorithm.policy.distribution(observations)).mean().item()
        assert divergence <= delta
        assert divergence == pytest.approx(statistics["Policy/KL"], rel=1e-3, abs=1e-9)
        if statistics["Policy/Step Accepted"]:
            assert divergence > delta / 10  # it makes use of the region


def test_a_rejected_step_leaves_the_policy_and_teaches_the_critic(
    make_trpo: MakeTRPO, monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = make_trpo("target", {"backtrack_iterations": 3})
    step = algorithm._step
    monkeypatch.setattr(algorithm, "_step", lambda *rest: -step(*rest))  # down instead of up
    actor = snapshot(algorithm.policy.actor_parameters())
    critic = snapshot(algorithm.policy.critic_parameters())
    statistics = one_round(algorithm)
    assert not changed(actor, algorithm.policy.actor_parameters())
    assert changed(critic, algorithm.policy.critic_parameters())
    assert statistics["Policy/Step Accepted"] == 0.0
    assert statistics["Policy/Line Search Steps"] == 3.0
    assert statistics["Policy/KL"] == 0.0


def test_statistics_have_the_names_they_have_with_ppo(make_trpo: MakeTRPO) -> None:
    statistics = one_round(make_trpo())
    assert set(statistics) == {
        "Losses/Policy Loss",
        "Losses/Value Loss",
        "Policy/Entropy",
        "Policy/KL",
        "Policy/Learning Rate",
        "Policy/Delta",
        "Policy/Line Search Steps",
        "Policy/Step Accepted",
        "Policy/Explained Variance",
    }
    assert all(type(value) is float and math.isfinite(value) for value in statistics.values())
    assert statistics["Policy/Entropy"] == pytest.approx(math.log(2 * math.pi * math.e), abs=1e-4)
    assert statistics["Losses/Policy Loss"] < 0


def test_a_round_is_the_same_each_time(make_trpo: MakeTRPO) -> None:
    policies = []
    for _ in range(2):
        algorithm = make_trpo("target", {"fisher_fraction": 0.5})
        one_round(algorithm)
        policies.append(snapshot(algorithm.policy.parameters()))
    assert all(torch.equal(a, b) for a, b in zip(*policies, strict=True))


def test_update_needs_a_collection_of_its_own(make_trpo: MakeTRPO) -> None:
    algorithm = make_trpo()
    one_round(algorithm)
    with pytest.raises(RuntimeError, match="after collect"):
        algorithm.update(0.0)


def test_going_back_to_a_state_repeats_everything(make_trpo: MakeTRPO) -> None:
    algorithm = make_trpo("target", {"fisher_fraction": 0.5}, {"normalize": True})
    one_round(algorithm)
    weights = {name: t.clone() for name, t in algorithm.policy.state_dict().items()}
    state = copy.deepcopy(algorithm.state_dict())
    world = copy.deepcopy(algorithm._env_runner.state_dict())
    one_round(algorithm)
    after = snapshot(iter(algorithm.policy.state_dict().values()))
    algorithm.load_state_dict(weights, state)
    algorithm._env_runner.load_state_dict(world)
    assert changed(after, iter(algorithm.policy.state_dict().values()))
    one_round(algorithm)
    assert not changed(after, iter(algorithm.policy.state_dict().values()))


def test_normalisation_learns_from_a_rollout_after_the_update(make_trpo: MakeTRPO) -> None:
    algorithm = make_trpo("target", {"delta": 1e-8}, {"normalize": True})
    counts = [buffer for name, buffer in algorithm.policy.named_buffers() if "count" in name]
    assert len(counts) == 2
    for collected in (16, 32):
        algorithm.collect()
        assert {int(count) for count in counts} == {collected - 16}
        assert algorithm.update(0.0)["Policy/KL"] <= 1e-8
        assert {int(count) for count in counts} == {collected}


def test_a_batch_in_which_all_is_equal_changes_the_critic_alone(
    scripted: Any, make_factory: MakeFactory
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
    options = TRPOSettings(
        hyperparameters={"batch_size": 4, "buffer_size": 16}, network_settings={"hidden_units": 4}
    )
    generator = torch.Generator().manual_seed(0)
    factory = make_factory(space.spaces)
    algorithm = TRPO(factory, options, env_runner, generator, torch.device("cpu"))
    actor = snapshot(algorithm.policy.actor_parameters())
    critic = snapshot(algorithm.policy.critic_parameters())
    statistics = one_round(algorithm)
    assert all(math.isfinite(value) for value in statistics.values())
    assert not changed(actor, algorithm.policy.actor_parameters())
    assert changed(critic, algorithm.policy.critic_parameters())


def test_a_gain_that_is_not_finite_stops_the_run_before_any_weights_change(
    make_trpo: MakeTRPO,
) -> None:
    algorithm = make_trpo()
    algorithm.collect()
    rollout = algorithm._rollout
    assert rollout is not None
    impossible = torch.full_like(rollout.log_probs, -math.inf)
    algorithm._rollout = dataclasses.replace(rollout, log_probs=impossible)
    before = snapshot(algorithm.policy.parameters())
    with pytest.raises(NonFiniteError, match=r"step 16: the loss is .*(inf|nan), its gradient's"):
        algorithm.update(0.0)
    assert not changed(before, algorithm.policy.parameters())


def test_a_value_loss_that_is_not_finite_stops_the_run_before_the_critic_changes(
    make_trpo: MakeTRPO,
) -> None:
    algorithm = make_trpo()
    algorithm.collect()
    rollout = algorithm._rollout
    assert rollout is not None
    huge = torch.full_like(rollout.returns, 1e30)  # its square is no float32
    algorithm._rollout = dataclasses.replace(rollout, returns=huge)
    critic = snapshot(algorithm.policy.critic_parameters())
    with pytest.raises(NonFiniteError, match="step 16: the loss is inf, its gradient's norm"):
        algorithm.update(0.0)
    assert not changed(critic, algorithm.policy.critic_parameters())


# -- settings ------------------------------------------------------------------------------------


def test_schedules_reach_the_critic_and_the_trust_region(make_trpo: MakeTRPO) -> None:
    hyperparameters = {
        "learning_rate": 4e-3,
        "learning_rate_schedule": "linear",
        "delta": 0.1,
        "delta_schedule": {"type": "polynomial", "power": 2},
    }
    algorithm = make_trpo("target", hyperparameters)
    for progress, weight in ((0.0, 1.0), (0.75, 0.25)):
        statistics = one_round(algorithm, progress)
        assert statistics["Policy/Learning Rate"] == pytest.approx(4e-3 * weight)
        assert algorithm._optimizer.param_groups[0]["lr"] == pytest.approx(4e-3 * weight)
        assert statistics["Policy/Delta"] == pytest.approx(0.1 * weight**2)
        assert 0.01 * weight**2 < statistics["Policy/KL"] <= 0.1 * weight**2


def test_gradient_descent_moves_the_critic_alone(make_trpo: MakeTRPO) -> None:
    algorithm = make_trpo("target", {"num_epoch": 3})
    algorithm.collect()
    rollout = algorithm._pop_rollout()
    actor = snapshot(algorithm.policy.actor_parameters())
    critic = snapshot(algorithm.policy.critic_parameters())
    algorithm._optimizer.param_groups[0]["lr"] = 1e-3
    algorithm._fit_critic(rollout)
    assert not changed(actor, algorithm.policy.actor_parameters())
    assert changed(critic, algorithm.policy.critic_parameters())


def test_epochs_bring_the_critic_nearer_to_the_returns(make_trpo: MakeTRPO) -> None:
    errors = []
    for epochs in (1, 60):
        hyper = {"num_epoch": epochs, "batch_size": 16, "learning_rate": 0.01}
        algorithm = make_trpo("target", hyper)
        algorithm.collect()
        observations, rollout = all_observations(algorithm), algorithm._rollout
        assert rollout is not None
        algorithm.update(0.0)
        off = algorithm.policy.value(observations) - rollout.returns
        errors.append(off.square().mean().item())
    assert errors[1] < errors[0] / 2


@pytest.mark.parametrize(("fraction", "rows"), [(1.0, 32), (0.25, 8), (0.01, 1)])
def test_the_fisher_matrix_is_taken_over_a_share_of_the_buffer(
    make_trpo: MakeTRPO, monkeypatch: pytest.MonkeyPatch, fraction: float, rows: int
) -> None:
    seen: list[int] = []

    def counting(distribution: Distribution, *rest: Any) -> Any:
        seen.append(len(distribution.entropy()))
        return fisher_product(distribution, *rest)

    monkeypatch.setattr(trpo, "fisher_product", counting)
    one_round(make_trpo("target", {"buffer_size": 32, "fisher_fraction": fraction}))
    assert seen == [rows]


def test_the_critic_gets_a_network_of_its_own_without_being_asked(make_trpo: MakeTRPO) -> None:
    assert make_trpo().policy.critic is not None


def test_a_shared_critic_is_refused_with_the_way_out(make_trpo: MakeTRPO) -> None:
    with pytest.raises(SettingsError) as caught:
        make_trpo("target", {}, {"critic": "shared"})
    assert "trainer.network_settings.critic: 'shared' does not suit trpo" in str(caught.value)
    assert "use separate" in str(caught.value)


def test_an_encoder_with_frozen_weights_stays_as_it_is(
    make_trpo: MakeTRPO, monkeypatch: pytest.MonkeyPatch
) -> None:
    def freeze(encoder: Vector, space: Any, options: Any) -> None:
        build(encoder, space, options)
        encoder.register_parameter("fixed", nn.Parameter(torch.ones(2), requires_grad=False))

    build = Vector.__init__
    monkeypatch.setattr(Vector, "__init__", freeze)
    policy = (algorithm := make_trpo()).policy
    fixed = [parameter for parameter in policy.parameters() if not parameter.requires_grad]
    free = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    before = snapshot(iter(free))
    one_round(algorithm)
    assert [parameter.tolist() for parameter in fixed] == [[1.0, 1.0]] * 2
    assert changed(before, iter(free))


MEMORIES: list[Any] = [{"type": kind, "memory_size": 8} for kind in ("lstm", "gru")]


@pytest.mark.parametrize(("memory", "enabled"), [(None, True), (MEMORIES[0], False)])
def test_cudnn_which_has_no_second_derivative_of_memory_is_spared_it(
    make_trpo: MakeTRPO, monkeypatch: pytest.MonkeyPatch, memory: Any, enabled: bool
) -> None:
    seen: list[bool] = []
    product = trpo.fisher_product

    def watched(*arguments: Any) -> Any:
        seen.append(torch.backends.cudnn.enabled)
        return product(*arguments)

    monkeypatch.setattr(trpo, "fisher_product", watched)
    one_round(make_trpo("recall", {}, {"memory": memory}))
    assert seen == [enabled]
    assert torch.backends.cudnn.enabled


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU: TRPO with memory on CUDA")
@pytest.mark.parametrize("memory", MEMORIES)
def test_it_takes_a_step_with_memory_on_cuda(make_trpo: MakeTRPO, memory: Any) -> None:
    algorithm = make_trpo("recall", {}, {"memory": memory}, device="cuda")
    before = snapshot(algorithm.policy.actor_parameters())
    statistics = one_round(algorithm)
    assert all(math.isfinite(value) for value in statistics.values())
    assert statistics["Policy/Step Accepted"] == 1.0
    assert changed(before, algorithm.policy.actor_parameters())


# -- learning ------------------------------------------------------------------------------------


def learned(algorithm: TRPO, rounds: int) -> tuple[float, float]:
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


BIG = {"batch_size": 64, "buffer_size": 256, "num_epoch": 4, "gamma": 0.0, "delta": 0.1}


@pytest.mark.parametrize("privileged", [False, True])
def test_it_learns_to_hit_a_point(make_trpo: MakeTRPO, privileged: bool) -> None:
    network: dict[str, Any] = {"hidden_units": 32, "initial_std": 0.5}
    if privileged:
        network["critic_observations"] = ["goal", "privileged"]
    environment = {"type": "target", "num_envs": 16, "privileged": privileged}
    first, last = learned(make_trpo(environment, BIG, network), 30)
    assert first < -0.6
    assert last > -0.25


def test_it_learns_to_hit_a_point_with_a_squashed_gaussian(make_trpo: MakeTRPO) -> None:
    network = {"hidden_units": 32, "initial_std": 0.5, "squash": "tanh"}
    first, last = learned(make_trpo({"type": "target", "num_envs": 16}, BIG, network), 30)
    assert first < -0.6
    assert last > -0.25


@pytest.mark.parametrize("kind", ["choice", "choices"])
def test_it_learns_to_choose(make_trpo: MakeTRPO, kind: str) -> None:
    environment = {"type": kind, "num_envs": 16}
    first, last = learned(make_trpo(environment, BIG), 15)
    assert first < -0.5  # two wrong of three, or of three and of two in the mean
    assert last > -0.05


def test_it_learns_from_images_with_a_share_of_the_fisher_matrix(make_trpo: MakeTRPO) -> None:
    environment = {"type": "picture", "num_envs": 16}
    camera = {"camera": {"type": "conv", "layers": [[8, 8, 1]]}}
    algorithm = make_trpo(
        environment, {**BIG, "fisher_fraction": 0.5}, {"initial_std": 0.5}, encoders=camera
    )
    first, last = learned(algorithm, 30)
    assert first < -0.55
    assert last > -0.25
