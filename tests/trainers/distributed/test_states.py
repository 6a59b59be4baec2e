"""States of processes, put together and divided anew."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from trainers.common.share import Share
from trainers.distributed.states import EACH, differing, divided, joined, on_cpu

AXES = {"reward": 0, "env": {"actions": 1, "views": 0}, "hidden": 0, "buffer": EACH}


def state(first: int, count: int, time: int) -> dict:
    own = np.arange(first, first + count)
    return {
        "reward": own + 0.5,
        "env": {
            "actions": np.stack([own + 10 * t for t in range(3 - time, 3)]),
            "views": {"camera": {"position": own[:, None]}},
            "seed": 7,
        },
        "hidden": torch.from_numpy(own),
        "optimizer": {"lr": 0.1},
        "buffer": f"of {first}",
    }


def test_states_are_put_together_by_environment_and_the_latest_steps_are_kept_last() -> None:
    second = differing(state(2, 1, 1), AXES)
    assert second["optimizer"] is second["env"]["seed"] is None
    whole = joined([state(0, 2, 3), second], AXES)
    assert whole["reward"].tolist() == [0.5, 1.5, 2.5]
    assert whole["env"]["actions"].tolist() == [[0, 1, 0], [10, 11, 0], [20, 21, 22]]
    assert whole["env"]["views"]["camera"]["position"].tolist() == [[0], [1], [2]]
    assert whole["env"]["seed"] == 7
    assert torch.equal(whole["hidden"], torch.arange(3))
    assert whole["optimizer"] == {"lr": 0.1}
    assert whole["buffer"] == ["of 0", "of 2"]


def test_tensors_of_a_state_are_told_from_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.Tensor, "cpu", lambda own: own + 1)
    moved = on_cpu({"noise": torch.zeros(2), "lists": [torch.zeros(1), "name"], "steps": 3})
    assert moved["noise"].tolist() == [1, 1]
    assert (moved["lists"][0].item(), moved["lists"][1], moved["steps"]) == (1, "name", 3)


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_a_state_is_taken_up_by_any_number_of_processes(ranks: int) -> None:
    whole = joined([state(0, 3, 3), state(3, 3, 3)], AXES) | {"buffer": ["?"] * ranks}
    count = 6 // ranks
    parts = [divided(whole, AXES, Share(count * r, count, 6)) for r in range(ranks)]
    for rank, part in enumerate(parts):
        expected = state(count * rank, count, 3) | {"buffer": "?"}
        assert torch.equal(part.pop("hidden"), expected.pop("hidden"))
        np.testing.assert_equal(part, expected)


def test_a_state_of_other_environments_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^it was saved with 3 environments, not 4$"):
        divided({"reward": np.zeros(3)}, AXES, Share(0, 2, 4))
    with pytest.raises(ValueError, match=r"^its replay buffers are those of 3 ranks, and there ar"):
        divided({"buffer": ["?"] * 3}, AXES, Share(0, 2, 4))
