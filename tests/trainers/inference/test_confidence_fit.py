"""Fitting: against errors whose distribution is known, and against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import mahalanobis
from scipy.stats import binomtest

from trainers.inference.confidence import NEVER, Card, Confidence, JudgedError
from trainers.inference.confidence_fit import (
    LEAST_STD,
    SHRINKAGE,
    Examples,
    choose_threshold,
    fit,
    ordinary_distance,
    rescale,
    wilson_lower,
    without_mistakes,
)

LIMIT = 0.02
SIZE = JudgedError(metric="size", limit=LIMIT, label="size")
CARD = Card(
    weights_sha256="", features=4, errors=(SIZE,), farthest=99.0, target=0.9, episodes=0, seed=0
)


def scale_of(features: torch.Tensor) -> torch.Tensor:
    """Standard deviations of the errors over their limit: from 0.2 to 1.5 for most."""
    return 0.5 * (0.5 * features[:, 0]).exp()


def examples(count: int, seed: int) -> Examples:
    """The error is normal, and how large it may be is told by the first of four features."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn((count, 4), generator=generator)
    errors = (scale_of(features) * torch.randn(count, generator=generator)).abs()
    return Examples(features, errors[:, None], errors <= 1.0)


def never(count: int) -> Examples:
    """What can't be answered: elsewhere along the second feature."""
    features = torch.randn((count, 4), generator=torch.Generator().manual_seed(9))
    features[:, 1] += 5.0
    return Examples(features, torch.full((count, 1), torch.inf), torch.zeros(count, dtype=bool))


@pytest.fixture(scope="module")
def fitted() -> Confidence:
    confidence = Confidence(CARD)
    fit(confidence, examples(20_000, 0), never(1000), seed=0)
    rescale(confidence, examples(8000, 1))
    return confidence.eval()


@torch.no_grad()
def test_errors_and_probabilities_are_what_they_should_be(fitted: Confidence) -> None:
    fresh = examples(4000, 2)
    errors, probability, _ = fitted(fresh.features)
    scale = scale_of(fresh.features)
    # Of a normal distribution: P(|x| <= 1), and E|x|.
    truth = (1.0 / (scale * math.sqrt(2.0))).erf()
    assert (probability - truth).abs().mean() < 0.02
    expected = LIMIT * scale * math.sqrt(2.0 / math.pi)
    assert ((errors[:, 0] - expected).abs() / expected).mean() < 0.12
    for low, high in ((0.3, 0.7), (0.7, 0.9), (0.9, 0.97), (0.97, 1.0)):
        rows = (probability > low) & (probability <= high)
        told = float(probability[rows].mean())
        spread = 4.0 * math.sqrt(told * (1.0 - told) / int(rows.sum())) + 0.01
        assert float(fresh.right[rows].float().mean()) == pytest.approx(told, abs=spread)


@torch.no_grad()
def test_what_can_not_be_answered_is_told_apart(fitted: Confidence) -> None:
    errors, probability, _ = fitted(never(500).features + 0.1)
    assert probability.quantile(0.9) < 0.1
    assert errors.median() > 2.0 * LIMIT


def test_the_distance_is_mahalanobis(fitted: Confidence) -> None:
    features = examples(20_000, 0).features.double().numpy()
    deviations = (features - features.mean(0)) / (features.std(0, ddof=1) + LEAST_STD)
    correlation = deviations.T @ deviations / len(deviations)
    inverse = np.linalg.inv((1 - SHRINKAGE) * correlation + SHRINKAGE * np.eye(4))
    expected = [mahalanobis(row, np.zeros(4), inverse) / 2.0 for row in deviations[:50]]
    told = fitted.distance(torch.from_numpy(features[:50]).float())
    np.testing.assert_allclose(told.numpy(), expected, rtol=1e-4)
    far = ordinary_distance(fitted.distance(torch.from_numpy(features).float()))
    beyond = (fitted.distance(torch.from_numpy(features).float()) > far).float().mean()
    assert float(beyond) == pytest.approx(0.001, abs=1e-4)


