"""How sure a policy is of an action: an estimate of its errors, learned after training.

It is stored beside the weights that it was fitted to, and is of no use with others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import safetensors
import safetensors.torch
import torch
from pydantic import BaseModel, Field, FiniteFloat, NonNegativeInt
from torch import Tensor, nn

from envs.evaluation import Figure
from trainers.common.errors import UserError, first_lines
from trainers.saving.checkpoint import WEIGHTS

FILE = "confidence.safetensors"
FORMAT = 1
CARD = "confidence"
"""Key of the card among the file's own metadata."""
NEVER = 2.0
"""A threshold that no probability reaches."""
HIDDEN_UNITS = 64
STEPS_OF_LIMIT = (0.125, 0.18, 0.25, 0.35, 0.5, 0.7, 0.85, 1.0, 1.2, 1.4, 2.0, 4.0)
"""An error's distribution is learned at these multiples of its limit."""
FARTHEST_DEVIATIONS = 10.0
"""Features that are farther from their mean count as if they were so far."""


class JudgedError(BaseModel, frozen=True, extra="forbid"):
    """A metric that must not be over its limit for an action to be right.

    Attributes:
        metric: a key of the environment's episode metrics.
        limit: in the metric's own unit.
        label: what people call it.
        unit: what people read it in.
        scale: from the metric's own unit to that one.
    """

    metric: str
    limit: float = Field(ge=0.0, allow_inf_nan=False)
    label: str
    unit: str = ""
    scale: FiniteFloat = 1.0

    @classmethod
    def of(cls, figure: Figure, limit: float) -> Self:
        """The error that an environment's figure is made of."""
        return cls(
            metric=figure.metric,
            limit=limit,
            label=figure.label,
            unit=figure.unit,
            scale=figure.scale,
        )

    def shown(self, value: float) -> str:
        """A value as people read it: `distance 2.41 cm`."""
        return (
            f"{self.label} {Figure(self.metric, '', unit=self.unit, scale=self.scale).shown(value)}"
        )


class Counts(BaseModel, frozen=True, extra="forbid"):
    """What came of some first actions.

    Attributes:
        actions: how many there were.
        right: how many of them were right.
        sure: how many were called sure.
        sure_right: how many of those were right.
    """

    actions: NonNegativeInt
    right: NonNegativeInt
    sure: NonNegativeInt
    sure_right: NonNegativeInt


class Measured(BaseModel, frozen=True, extra="forbid"):
    """What came of it in episodes that served nothing else.

    Attributes:
        ordinary: of the task that the promise is of.
        harder: of others, by what was harder in them.
        unanswerable: by kind, before what can't be answered; none of these actions is right.
    """

    ordinary: Counts
    harder: dict[str, Counts] = {}
    unanswerable: dict[str, Counts] = {}


class Card(BaseModel, frozen=True, extra="forbid"):
    """What `sure` means.

    Attributes:
        format: of the file.
        weights_sha256: of the file of weights that it belongs to.
        features: F, how many numbers it is told from.
        errors: that make an action wrong where one of them is over its limit.
        threshold: least probability of being right that is called sure; `NEVER`: none is.
        farthest: features at a greater distance from those of training are like none of them: the
            probability is 0, and errors are the largest that can be told. All but one in a
            thousand of the task that the promise is of are nearer.
        target: share of the sure actions that is to be right.
        episodes: of all that was drawn.
        seed: of them.
        overrides: `KEY=VALUE`s on top of the policy's own run file, of the task that the promise is
            of; of the sure actions in it, the share `target` is right.
        measured: in a part of them that served nothing else.
    """

    format: int = FORMAT
    weights_sha256: str
    features: int = Field(ge=1)
    errors: tuple[JudgedError, ...] = Field(min_length=1)
    threshold: float = NEVER
    farthest: float = 0.0
    target: float
    episodes: NonNegativeInt
    seed: NonNegativeInt
    overrides: tuple[str, ...] = ()
    measured: Measured | None = None

    @property
    def estimated(self) -> tuple[JudgedError, ...]:
        """The errors that have sizes; of those whose limit is 0 any is too much."""
        return tuple(error for error in self.errors if error.limit > 0.0)


class Judgement(NamedTuple):
    """What is expected of B actions.

    Attributes:
        errors: (B, E) expected, of those that are `estimated`, in their own units.
        probability: (B,) that all errors are within their limits.
        sure: (B,) bool.
    """

    errors: Tensor
    probability: Tensor
    sure: Tensor


