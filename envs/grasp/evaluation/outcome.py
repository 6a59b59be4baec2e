"""How a pick ends."""

from __future__ import annotations

from enum import StrEnum


class Outcome(StrEnum):
    """Outcome of a pick."""

    SUCCESS = "success"
    COLLISION = "collision"
    """On the way anything was touched, or while advancing anything but the target by the cup."""
    MISSED = "missed"
    """The cup came to no contact."""
    NO_SEAL = "no_seal"
    """In contact, some of the cup's rim was not on the target's face."""
    DROPPED = "dropped"
    """The block slipped off the cup, or did not come up."""
