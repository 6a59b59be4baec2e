import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import distributions as reference

from trainers.networks.distributions import (
    Categorical,
    DiagonalGaussian,
    Distribution,
    MultiCategorical,
    TanhGaussian,
)


def gaussian(seed, rows=7, actions=3, *, shared=False, scale=1.0):
    draw = torch.Generator().manual_seed(seed)
    shape = (actions,) if shared else (rows, actions)
    mean = scale * torch.randn(rows, actions, generator=draw, dtype=torch.float64)
    return DiagonalGaussian(mean, 0.5 * torch.randn(shape, generator=draw, dtype=torch.float64))


def categorical(seed, rows=7, choices=4, *, scale=1.0):
    draw = torch.Generator().manual_seed(seed)
    return Categorical(scale * torch.randn(rows, choices, generator=draw, dtype=torch.float64))


def squashed(seed, **options):
    return TanhGaussian(**vars(gaussian(seed, **options)))


def choices(seed, rows=7, sizes=(2, 3), *, scale=1.0):
    return MultiCategorical(categorical(seed, rows, sum(sizes), scale=scale).logits, sizes)


def torch_gaussian(ours):
    normal = reference.Normal(ours.mean, ours.log_std.exp().expand_as(ours.mean))
    return reference.Independent(normal, 1)


def torch_categorical(ours):
    return reference.Categorical(logits=ours.logits)


def reference_of(ours):
    return torch_gaussian(ours) if isinstance(ours, DiagonalGaussian) else torch_categorical(ours)


PAIRS = [
    pytest.param(gaussian(1), gaussian(2), id="gaussian"),
    pytest.param(gaussian(1, shared=True), gaussian(2, shared=True), id="gaussian-shared"),
    pytest.param(gaussian(1, shared=True), gaussian(2), id="gaussian-mixed"),
    pytest.param(categorical(1), categorical(2), id="categorical"),
]

EVERY_PAIR = [
    *PAIRS,
    pytest.param(squashed(1), squashed(2), id="tanh"),
    pytest.param(squashed(1, shared=True), squashed(2, shared=True), id="tanh-shared"),
    pytest.param(choices(1), choices(2), id="choices"),
]


@pytest.mark.parametrize(("p", "q"), PAIRS)
def test_agrees_with_torch_distributions(p: Distribution, q: Distribution):
    theirs = reference_of(p)
    actions = q.sample(torch.Generator().manual_seed(0))
    torch.testing.assert_close(p.log_prob(actions), theirs.log_prob(actions))
    torch.testing.assert_close(p.entropy(), theirs.entropy())
    torch.testing.assert_close(p.kl(q), reference.kl_divergence(theirs, reference_of(q)))
    assert p.log_prob(actions).shape == p.entropy().shape == p.kl(q).shape == (7,)


@pytest.mark.parametrize(("p", "q"), PAIRS)
def test_gradients_agree_with_torch_distributions(p: Distribution, q: Distribution):
    actions = q.sample(torch.Generator().manual_seed(0))

    def gradients(view):
        tensors = {name: tensor.clone().requires_grad_() for name, tensor in vars(p).items()}
        distribution = view(type(p)(**tensors))
        loss = distribution.log_prob(actions).sum() + 2 * distribution.entropy().sum()
        return torch.autograd.grad(loss, list(tensors.values()))

    torch.testing.assert_close(gradients(lambda ours: ours), gradients(reference_of))


@pytest.mark.parametrize("p", [gaussian(1), gaussian(1, shared=True), categorical(1)])
def test_second_derivatives_of_the_kl_agree_with_torch_distributions(p: Distribution):
    """At the distribution itself, where they are the Fisher matrix that TRPO needs."""

    def hessians(divergence, view):
        tensors = {name: tensor.clone().requires_grad_() for name, tensor in vars(p).items()}
        kl = divergence(view(p), view(type(p)(**tensors))).sum()
        gradients = torch.autograd.grad(kl, list(tensors.values()), create_graph=True)
        assert all(gradient.abs().max() < 1e-12 for gradient in gradients)
        # Not all the same number: logits that move together change nothing.
        weighted = [g.flatten() @ torch.arange(g.numel(), dtype=g.dtype) for g in gradients]
        return torch.autograd.grad(sum(weighted), list(tensors.values()))

    ours = hessians(lambda a, b: a.kl(b), lambda same: same)
    theirs = hessians(reference.kl_divergence, reference_of)
    assert ours[0].abs().max() > 0.1
    torch.testing.assert_close(ours, theirs)


