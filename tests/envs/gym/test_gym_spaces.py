"""Gymnasium's spaces, as encoders and policies take them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    Graph,
    MultiBinary,
    MultiDiscrete,
    OneOf,
    Sequence,
    Text,
    Tuple,
)
from gymnasium.vector.utils import batch_space
from hypothesis import given
from hypothesis import strategies as st

from encoders.cameras import Pinhole
from encoders.spaces import DepthImage, PointCloud, RgbImage
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


def test_clouds_stay_what_they_are() -> None:
    space = PointCloud(2, "base", (1.0, 2.0, 3.0))
    adapter = ObservationAdapter(Dict({"cloud": space}))
    assert adapter.space["cloud"] == space
    clouds = np.float32([[[1, 2, 3, 1], [0, 0, 0, 0]]])
    np.testing.assert_array_equal(adapter({"cloud": clouds})["cloud"], clouds)


def test_bounds_beyond_float32_are_none() -> None:
    adapter = ObservationAdapter(Box(-LARGEST, np.inf, (2,), np.float64))
    assert adapter.space["observation"] == Box(-np.inf, np.inf, (2,), np.float32)


def test_a_choice_is_seen_as_one_of_many() -> None:
    adapter = ObservationAdapter(Discrete(3, start=5))
    seen = adapter(np.array([6, 5, 7, 7]))["observation"]
    assert seen.tolist() == [[0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1]]


def test_several_choices_are_seen_end_to_end() -> None:
    adapter = ObservationAdapter(MultiDiscrete([[3, 2]], start=[[5, 0]]))
    seen = adapter(np.array([[[5, 1]], [[7, 0]]]))["observation"]
    assert seen.tolist() == [[1, 0, 0, 0, 1], [0, 0, 1, 1, 0]]
    seen = ObservationAdapter(MultiBinary((2, 2)))(np.array([[[1, 0], [0, 1]]], np.int8))
    assert seen["observation"].tolist() == [[1, 0, 0, 1]]
    assert seen["observation"].dtype == np.float32


NESTED = Dict(
    {
        "arm": Tuple([Box(-1.0, 1.0, (2,), np.float32), Dict({"grip": Discrete(2)})]),
        "a.b": MultiBinary(3),
    }
)


def test_what_is_nested_is_called_by_the_way_there() -> None:
    adapter = ObservationAdapter(NESTED)
    assert set(adapter.space.spaces) == {"arm.0", "arm.1.grip", "a.b"}
    batched = batch_space(NESTED, 2)
    batched.seed(0)
    batch: Any = batched.sample()
    seen = adapter(batch)
    assert batch_space(adapter.space, 2).contains(seen)
    np.testing.assert_array_equal(seen["arm.0"], batch["arm"][0])
    np.testing.assert_array_equal(seen["arm.1.grip"].argmax(1), batch["arm"][1]["grip"])
    assert set(ObservationAdapter(Tuple([Discrete(2), Discrete(3)])).space.spaces) == {"0", "1"}


@pytest.mark.parametrize(
    ("space", "names"),
    [
        (Dict({"a": Dict({"b": Discrete(2)}), "a.b": Discrete(2)}), r"\['a', 'b'\] and \['a.b'\]"),
        (Dict({"0": Tuple([Discrete(2)]), "0.0": Discrete(2)}), r"\['0', 0\] and \['0.0'\]"),
    ],
)
def test_two_observations_of_one_name_are_refused(space: gymnasium.Space[Any], names: str) -> None:
    with pytest.raises(ValueError, match=f"{names} have the same name, '.*': to call one another"):
        ObservationAdapter(space)


def test_stacked_observations_are_joined_the_oldest_first() -> None:
    parts = {
        "vector": Box(np.float32([-1, -2]), np.float32([1, 2])),
        "view": Box(0, 255, (3, 4, 5), np.uint8),
        "choice": Discrete(2),
    }
    space = Dict(parts)
    adapter = ObservationAdapter(Tuple([space] * 3), "first", frame_stack=3)
    assert adapter.space["vector"].high.tolist() == [1, 2, 1, 2, 1, 2]  # type: ignore[attr-defined]
    assert adapter.space["view"] == Box(0, 255, (4, 5, 9), np.uint8)
    batched = batch_space(Tuple([space] * 3), 2)
    batched.seed(0)
    frames: Any = batched.sample()
    seen = adapter(frames)
    assert batch_space(adapter.space, 2).contains(seen)
    for place, frame in enumerate(frames):
        view = seen["view"][..., 3 * place : 3 * place + 3]
        np.testing.assert_array_equal(view, np.moveaxis(frame["view"], 1, -1))
        vector = seen["vector"][:, 2 * place : 2 * place + 2]
        np.testing.assert_array_equal(vector, frame["vector"])


@pytest.mark.parametrize("space", [DepthImage(8, 9), RgbImage(2, 3), PointCloud(4)])
def test_images_of_cameras_are_not_stacked(space: gymnasium.Space[Any]) -> None:
    with pytest.raises(ValueError, match=r"frame_stack: observation 'observation'.*memory"):
        ObservationAdapter(Tuple([space] * 2), frame_stack=2)


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
        (Text(5), "Text"),
        (OneOf([Discrete(2), Discrete(3)]), "OneOf"),
        (Box(0.0, 1.0, (4, 5)), r"Box\(0.0, 1.0, \(4, 5\)"),
        (Box(0.0, 1.0, (4, 5, 6, 7)), r"Box\(0.0, 1.0, \(4, 5, 6, 7\)"),
    ],
)
def test_what_no_encoder_takes_is_named_with_a_way_out(
    space: gymnasium.Space[Any], what: str
) -> None:
    with pytest.raises(ValueError, match=f"'odd'.*{what}.*supported.*flatten_observations: true"):
        ObservationAdapter(Dict({"fine": Box(0.0, 1.0, (2,)), "odd": space}))


@pytest.mark.parametrize("space", [Sequence(Discrete(2)), Graph(Discrete(2), None)])
def test_what_gymnasium_can_not_flatten_is_not_told_to_be_flattened(
    space: gymnasium.Space[Any],
) -> None:
    with pytest.raises(ValueError, match=r"'odd'.*are supported: register an id that wraps"):
        ObservationAdapter(Dict({"odd": space}))


@pytest.mark.parametrize("channels", [None, "first", "last"])
def test_images_of_cameras_stay_what_they_are(channels: Any) -> None:
    camera = Pinhole(10.0, 11.0, 4.0, 4.5)
    spaces = {"depth": DepthImage(8, 9, (0.3, 4.0), pinhole=camera), "color": RgbImage(2, 3)}
    adapter = ObservationAdapter(Dict(spaces), channels)
    for name, space in spaces.items():
        assert adapter.space[name] is space
        batch = np.array([space.sample(), space.sample()])
        seen = adapter({"depth": batch, "color": batch})[name]
        np.testing.assert_array_equal(seen, batch)
        assert not np.shares_memory(seen, batch)


@pytest.mark.parametrize(
    "shape", [(5, 5, 17), (84, 84, 84), (4, 3, 3), (84, 3, 84), (3, 3, 84), (84, 3, 3)]
)
def test_a_shape_that_does_not_tell_the_channels_asks_for_them(shape: Any) -> None:
    space = Box(0, 255, shape, np.uint8)
    with pytest.raises(ValueError, match=r"'observation'.*do not say.*set channels: first .*last"):
        ObservationAdapter(space)
    assert ObservationAdapter(space, "last").space["observation"] == space
    first = ObservationAdapter(space, "first").space["observation"]
    assert first.shape == (*shape[1:], shape[0])


@pytest.mark.parametrize(
    ("shape", "seen"),
    [
        ((3, 84, 84), (84, 84, 3)),
        ((24, 84, 80), (84, 80, 24)),
        ((1, 5, 17), (5, 17, 1)),
        ((84, 80, 3), (84, 80, 3)),
        ((4, 84, 3), (4, 84, 3)),  # four rows
    ],
)
def test_the_shortest_axis_has_the_channels(shape: Any, seen: Any) -> None:
    space = Box(0, 255, shape, np.uint8)
    assert ObservationAdapter(space).space["observation"].shape == seen


@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
def test_channels_that_come_first_are_put_last_with_their_bounds(dtype: Any) -> None:
    high = np.broadcast_to(np.array([10, 200], dtype)[:, None, None], (2, 3, 4))
    adapter = ObservationAdapter(Box(np.zeros((2, 3, 4), dtype), high, dtype=dtype), "first")
    batch = np.arange(24, dtype=dtype).reshape(1, 2, 3, 4)
    seen = adapter(batch)["observation"]
    assert seen.flags.c_contiguous
    assert seen[0, 1, 2].tolist() == [batch[0, 0, 1, 2], batch[0, 1, 1, 2]] == [6, 18]
    assert (adapter.space["observation"].high[2, 3] == [10, 200]).all()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("space", "actions"),
    [
        (Discrete(3, start=-1), [-1, 1, 0]),
        (MultiDiscrete([3, 2], start=[1, 0]), [[1, 0], [3, 1]]),
        (MultiBinary(2), [[1, 0], [0, 1]]),
    ],
)
def test_discrete_actions_have_the_type_of_their_space(
    space: gymnasium.Space[Any], actions: Any
) -> None:
    adapter = ActionAdapter(space)
    assert adapter.space is space
    given = np.array(actions, np.int64)
    taken = adapter(given)
    assert taken.dtype == space.dtype
    assert not np.shares_memory(taken, given)
    assert taken.tolist() == actions


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
    "space",
    [
        MultiDiscrete([[2, 3]]),
        MultiBinary((2, 2)),
        Box(0.0, 1.0, (2, 2)),
        Box(0, 5, (2,), np.int64),
        Text(3),
        Tuple([Discrete(2), Discrete(3)]),
        Dict({"move": Discrete(2)}),
    ],
)
def test_what_no_policy_acts_in_is_named(space: gymnasium.Space[Any]) -> None:
    with pytest.raises(ValueError, match=f"{type(space).__name__}.*a Box with floats"):
        ActionAdapter(space)
