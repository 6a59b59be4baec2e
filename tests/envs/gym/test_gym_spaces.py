"""Gymnasium's spaces, as encoders and policies take them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text, Tuple
from gymnasium.vector.utils import batch_space
from hypothesis import given
from hypothesis import strategies as st

from envs.gym.spaces import ActionAdapter, ObservationAdapter

LARGEST = np.finfo(np.float64).max
ENTRIES = {
    "vector": Box(-2.0, 3.0, (4,), np.float64),
    "number": Box(0.0, 1.0, (), np.float32),
    "bytes": Box(0, 255, (3,), np.uint8),
    "choice": Discrete(3, start=5),
    "colors": Box(0, 255, (6, 5, 3), np.uint8),
    "depth": Box(0.0, 1.0, (6, 5, 1), np.float64),
}


def test_a_box_becomes_the_only_entry() -> None:
    adapter = ObservationAdapter(Box(-1.0, 1.0, (2,), np.float64))
    assert adapter.space == Dict({"observation": Box(-1.0, 1.0, (2,), np.float32)})
    seen = adapter(np.array([[0.1, 0.2], [0.3, 0.4]]))["observation"]
    assert seen.dtype == np.float32
    np.testing.assert_array_equal(seen, np.float32([[0.1, 0.2], [0.3, 0.4]]))


@given(seed=st.integers(0, 2**16), count=st.integers(1, 4))
def test_what_comes_out_is_in_the_space_that_was_announced(seed: int, count: int) -> None:
    space = Dict(ENTRIES)
    adapter = ObservationAdapter(space)
    batched = batch_space(space, count)
    batched.seed(seed)
    assert batch_space(adapter.space, count).contains(adapter(batched.sample()))


def test_entries_keep_their_meaning() -> None:
    adapter = ObservationAdapter(Dict(ENTRIES))
    assert {name: (s.shape, s.dtype) for name, s in adapter.space.spaces.items()} == {
        "vector": ((4,), np.float32),
        "number": ((1,), np.float32),
        "bytes": ((3,), np.float32),
        "choice": ((3,), np.float32),
        "colors": ((6, 5, 3), np.uint8),
        "depth": ((6, 5, 1), np.float32),
    }


def test_bounds_beyond_float32_are_none() -> None:
    adapter = ObservationAdapter(Box(-LARGEST, np.inf, (2,), np.float64))
    assert adapter.space["observation"] == Box(-np.inf, np.inf, (2,), np.float32)


def test_a_choice_is_seen_as_one_of_many() -> None:
    adapter = ObservationAdapter(Discrete(3, start=5))
    seen = adapter(np.array([6, 5, 7, 7]))["observation"]
    assert seen.tolist() == [[0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1]]


def test_arrays_are_new_even_where_nothing_changes() -> None:
    pixels = np.zeros((2, 6, 5, 3), np.uint8)
    numbers = np.zeros((2, 4), np.float32)
    for values in (pixels, numbers):
        dtype: Any = values.dtype.type
        seen = ObservationAdapter(Box(0, 1, values.shape[1:], dtype))(values)["observation"]
        values[:] = 1
        assert not seen.any()


@pytest.mark.parametrize(
    ("space", "what"),
    [
        (Tuple([Discrete(2), Discrete(3)]), "Tuple"),
        (Text(5), "Text"),
        (MultiDiscrete([2, 3]), "MultiDiscrete"),
        (MultiBinary(4), "MultiBinary"),
        (Box(0.0, 1.0, (4, 5)), r"Box\(0.0, 1.0, \(4, 5\)"),
        (Dict({"inner": Box(0.0, 1.0, (2,))}), "Dict"),
    ],
)
def test_what_no_encoder_takes_is_named_with_a_way_out(
    space: gymnasium.Space[Any], what: str
) -> None:
    with pytest.raises(ValueError, match=f"'odd'.*{what}.*supported.*flatten_observations: true"):
        ObservationAdapter(Dict({"fine": Box(0.0, 1.0, (2,)), "odd": space}))


def test_images_with_their_channels_first_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(3, 84, 84\) have their channels first"):
        ObservationAdapter(Box(0, 255, (3, 84, 84), np.uint8))
    ObservationAdapter(Box(0, 255, (4, 84, 3), np.uint8))  # four rows


def test_a_choice_of_action_is_counted_from_zero() -> None:
    adapter = ActionAdapter(Discrete(3, start=-1))
    assert adapter.space == Discrete(3)
    assert adapter(np.array([0, 2, 1])).tolist() == [-1, 1, 0]


@pytest.mark.parametrize("bounds", [(-2.0, 2.0), (0.0, 3.5), (-np.inf, np.inf)])
def test_continuous_actions_stay_as_they_are(bounds: tuple[float, float]) -> None:
    space = Box(*bounds, (2,), np.float64)
    adapter = ActionAdapter(space)
    assert adapter.space is space
    actions = np.array([[0.5, 1.5]], np.float32)
    taken = adapter(actions)
    assert taken.dtype == np.float64
    actions[:] = 0.0
    assert taken.tolist() == [[0.5, 1.5]]


@pytest.mark.parametrize(
    "space", [MultiDiscrete([2, 3]), Box(0.0, 1.0, (2, 2)), Box(0, 5, (2,), np.int64), Text(3)]
)
def test_what_no_policy_acts_in_is_named(space: gymnasium.Space[Any]) -> None:
    with pytest.raises(ValueError, match=f"{type(space).__name__}.*a Box of one dimension.*Discre"):
        ActionAdapter(space)