def test_gaussian_by_hand():
    p = DiagonalGaussian(torch.zeros(1, 2), torch.tensor([[0.0, math.log(2.0)]]))
    q = DiagonalGaussian(torch.tensor([[1.0, 0.0]]), torch.zeros(1, 2))
    # At the mean: -log(2 pi) - log 2; one sigma off in the second dimension: 1/2 less.
    assert p.log_prob(torch.zeros(1, 2)).item() == pytest.approx(-1.8378771 - 0.6931472)
    assert p.log_prob(torch.tensor([[0.0, 2.0]])).item() == pytest.approx(-2.5310243 - 0.5)
    assert p.entropy().item() == pytest.approx(2 * 1.4189385 + 0.6931472)
    # (1/2 for the means) + (4/2 - 1/2 - log 2)
    assert p.kl(q).item() == pytest.approx(0.5 + 1.5 - 0.6931472)


def test_categorical_by_hand():
    p = Categorical(torch.tensor([[math.log(3.0), 0.0]]))  # 3/4, 1/4
    q = Categorical(torch.tensor([[5.0, 5.0]]))  # 1/2, 1/2
    assert p.log_prob(torch.tensor([1])).exp().item() == pytest.approx(0.25)
    assert p.log_prob(torch.tensor([0])).exp().item() == pytest.approx(0.75)
    assert p.entropy().item() == pytest.approx(0.5623351)
    assert p.kl(q).item() == pytest.approx(0.6931472 - 0.5623351)
    assert p.mode().tolist() == [0]


@pytest.mark.parametrize(("p", "q"), EVERY_PAIR)
def test_entropy_and_kl_are_the_means_they_stand_for(p: Distribution, q: Distribution):
    draw = torch.Generator().manual_seed(3)
    count = 20_000
    many = torch.arange(7).repeat_interleave(count)
    actions = p[many].sample(draw)
    log_p = p[many].log_prob(actions).reshape(7, count)
    log_q = q[many].log_prob(actions).reshape(7, count)
    for estimates, exact in ((-log_p, p.entropy()), (log_p - log_q, p.kl(q))):
        error = (estimates.mean(1) - exact).abs()
        assert (error < 5 * estimates.std(1) / math.sqrt(count)).all()


def test_gaussian_samples_have_its_moments():
    p = DiagonalGaussian(
        torch.tensor([1.0, -2.0]).repeat(50_000, 1), torch.tensor([0.5, 2.0]).log()
    )
    actions = p.sample(torch.Generator().manual_seed(0))
    torch.testing.assert_close(actions.mean(0), torch.tensor([1.0, -2.0]), atol=0.05, rtol=0)
    torch.testing.assert_close(actions.std(0), torch.tensor([0.5, 2.0]), atol=0.05, rtol=0)
    assert torch.corrcoef(actions.T)[0, 1].abs() < 0.02


def test_categorical_samples_have_its_frequencies():
    wanted = torch.tensor([0.5, 0.2, 0.3])
    actions = Categorical(wanted.log().repeat(50_000, 1)).sample(torch.Generator().manual_seed(0))
    assert actions.dtype == torch.int64
    torch.testing.assert_close(actions.bincount() / 50_000, wanted, atol=0.01, rtol=0)


@pytest.mark.parametrize(
    "p",
    [gaussian(1), gaussian(1, shared=True), categorical(1, rows=50), choices(1, 50), squashed(1)],
)
def test_sampling_uses_the_generator_given_and_no_other(p: Distribution):
    before = torch.random.get_rng_state()
    first = p.sample(torch.Generator().manual_seed(5))
    again = p.sample(torch.Generator().manual_seed(5))
    other = p.sample(torch.Generator().manual_seed(6))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_without_a_generator_torchs_own_is_used():
    p = gaussian(1)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        first = p.sample()
        torch.manual_seed(0)
        assert torch.equal(p.sample(None), first)