class Confidence(nn.Module):
    """Judges actions by the features that they were chosen by.

    A small network says how likely an action is right, and for each error how likely it is over
    some multiples of its limit (Frank & Hall 2001, "A simple approach to ordinal classification"),
    of which the expected error follows. What it says of features that are unlike all it learned
    from means nothing, so their Mahalanobis distance from those counts, too (Lee et al. 2018,
    arXiv:1807.03888).

    Args:
        card: what `sure` means.
    """

    mean: Tensor
    std: Tensor
    whitening: Tensor
    _steps: Tensor
    _limits: Tensor

    def __init__(self, card: Card):
        super().__init__()
        self.card, count = card, card.features
        self.register_buffer("mean", torch.zeros(count))
        self.register_buffer("std", torch.ones(count))
        self.register_buffer("whitening", torch.eye(count))
        limits = [error.limit for error in card.estimated]
        self.register_buffer("_steps", torch.tensor((0.0, *STEPS_OF_LIMIT)), persistent=False)
        self.register_buffer("_limits", torch.tensor(limits), persistent=False)
        self.head = nn.Sequential(
            nn.Linear(count, HIDDEN_UNITS),
            nn.SiLU(),
            nn.Linear(HIDDEN_UNITS, HIDDEN_UNITS),
            nn.SiLU(),
            nn.Linear(HIDDEN_UNITS, 1 + len(limits) * len(STEPS_OF_LIMIT)),
        )

    def forward(self, features: Tensor) -> Judgement:
        """Features (B, F) -> what is expected."""
        right, over = self.logits(self.standardized(features))
        is_far = self.distance(features) > self.card.farthest
        probability = right.sigmoid().masked_fill(is_far, 0.0)
        errors = self._expected(over.sigmoid().masked_fill(is_far[:, None, None], 1.0))
        return Judgement(errors, probability, probability >= self.card.threshold)

    def standardized(self, features: Tensor) -> Tensor:
        """Features (B, F) as the head takes them."""
        deviations = (features - self.mean) / self.std
        return deviations.clamp(-FARTHEST_DEVIATIONS, FARTHEST_DEVIATIONS)

    def logits(self, standardized: Tensor) -> tuple[Tensor, Tensor]:
        """Of being right (B,), and of errors over multiples of their limits (B, E, K)."""
        outputs: Tensor = self.head(standardized)
        over = outputs[:, 1:].reshape(-1, len(self._limits), len(STEPS_OF_LIMIT))
        return outputs[:, 0], over

    def distance(self, features: Tensor) -> Tensor:
        """Mahalanobis distances (B,), over sqrt(F): about 1 where features are as in training."""
        white = ((features - self.mean) / self.std) @ self.whitening
        return white.square().mean(dim=1).sqrt()

    def _expected(self, over: Tensor) -> Tensor:
        """Expected errors (B, E) from probabilities (B, E, K) of more than multiples of limits.

        E[x] is the integral of P(x > t) over t, here up to the last of the multiples.
        """
        survival = torch.cat([torch.ones_like(over[..., :1]), over], dim=-1)
        mean = (survival[..., 1:] + survival[..., :-1]) / 2.0
        return (mean * (self._steps[1:] - self._steps[:-1])).sum(dim=-1) * self._limits


def weights_digest(folder: Path) -> str:
    """SHA-256 of the weights in a folder."""
    return hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()


def to_bytes(confidence: Confidence) -> bytes:
    """The content of the file."""
    card = {CARD: confidence.card.model_dump_json()}
    return safetensors.torch.save(confidence.state_dict(), metadata=card)


def read_confidence(folder: Path) -> Confidence | None:
    """What is stored beside the weights in a folder; None where nothing is.

    Raises:
        UserError: it is damaged, or of other weights.
    """
    path = folder / FILE
    if not path.exists():
        return None
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            card = Card.model_validate_json((file.metadata() or {})[CARD])
            if card.format != FORMAT:
                raise ValueError(f"format {card.format}, where this version reads {FORMAT}")
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        for name, values in arrays.items():
            if not values.isfinite().all():
                raise ValueError(f"{name} has values that are not finite")
        if arrays["mean"].shape != (card.features,):  # before anything of that size is made
            raise ValueError(f"{card.features} features, where mean is of {arrays['mean'].shape}")
        confidence = Confidence(card)
        confidence.load_state_dict(arrays)
    except Exception as error:  # forged, it can be wrong in any way
        raise UserError(
            f"{path}: can't be used: {first_lines(error, 2)}; {_again(folder)}"
        ) from error
    if card.weights_sha256 != weights_digest(folder):
        raise UserError(
            f"{path}: belongs to other weights than the {WEIGHTS} beside it; {_again(folder)}"
        )
    return confidence.eval()


def _again(folder: Path) -> str:
    return f"delete it, and run `python -m trainers.calibrate {folder}`"


def judged_errors(
    figures: Sequence[Figure], limits: Mapping[str, float]
) -> tuple[JudgedError, ...]:
    """The errors that an environment declares, as its figures show them."""
    known = {figure.metric: figure for figure in figures}
    return tuple(
        JudgedError.of(known.get(metric, Figure(metric, metric.replace("_", " "))), limit)
        for metric, limit in limits.items()
    )
