"""A process's share of environments: what it draws, and which transitions are its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from trainers.common.share import Share


def test_what_is_drawn_is_the_same_whoever_has_the_others() -> None:
    def draw(share: Share) -> torch.Tensor:
        generator = torch.Generator().manual_seed(0)
        first = share.drawn(torch.randn, (share.count, 3), generator=generator)
        return torch.stack([first, share.drawn(torch.rand, (share.count, 3), generator=generator)])

    whole = draw(Share.whole(8))
    assert torch.equal(draw(Share(0, 3, 8)), whole[:, :3])
    assert torch.equal(draw(Share(3, 5, 8)), whole[:, 3:])


def test_ones_own_transitions_keep_their_order() -> None:
    # Steps 0, 1, 2 of environments 0 to 3; 2 and 3 are one's own.
    rows = np.array([11, 0, 2, 6, 5, 3])
    own, weight = Share(2, 2, 4).own(rows)
    assert own.tolist() == [2 * 2 + 1, 0, 1 * 2, 1]
    assert weight == pytest.approx(4 / 6)
    theirs, rest = Share(0, 2, 4).own(torch.from_numpy(rows))
    assert theirs.tolist() == [0, 1 * 2 + 1]
    assert weight + rest == 1.0


def test_one_that_has_none_takes_one_along_that_weighs_nothing() -> None:
    own, weight = Share(2, 2, 4).own(torch.tensor([8, 9, 4]))
    assert (own.tolist(), weight) == ([4], 0.0)  # step 2 of its first environment


def test_alone_all_are_ones_own() -> None:
    rows = torch.tensor([5, 1])
    own, weight = Share.whole(3).own(rows)
    assert own is rows
    assert weight == 1.0


def test_parts_of_a_minibatch_end_where_a_group_does_that_is_nearest() -> None:
    rows = torch.tensor([70, 71, 72, 30, 10, 11, 50, 51])
    groups = torch.tensor([7, 7, 7, 3, 1, 1, 5, 5])
    parts = [Share(first, 2, 4).part(rows, groups).tolist() for first in (0, 2)]
    assert parts == [[70, 71, 72, 30], [10, 11, 50, 51]]
    # Of three the first ends at 3 of 8 / 3, the second at 6 of 16 / 3.
    parts = [Share(first, 1, 3).part(rows, groups).tolist() for first in range(3)]
    assert parts == [[70, 71, 72], [30, 10, 11], [50, 51]]


@given(st.lists(st.integers(1, 6), min_size=1, max_size=20), st.integers(1, 5))
def test_parts_are_a_partition_into_whole_groups(lengths: list[int], size: int) -> None:
    groups = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    rows = torch.arange(len(groups)) + 100
    parts = [Share(2 * rank, 2, 2 * size).part(rows, groups) for rank in range(size)]
    assert torch.equal(torch.cat(parts), rows)
    found = [set(groups[part - 100].tolist()) for part in parts]
    assert sum(map(len, found)) == len(lengths)
    # Each end is off by half a group at most.
    assert all(abs(len(part) - len(rows) / size) <= max(lengths) for part in parts)