def test_no_gradient_flows_through_a_sample_and_detach_cuts_the_rest():
    parameters = torch.nn.Parameter(torch.zeros(2, 3))
    for p in (
        DiagonalGaussian(parameters, parameters),
        TanhGaussian(parameters, parameters),
        Categorical(parameters),
        MultiCategorical(parameters, (1, 2)),
    ):
        assert not p.sample().requires_grad
        assert p.entropy().requires_grad
        assert not p.detach().entropy().requires_grad
        assert torch.equal(p.detach().entropy(), p.entropy())


@pytest.mark.parametrize(("p", "q"), EVERY_PAIR)
@pytest.mark.parametrize(
    "rows",
    [
        slice(2, 5),
        torch.tensor([4, 0, 4]),
        torch.tensor([True, False, False, True, False, False, True]),
    ],
)
def test_rows(p: Distribution, q: Distribution, rows):
    actions = q.mode()
    assert torch.equal(p[rows].mode(), p.mode()[rows])
    torch.testing.assert_close(p[rows].log_prob(actions[rows]), p.log_prob(actions)[rows])
    torch.testing.assert_close(p[rows].kl(q[rows]), p.kl(q)[rows])
    assert p[rows].entropy().shape == (3,)


@pytest.mark.parametrize(("p", "q"), EVERY_PAIR)
def test_rows_come_together_again(p: Distribution, q: Distribution):
    count = len(p.mode())
    for distribution in (p, q):
        parts = [distribution[:2], distribution[2:3], distribution[3:]]
        whole = type(distribution).concatenate(parts)
        actions = distribution.sample()
        assert len(whole.mode()) == count
        assert torch.equal(whole.mode(), distribution.mode())
        assert torch.equal(whole.log_prob(actions), distribution.log_prob(actions))


def density(p: TanhGaussian, actions: torch.Tensor) -> torch.Tensor:
    """Densities (n,) of actions (n,) of one row in one dimension."""
    return p[torch.zeros(len(actions), dtype=int)].log_prob(actions.atanh()[:, None]).exp()


@pytest.mark.parametrize("std", [0.3, 1.0])
@pytest.mark.parametrize("mean", [-1.5, 0.0, 0.4])
def test_a_squashed_density_is_one_of_actions(mean, std):
    p = TanhGaussian(torch.tensor([[mean]]).double(), torch.tensor([std]).double().log())
    actions = torch.linspace(-1.0, 1.0, 400_001, dtype=torch.float64)[1:-1]
    values = density(p, actions)
    assert torch.trapezoid(values, actions).item() == pytest.approx(1.0, abs=1e-6)
    surprise = torch.trapezoid(-torch.special.xlogy(values, values), actions).item()
    assert p.entropy().item() == pytest.approx(surprise, abs=1e-5)
    below = torch.trapezoid(values[actions <= 0.2], actions[actions <= 0.2]).item()
    expected = torch.special.ndtr((math.atanh(0.2) - p.mean) / std).item()
    assert below == pytest.approx(expected, abs=1e-5)


def test_a_squashed_density_agrees_with_torch_distributions():
    p = squashed(1)
    u = p.sample(torch.Generator().manual_seed(0))
    normal = reference.Independent(reference.Normal(p.mean, p.log_std.exp()), 1)
    theirs = reference.TransformedDistribution(normal, reference.transforms.TanhTransform())
    torch.testing.assert_close(p.log_prob(u), theirs.log_prob(u.tanh()))


def test_a_wide_gaussian_squashed_is_nearly_uniform_and_never_wider():
    log_stds = torch.linspace(-2.0, 1.0, 301)[:, None]
    entropies = TanhGaussian(torch.zeros(301, 1), log_stds).entropy()
    assert entropies.max() < math.log(2.0)
    assert entropies.max() == pytest.approx(math.log(2.0), abs=0.02)


def test_what_is_squashed_stays_known_where_its_tanh_is_1():
    p = TanhGaussian(torch.tensor([[8.0]]), torch.zeros(1))
    u = torch.tensor([[20.0]], requires_grad=True)
    # log N = -12^2 / 2 - log(2 pi) / 2, log slope = 2 log 2 - 40
    assert p.log_prob(u).item() == pytest.approx(-72.0 - 0.9189385 - 1.3862944 + 40.0, abs=1e-4)


