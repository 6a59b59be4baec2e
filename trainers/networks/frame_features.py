"""Features of frames, to be reused as long as neither the frames nor the encoders change."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class FrameFeatures:
    """Features (B, f) of B frames, as the actor's and the critic's encoders gave them.

    None for a network that sees no frames, or is not asked.
    """

    actor: Tensor | None = None
    critic: Tensor | None = None

    def rows(self, rows: Tensor) -> FrameFeatures:
        """Those of some rows."""
        actor, critic = (None if f is None else f[rows] for f in (self.actor, self.critic))
        return FrameFeatures(actor, critic)

    def with_rows(self, rows: Tensor, other: FrameFeatures) -> FrameFeatures:
        """These, with other features at some rows."""
        return FrameFeatures(
            _with_rows(self.actor, rows, other.actor), _with_rows(self.critic, rows, other.critic)
        )


def _with_rows(features: Tensor | None, rows: Tensor, other: Tensor | None) -> Tensor | None:
    if features is None or other is None:
        return None
    return features.index_copy(0, rows, other)