def test_equal_seeds_fit_alike_and_leave_the_generator_alone() -> None:
    data, none = examples(1000, 3), never(0)
    before = torch.random.get_rng_state()
    outputs = []
    for seed in (4, 4, 5):
        confidence = Confidence(CARD)
        torch.random.set_rng_state(before)
        fit(confidence, data, none, seed)
        outputs.append(confidence(data.features).probability)
        assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(outputs[0], outputs[1])
    assert not torch.equal(outputs[0], outputs[2])


def test_too_sure_is_made_honest() -> None:
    confidence = Confidence(CARD)
    data = examples(20_000, 6)
    fit(confidence, data, never(0), seed=0)
    honest = Confidence(CARD)
    honest.load_state_dict(confidence.state_dict())
    rescale(honest, data)
    with torch.no_grad():
        confidence.head[-1].weight[0] *= 3.0  # type: ignore[index,operator]
        confidence.head[-1].bias[0] += 1.0  # type: ignore[index,operator]
    rescale(confidence, data)
    with torch.no_grad():
        off = confidence(data.features).probability - honest(data.features).probability
    assert off.abs().max() < 0.01


@given(
    st.lists(
        st.tuples(st.sampled_from([0.1, 0.3, 0.5, 0.7, 0.9, 0.95]), st.booleans()),
        min_size=1,
        max_size=60,
    ),
    st.lists(st.sampled_from([0.05, 0.4, 0.7, 0.93]), max_size=3),
    st.sampled_from([0.1, 0.3, 0.5, 0.7]),
)
def test_thresholds_are_those_of_a_search(
    told: list[tuple[float, bool]], unanswerable: list[float], target: float
) -> None:
    probability = np.array([p for p, _ in told], np.float32)
    right = np.array([r for _, r in told])
    refused = np.array(unanswerable, np.float32)
    found = choose_threshold(probability, right, refused, target)
    best = None
    for threshold in sorted(set(probability.tolist()), reverse=True):
        rows = probability >= threshold
        if rows.mean() < 0.25:
            continue
        lower = wilson_lower(np.array([right[rows].sum()]), np.array([rows.sum()]))[0]
        if lower < target or (refused >= threshold).any():
            break
        best = threshold
    assert found == (NEVER if best is None else best)


def test_bounds_are_wilsons() -> None:
    for right, count in ((0, 5), (5, 5), (997, 1000), (31, 64)):
        exact = binomtest(right, count).proportion_ci(0.98, method="wilson")
        told = wilson_lower(np.array([right]), np.array([count]))
        np.testing.assert_allclose(told, [exact.low], atol=1e-4)


def test_as_many_mistakes_are_left_out_as_are_surely_a_small_share() -> None:
    """By scipy's bounds: one more would not be surely under one in 500."""
    rng = np.random.default_rng(0)
    for count in (0, 1, 100, 2000, 6000, 40_000):
        told = rng.random(count)
        left = without_mistakes(told, 0.002)
        out = count - len(left)
        np.testing.assert_array_equal(left, np.sort(told)[: len(left)])
        if out:
            assert binomtest(out, count).proportion_ci(0.98, method="wilson").high < 0.002
        if count:
            assert binomtest(out + 1, count).proportion_ci(0.98, method="wilson").high >= 0.002
        assert (out > 0) == (count >= 6000)


def test_the_promise_is_kept_in_most_worlds() -> None:
    """Of 200 calibrations on 2,000 episodes, no more than a few promise too much."""
    rng, broken = np.random.default_rng(0), 0
    grid = np.linspace(0.0, 1.0, 20_001)
    for _ in range(200):
        probability = rng.beta(8.0, 0.5, 2000)
        right = rng.random(2000) < probability
        threshold = choose_threshold(probability, right, np.empty(0), 0.97)
        density = grid**7.0 * (1.0 - grid).clip(1e-9) ** -0.5
        assert threshold < 1.0
        rows = grid >= threshold
        kept = (grid * density)[rows].sum() / density[rows].sum()
        broken += kept < 0.97
    assert broken <= 8