def test_several_choices_are_one_between_all_their_combinations():
    p, q = choices(1), choices(2)

    def joint(several):
        first, second = several.logits.split(several.sizes, 1)
        return Categorical((first[:, :, None] + second[:, None, :]).flatten(1))

    actions = q.sample(torch.Generator().manual_seed(0))
    assert actions.shape == (7, 2)
    assert {actions[:, 0].max().item(), actions[:, 1].max().item()} == {1, 2}
    combined = 3 * actions[:, 0] + actions[:, 1]
    torch.testing.assert_close(p.log_prob(actions), joint(p).log_prob(combined))
    torch.testing.assert_close(p.entropy(), joint(p).entropy())
    torch.testing.assert_close(p.kl(q), joint(p).kl(joint(q)))
    assert torch.equal(3 * p.mode()[:, 0] + p.mode()[:, 1], joint(p).mode())


def test_as_many_rows_as_dimensions_is_not_mistaken_for_shared():
    p = gaussian(1, rows=3, actions=3, shared=True)
    rows = torch.tensor([2, 0])
    assert torch.equal(p[rows].log_std, p.log_std)
    p = gaussian(1, rows=3, actions=3)
    assert torch.equal(p[rows].log_std, p.log_std[rows])


def test_shapes_that_would_broadcast_are_refused():
    with pytest.raises(ValueError, match=r"\(5, 1\).*\(5, 2\) it must be that or \(2,\)"):
        DiagonalGaussian(torch.zeros(5, 2), torch.zeros(5, 1))
    one_dimension = DiagonalGaussian(torch.zeros(5, 1), torch.zeros(1))
    with pytest.raises(ValueError, match=r"\(5,\).*\(5, 1\)"):
        one_dimension.log_prob(torch.zeros(5))


def test_extreme_logits_stay_finite():
    p = Categorical(torch.tensor([[1e4, 0.0, -1e4], [1e4, 1e4, 1e4]]))
    assert p.entropy().tolist() == pytest.approx([0.0, math.log(3)])
    assert p.log_prob(torch.tensor([2, 2])).tolist() == pytest.approx([-2e4, -math.log(3)])
    assert p.kl(p[torch.tensor([1, 0])]).tolist() == pytest.approx([math.log(3), 1e4], rel=1e-3)
    assert p.sample(torch.Generator().manual_seed(0))[0] == 0


def test_kl_of_close_gaussians_survives_single_precision():
    step = 3e-4  # KL = step^2 - 2/3 step^3 + ...
    p = DiagonalGaussian(torch.zeros(1, 1), torch.zeros(1))
    q = DiagonalGaussian(torch.zeros(1, 1), torch.full((1,), step))
    assert p.kl(q).item() == pytest.approx(step**2, rel=1e-3)


finite = st.floats(-5, 5, width=32)
matrices = st.integers(1, 4).flatmap(
    lambda width: st.lists(st.lists(finite, min_size=width, max_size=width), min_size=4, max_size=4)
)


@settings(max_examples=100, deadline=None)
@given(matrices)
def test_kl_is_never_negative_and_zero_for_itself(numbers):
    a, b, c, d = torch.tensor(numbers, dtype=torch.float64).unsqueeze(1)
    pairs: list[tuple[Distribution, Distribution]] = [
        (DiagonalGaussian(a, b), DiagonalGaussian(c, d)),
        (Categorical(a), Categorical(c)),
    ]
    for p, q in pairs:
        assert p.kl(q).item() >= -1e-12
        assert p.kl(p).item() == 0


@settings(max_examples=50, deadline=None)
@given(matrices, finite)
def test_a_categorical_does_not_change_when_all_logits_move(numbers, shift):
    logits = torch.tensor(numbers, dtype=torch.float64)
    p, q = Categorical(logits), Categorical(logits + shift)
    assert p.kl(q).abs().max() < 1e-12
    torch.testing.assert_close(p.entropy(), q.entropy())
    assert (p.entropy() <= math.log(logits.shape[1]) + 1e-12).all()
    everything = [p.log_prob(torch.full((4,), k)).exp() for k in range(logits.shape[1])]
    torch.testing.assert_close(sum(everything), torch.ones(4, dtype=torch.float64))
