"""Experience in which each frame is kept once."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given
from hypothesis import strategies as st

from encoders.spaces import DepthImage, RgbImage
from trainers.common.errors import UserError
from trainers.common.share import Share
from trainers.distributed.world import World
from trainers.experience.frames import FrameStore
from trainers.experience.rollout import Rollout

SIDE_PX = 2
CPU = torch.device("cpu")


def rollout_of(
    frame_index: torch.Tensor,
    frames: torch.Tensor | None = None,
    shuffle_groups: torch.Tensor | None = None,
) -> Rollout:
    """A rollout whose only content is its frames; all else of a transition is its number."""
    numbers = torch.arange(len(frame_index), dtype=torch.float32)
    groups = frame_index if shuffle_groups is None else shuffle_groups
    return Rollout(
        share=Share.whole(1),
        frames={} if frames is None else {"depth": frames},
        frame_index=frame_index,
        vectors={"number": numbers[:, None]},
        shuffle_groups=groups,
        all_groups=groups,
        hidden_states=numbers[:, None],
        actions=numbers,
        log_probs=numbers,
        values=numbers,
        advantages=numbers,
        returns=numbers,
    )


def uint16_frames(*values: int) -> torch.Tensor:
    raw = np.array(values, np.uint16)[:, None, None, None].repeat(SIDE_PX, 1).repeat(SIDE_PX, 2)
    return torch.from_numpy(raw)


def test_the_store_keeps_rows_in_the_order_they_came_and_says_where() -> None:
    spaces = {"depth": DepthImage(SIDE_PX, SIDE_PX), "color": RgbImage(SIDE_PX, SIDE_PX)}
    store = FrameStore(spaces, capacity=5, device=CPU)
    depth = uint16_frames(10, 40_000, 65_535).numpy()
    color = np.arange(3, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 2, 3), np.uint8)
    first = store.add({"depth": depth, "color": color, "joints": np.zeros(3)}, np.arange(3))
    second = store.add({"depth": depth[::-1], "color": color[::-1]}, np.array([0, 2]))
    assert first.tolist() == [0, 1, 2]
    assert second.tolist() == [3, 4]
    assert store.count == 5
    kept = store.tensors()
    assert kept["depth"].dtype == torch.uint16
    assert kept["depth"].numpy()[:, 0, 0, 0].tolist() == [10, 40_000, 65_535, 65_535, 10]
    assert kept["color"].numpy()[:, 1, 1, 2].tolist() == [0, 1, 2, 2, 0]


def test_the_store_is_not_changed_when_the_environment_writes_over_its_images() -> None:
    store = FrameStore({"depth": DepthImage(SIDE_PX, SIDE_PX)}, capacity=1, device=CPU)
    buffer = uint16_frames(7).numpy()
    store.add({"depth": buffer}, np.array([0]))
    buffer[:] = 9
    assert store.tensors()["depth"].numpy().max() == 7


def test_unused_capacity_is_not_handed_out() -> None:
    store = FrameStore({"depth": DepthImage(SIDE_PX, SIDE_PX)}, capacity=100, device=CPU)
    store.add({"depth": uint16_frames(1, 2).numpy()}, np.array([1]))
    assert store.tensors()["depth"].shape == (1, SIDE_PX, SIDE_PX, 1)


def test_each_transition_gets_its_own_frame_and_each_frame_comes_once() -> None:
    frames = uint16_frames(100, 32_768, 65_535, 32_767)
    rollout = rollout_of(torch.tensor([0, 0, 2, 1, 2, 3]), frames)
    rows = torch.tensor([4, 1, 2, 0])
    observations = rollout.observations(rows)
    assert observations.frames["depth"].dtype == torch.uint16
    assert len(observations.frames["depth"]) == 2  # of four transitions
    assert observations.frame_index is not None
    seen = observations.frames["depth"].numpy()[observations.frame_index.numpy()]
    assert seen[:, 1, 1, 0].tolist() == [65_535, 100, 65_535, 100]
    assert observations.vectors["number"].squeeze(1).tolist() == [4.0, 1.0, 2.0, 0.0]


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_frames_of_other_types_are_taken_as_well(dtype: type) -> None:
    frames = torch.from_numpy(np.arange(3, dtype=dtype).reshape(3, 1, 1, 1))
    observations = rollout_of(torch.tensor([2, 0, 1]), frames).observations(torch.tensor([0, 2]))
    assert observations.frame_index is None  # a frame for each, in their order
    taken = observations.frames["depth"]
    assert taken.flatten().tolist() == [2, 1]
    assert taken.dtype == frames.dtype


shares = st.lists(st.integers(1, 6), min_size=1, max_size=20)


@given(shares, st.integers(1, 30), st.integers(0, 2**31))
def test_minibatches_are_a_partition_in_which_frames_stay_together(
    shares: list[int], size: int, seed: int
) -> None:
    owners = np.repeat(np.arange(len(shares)), shares)
    frame_index = torch.from_numpy(np.random.default_rng(seed).permutation(owners))
    generator = torch.Generator().manual_seed(seed)
    batches = [rows for rows, _ in rollout_of(frame_index).minibatches(size, generator)]
    assert all(len(batch) == size for batch in batches[:-1])
    assert 1 <= len(batches[-1]) <= size
    order = torch.cat(batches)
    assert sorted(order.tolist()) == list(range(len(owners)))
    visited = frame_index[order].tolist()
    runs = 1 + sum(a != b for a, b in pairwise(visited))
    assert runs == len(shares)


# Three environments in five steps: episodes end after the second and after the third step.
SEQUENCES = torch.tensor([0, 1, 2, 0, 1, 2, 3, 1, 2, 3, 4, 2, 3, 4, 2])


def test_sequences_come_in_the_order_of_time_with_what_was_remembered_before_them() -> None:
    rollout = rollout_of(torch.arange(15), shuffle_groups=SEQUENCES)
    rows = rollout.in_shuffle_groups().rows
    assert rows.tolist() == [0, 3, 1, 4, 7, 2, 5, 8, 11, 14, 6, 9, 12, 10, 13]
    sequences = rollout.observations(rows).sequences
    assert sequences is not None
    assert sequences.lengths.tolist() == [2, 3, 5, 3, 2]
    assert sequences.hidden_state.flatten().tolist() == [0, 1, 2, 6, 10]


@given(st.integers(1, 20), st.integers(0, 2**31))
def test_a_sequence_is_cut_at_most_where_a_minibatch_ends(size: int, seed: int) -> None:
    rollout = rollout_of(torch.arange(15), shuffle_groups=SEQUENCES)
    minibatches = rollout.minibatches(size, torch.Generator().manual_seed(seed))
    batches = [rows for rows, _ in minibatches]
    pieces = []
    for rows in batches:
        sequences = rollout.observations(rows).sequences
        assert sequences is not None
        parts = rows.split(sequences.lengths.tolist())
        assert [part[0] for part in parts] == sequences.hidden_state.flatten().tolist()
        assert len({int(SEQUENCES[part[0]]) for part in parts}) == len(parts)
        pieces += parts
    assert len(pieces) <= 5 + len(batches) - 1
    for number in range(5):
        whole = torch.cat([piece for piece in pieces if SEQUENCES[piece[0]] == number])
        assert whole.tolist() == SEQUENCES.eq(number).nonzero().flatten().tolist()


def test_a_frame_is_taken_once_wherever_its_sequences_are() -> None:
    frame_index = torch.tensor([0, 1, 0, 1, 0, 2])
    shuffle_groups = torch.tensor(
        [0, 1, 0, 1, 2, 3]
    )  # the first environment's episode is cut in two
    rollout = rollout_of(frame_index, uint16_frames(1, 2, 3), shuffle_groups)
    observations = rollout.observations(torch.tensor([4, 1, 3, 0, 2]))
    assert observations.frame_index is not None
    assert len(observations.frames["depth"]) == 2
    seen = observations.frames["depth"].numpy()[observations.frame_index.numpy()]
    assert seen[:, 0, 0, 0].tolist() == [1, 2, 2, 1, 1]


def test_frames_are_shuffled_anew_in_every_pass() -> None:
    frame_index = torch.arange(8).repeat_interleave(3)
    rollout, generator = rollout_of(frame_index), torch.Generator().manual_seed(0)

    def order(generator: torch.Generator) -> torch.Tensor:
        return torch.cat([rows for rows, _ in rollout.minibatches(6, generator)])

    first, second = order(generator), order(generator)
    assert first.tolist() != second.tolist()
    again = order(torch.Generator().manual_seed(0))
    assert again.tolist() == first.tolist()


def test_with_a_frame_each_all_splits_are_equally_likely() -> None:
    rollout, generator = rollout_of(torch.arange(4)), torch.Generator().manual_seed(0)
    draws = 2400
    pairs = Counter(
        tuple(sorted(next(rollout.minibatches(2, generator)).rows.tolist())) for _ in range(draws)
    )
    assert len(pairs) == 6
    expected = draws / 6
    # Chi squared with 5 degrees of freedom: over 20.5 once in a thousand seeds.
    assert sum((count - expected) ** 2 / expected for count in pairs.values()) < 20.5


def test_vectors_alone_need_no_frames() -> None:
    store = FrameStore({}, capacity=0, device=CPU)
    assert store.tensors() == {}
    observations = rollout_of(torch.arange(3)).observations(torch.tensor([2, 1]))
    assert observations.frames == {}
    assert observations.vectors["number"].flatten().tolist() == [2.0, 1.0]


def test_memory_of_shared_frames_is_not_touched() -> None:
    space = Box(0, 255, (64, 64, 3), np.uint8)
    store = FrameStore(
        {"color": space}, capacity=10**5, device=CPU
    )  # 1.2 GB if it were all written to
    store.add({"color": np.ones((2, 64, 64, 3), np.uint8)}, np.arange(2))
    assert len(store.tensors()["color"]) == 2


def test_tries_are_compared_at_their_frame() -> None:
    rollout = rollout_of(torch.tensor([0, 1, 0, 1])).against_other_tries()
    assert rollout.advantages.tolist() == [-2.0, -2.0, 2.0, 2.0]  # of the returns 0, 1, 2, 3
    assert rollout.returns.tolist() == [0.0, 1.0, 2.0, 3.0]


@pytest.mark.parametrize(("second", "refused"), [([0, 0], []), ([0, 1], [0, 1])])
def test_tries_of_all_processes_decide_whether_they_can_be_compared(
    second: list[int], refused: list[int]
) -> None:
    class Pair(World):
        def any(self, condition: bool) -> bool:
            return condition or len(set(second)) < len(second)

    failed = []
    for rank, frames in enumerate(([0, 1], second)):
        try:
            rollout_of(torch.tensor(frames)).against_other_tries(Pair())
        except UserError:
            failed.append(rank)
    assert failed == refused


def test_single_tries_can_not_be_compared() -> None:
    with pytest.raises(UserError, match=r"every frame was acted on once: .* or baseline: critic"):
        rollout_of(torch.tensor([0, 1, 2])).against_other_tries()
