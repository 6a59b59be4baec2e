"""Fitting a policy's confidence: the head, the distance, and the threshold of what is sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from trainers.inference.confidence import NEVER, STEPS_OF_LIMIT, Confidence

EPOCHS = 8
LEAST_STEPS = 800
BATCH_SIZE = 512
LEARNING_RATE = 4e-3
WEIGHT_DECAY = 1e-2
FEATURE_NOISE = 0.2
"""Standard deviation of what is added to standardised features, against learning by heart."""
ERRORS_WEIGHT = 5.0
"""Of the loss of how large errors are: far more examples say something of it than of failures."""
SHRINKAGE = 0.1
"""Of the features' correlations towards none (Ledoit & Wolf 2004)."""
LEAST_STD = 1e-3
ORDINARY = 0.999
"""Share of ordinary observations whose distance is ordinary."""
LEAST_COVERAGE = 0.25
MISTAKEN = 0.002
"""Of each kind of what can't be answered, what is called sure is surely a smaller share."""
ONE_SIDED_99 = 2.326
"""Standard deviations of a normal distribution below which 99 % of it lie."""


@dataclass(frozen=True)
class Examples:
    """n first actions; before what can't be answered none is right, and errors are infinite.

    Attributes:
        features: (n, F) that they were chosen by.
        errors: (n, E) over their limits, of those that are `estimated`.
        right: (n,) bool, whether all errors were within their limits.
    """

    features: Tensor
    errors: Tensor
    right: Tensor

    def __len__(self) -> int:
        return len(self.features)

    def __getitem__(self, rows: slice) -> Self:
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))

    @classmethod
    def unanswerable(cls, features: Tensor, errors: int) -> Self:
        """Examples (n, F) none of which is right, with so many errors."""
        n = len(features)
        return cls(features, torch.full((n, errors), torch.inf), torch.zeros(n, dtype=torch.bool))


def joined(parts: Sequence[Examples]) -> Examples:
    """One after the other; there must be one part."""
    names = [field.name for field in fields(Examples)]
    return Examples(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def fit(confidence: Confidence, ordinary: Examples, others: Examples, seed: int) -> None:
    """Fits all but the thresholds.

    Args:
        confidence: changed.
        ordinary: of the task that the policy was trained for; they tell what features are like.
        others: harder ones, and before what can't be answered; there may be none.
        seed: of what is drawn.
    """
    _fit_distance(confidence, ordinary.features)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for layer in confidence.head:
            if isinstance(layer, nn.Linear):
                layer.reset_parameters()
    examples = joined([ordinary, others])
    right = examples.right.float()
    over = (examples.errors[:, :, None] > torch.tensor(STEPS_OF_LIMIT)).float()
    parameters = list(confidence.head.parameters())
    optimizer = torch.optim.AdamW(parameters, LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    steps = max(LEAST_STEPS, EPOCHS * len(examples) // BATCH_SIZE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, steps)
    for _ in range(steps):
        rows = torch.randint(len(examples), (BATCH_SIZE,), generator=generator)
        inputs = confidence.standardized(examples.features[rows])
        noise = FEATURE_NOISE * torch.randn(inputs.shape, generator=generator)
        told_right, told_over = confidence.logits(inputs + noise)
        loss = F.binary_cross_entropy_with_logits(told_right, right[rows])
        if told_over.numel():
            sizes = F.binary_cross_entropy_with_logits(told_over, over[rows])
            loss = loss + ERRORS_WEIGHT * sizes
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


def rescale(confidence: Confidence, examples: Examples) -> None:
    """Makes probabilities honest, which are too sure after fitting: Platt scaling (1999).

    Args:
        confidence: its probability p becomes sigmoid(a logit(p) + b), with a and b in its head.
        examples: others than it was fitted to.
    """
    with torch.no_grad():
        told, _ = confidence.logits(confidence.standardized(examples.features))
    scale, offset = torch.ones((), requires_grad=True), torch.zeros((), requires_grad=True)
    optimizer = torch.optim.LBFGS([scale, offset], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        right = examples.right.float()
        value = F.binary_cross_entropy_with_logits(scale * told + offset, right)
        value.backward()
        return value

    optimizer.step(loss)
    last = confidence.head[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight[0] *= scale
        last.bias[0] = last.bias[0] * scale + offset


def _fit_distance(confidence: Confidence, features: Tensor) -> None:
    """Sets what features are ordinarily: mean, deviations and correlations of (n, F)."""
    confidence.mean.copy_(features.mean(dim=0))
    confidence.std.copy_(features.std(dim=0) + LEAST_STD)
    deviations = ((features - confidence.mean) / confidence.std).double()
    correlation = deviations.T @ deviations / len(deviations)
    shrunk = (1.0 - SHRINKAGE) * correlation + SHRINKAGE * torch.eye(len(correlation))
    # With C = L L^T, |x L^-T|^2 = x C^-1 x^T.
    confidence.whitening.copy_(torch.linalg.inv(torch.linalg.cholesky(shrunk)).T)


def ordinary_distance(distances: Tensor) -> float:
    """The distance that all but one in a thousand of ordinary observations (n,) are within."""
    return float(torch.quantile(distances, ORDINARY))


def wilson_lower(right: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.float64]:
    """Lower bounds (n,) of shares, of which `right` of `count` were seen; true of 99 in 100.

    Wilson 1927, "Probable inference, the law of succession, and statistical inference".
    """
    z2, share = ONE_SIDED_99**2, right / count
    spread = ONE_SIDED_99 * np.sqrt(share * (1.0 - share) / count + z2 / (4.0 * count**2))
    return np.asarray((share + z2 / (2.0 * count) - spread) / (1.0 + z2 / count))


def without_mistakes(
    unanswerable: NDArray[np.floating], share: float = MISTAKEN
) -> NDArray[np.floating]:
    """Probabilities (m,) without the highest k, where k of m surely are a smaller share than that.

    By the highest of all the threshold would depend on how many were looked at: among enough of
    them there is one that nobody could tell. Of too few to say so none is left out.
    """
    count = np.full(len(unanswerable), len(unanswerable))
    wrong = np.arange(len(unanswerable))
    upper = 1.0 - wilson_lower(count - wrong, count)
    left_out = max(int((upper < share).sum()) - 1, 0)
    return np.sort(unanswerable)[: len(unanswerable) - left_out]


def choose_threshold(
    probability: NDArray[np.floating],
    right: NDArray[np.bool_],
    unanswerable: NDArray[np.floating],
    target: float,
) -> float:
    """The least probability that is to be called sure; `NEVER` where none can be.

    The more are called sure the fewer of them are right. From a quarter of all on, thresholds are
    lowered for as long as the share that is right is surely over the target: a fixed sequence of
    tests, whose first failure ends it (Angelopoulos et al. 2021, arXiv:2110.01052).

    Args:
        probability: (n,) of being right.
        right: (n,) whether they were.
        unanswerable: (m,) probabilities of what must never be called sure.
        target: share of the sure ones that is to be right.
    """
    order = np.argsort(-probability, kind="stable")
    falling = probability[order]
    count = np.arange(1, len(order) + 1)
    allowed = wilson_lower(np.cumsum(right[order]), count) >= target
    allowed &= falling > unanswerable.max(initial=-np.inf)
    # Of equal probabilities either all are called sure or none.
    is_last = np.append(falling[1:] < falling[:-1], True)
    tested = np.flatnonzero(is_last & (count >= LEAST_COVERAGE * len(order)))
    passed = int(np.logical_and.accumulate(allowed[tested]).sum())
    return float(falling[tested[passed - 1]]) if passed else NEVER
