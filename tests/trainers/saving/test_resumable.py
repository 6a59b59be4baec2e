"""What a run can be taken up from."""

from __future__ import annotations

import numpy as np
import torch

from trainers.saving.resumable import LEAST_BYTES, MOST_WEIGHTS, Resumable


def resumable(weights: int, experience: int) -> Resumable:
    """One of so many bytes."""
    state = {
        "algorithm": {"optimizer": torch.zeros(0), "buffer": np.zeros(experience, np.uint8)},
        "interaction": {"observations": np.zeros(3)},
    }
    return Resumable(7, {"layer": torch.zeros(weights, dtype=torch.uint8)}, state)


def test_an_update_does_not_reach_a_copy() -> None:
    one = resumable(weights=4, experience=4)
    copy = one.copied()
    assert copy is not None
    one.weights["layer"].fill_(1)
    one.state["algorithm"]["buffer"][:] = 1
    assert copy.step == 7
    assert copy.weights["layer"].tolist() == [0] * 4
    assert copy.state["algorithm"]["buffer"].tolist() == [0] * 4
    # What an update leaves alone is not copied.
    assert copy.state["interaction"] is one.state["interaction"]


def test_experience_is_not_copied() -> None:
    assert resumable(weights=4, experience=LEAST_BYTES - 4).copied() is not None
    assert resumable(weights=4, experience=LEAST_BYTES - 3).copied() is None
    large = LEAST_BYTES
    assert resumable(weights=large, experience=(MOST_WEIGHTS - 1) * large).copied() is not None
    assert resumable(weights=large, experience=(MOST_WEIGHTS - 1) * large + 1).copied() is None
