"""How sure a policy is: what the module works out, and what is stored."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.evaluation import Figure, error
from trainers.common.errors import UserError
from trainers.inference.confidence import (
    FILE,
    STEPS_OF_LIMIT,
    Card,
    Confidence,
    JudgedError,
    judged_errors,
    read_confidence,
    to_bytes,
    weights_digest,
)
from trainers.saving.checkpoint import WEIGHTS

LENGTH = JudgedError(metric="length_m", limit=0.01, label="length", unit="mm", scale=1000.0)
ANGLE = JudgedError(metric="angle", limit=2.0, label="angle")
ANY = JudgedError(metric="fell", limit=0.0, label="fell", unit="%", scale=100.0)

Make = Callable[..., Confidence]


@pytest.fixture
def make() -> Make:
    """A confidence of three features whose last layer says 0 whatever it sees."""

    def made(errors: tuple[JudgedError, ...] = (LENGTH, ANY, ANGLE), **card: object) -> Confidence:
        known = {"weights_sha256": "", "target": 0.9, "episodes": 0, "seed": 0, **card}
        confidence = Confidence(Card(features=3, errors=errors, **known))  # type: ignore[arg-type]
        torch.nn.init.zeros_(confidence.head[-1].weight)  # type: ignore[arg-type]
        torch.nn.init.zeros_(confidence.head[-1].bias)  # type: ignore[arg-type]
        return confidence

    return made


def test_errors_are_the_area_under_their_survival(make: Make) -> None:
    confidence = make(farthest=9.0, threshold=0.5)
    errors, probability, sure = confidence(torch.zeros(2, 3))
    assert probability.tolist() == [0.5, 0.5]
    assert sure.tolist() == [True, True]
    # A half from the first step, 1/8, to the last, 4; before it from 1 down to a half.
    of_limit = 0.75 * 0.125 + 0.5 * (4.0 - 0.125)
    expected = [[0.01 * of_limit, 2.0 * of_limit]] * 2
    torch.testing.assert_close(errors, torch.tensor(expected))


def test_features_like_none_of_training_mean_nothing(make: Make) -> None:
    confidence = make(farthest=2.0, threshold=0.1)
    confidence.mean.copy_(torch.tensor([1.0, 0.0, 0.0]))
    confidence.std.copy_(torch.tensor([1.0, 2.0, 1.0]))
    confidence.whitening.copy_(torch.diag(torch.tensor([1.0, 1.0, 0.5])))
    features = torch.tensor([[1.0, 0.0, 0.0], [1.0, 6.0, 0.0], [1.0, 8.0, 0.0], [1.0, 0.0, 6.9]])
    distance = [0.0, 3.0 / 3**0.5, 4.0 / 3**0.5, 3.45 / 3**0.5]
    torch.testing.assert_close(confidence.distance(features), torch.tensor(distance))
    errors, probability, sure = confidence(features)
    assert sure.tolist() == [True, True, False, True]
    assert probability.tolist() == [0.5, 0.5, 0.0, 0.5]
    torch.testing.assert_close(errors[2], torch.tensor([0.04, 8.0]))
    assert (confidence.standardized(torch.full((1, 3), 1e6)) == 10.0).all()


def test_errors_are_shown_as_the_figures_of_their_environment() -> None:
    figures = [error("length_m", "length", "mm", 1000.0), Figure("other", "other")]
    told = judged_errors(figures, {"length_m": 0.01, "new_metric": 2.0})
    assert told[0] == LENGTH
    assert [one.shown(one.limit) for one in told] == ["length 10.00 mm", "new metric 2.000"]


def test_it_comes_back_as_it_was_stored(make: Make, tmp_path: Path) -> None:
    (tmp_path / WEIGHTS).write_bytes(b"weights")
    assert read_confidence(tmp_path) is None
    confidence = make(weights_sha256=weights_digest(tmp_path), farthest=2.5, threshold=0.7)
    torch.nn.init.normal_(confidence.head[-1].weight)  # type: ignore[arg-type]
    torch.nn.init.normal_(confidence.whitening)
    (tmp_path / FILE).write_bytes(to_bytes(confidence))
    found = read_confidence(tmp_path)
    assert found is not None
    assert found.card == confidence.card
    features = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    for ours, theirs in zip(confidence(features), found(features), strict=True):
        assert torch.equal(ours, theirs)


def test_of_other_weights_it_is_refused(make: Make, tmp_path: Path) -> None:
    (tmp_path / WEIGHTS).write_bytes(b"weights")
    (tmp_path / FILE).write_bytes(to_bytes(make(weights_sha256=weights_digest(tmp_path))))
    (tmp_path / WEIGHTS).write_bytes(b"others")
    with pytest.raises(UserError, match=r"belongs to other weights .* trainers.calibrate"):
        read_confidence(tmp_path)


def test_what_is_damaged_is_refused(make: Make, tmp_path: Path) -> None:
    (tmp_path / WEIGHTS).write_bytes(b"weights")
    whole = to_bytes(make(weights_sha256=weights_digest(tmp_path)))
    narrow = Card(features=2, errors=(ANGLE,), weights_sha256="", target=0.9, episodes=0, seed=0)
    stretched = make()
    stretched.card = narrow
    huge, unknown = make(), make()
    huge.card = huge.card.model_copy(update={"features": 10**9})
    unknown.mean[0] = torch.nan
    for content in (b"", whole[:-5], whole[:100], *map(to_bytes, (stretched, huge, unknown))):
        (tmp_path / FILE).write_bytes(content)
        with pytest.raises(UserError, match=rf"{FILE}: can't be used: .* delete it, and run"):
            read_confidence(tmp_path)
    newer = make()
    newer.card = newer.card.model_copy(update={"format": 2})
    (tmp_path / FILE).write_bytes(to_bytes(newer))
    with pytest.raises(UserError, match="format 2, where this version reads 1"):
        read_confidence(tmp_path)


def test_steps_rise_and_have_the_limit_among_them() -> None:
    assert np.all(np.diff(STEPS_OF_LIMIT) > 0.0)
    assert 1.0 in STEPS_OF_LIMIT
