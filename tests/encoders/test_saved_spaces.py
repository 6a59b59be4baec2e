from __future__ import annotations

import json
from collections import OrderedDict
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text

from encoders.cameras import Pinhole, Sampling
from encoders.saved_spaces import space_from_plain, space_to_plain
from encoders.spaces import DepthImage, PointCloud, RgbImage


@pytest.mark.parametrize(
    "space",
    [
        Box(-1.0, 1.0, (4,), np.float32),
        Box(np.array([-1.0, -np.inf]), np.array([0.1, np.inf]), dtype=np.float32),
        Box(np.array([-1.0, 0.3]), np.array([0.1, 1e300]), dtype=np.float64),
        Box(0, 255, (84, 84, 4), np.uint8),
        Box(0, 2**64 - 1, (2,), np.uint64),
        Box(np.array([-(2**63), 0]), np.array([2**63 - 1, 2**62 + 1]), dtype=np.int64),
        Discrete(5),
        Discrete(3, start=-1),
        MultiDiscrete([3, 2]),
        MultiDiscrete([3, 2], start=[-1, 5]),
        MultiBinary(3),
        DepthImage(
            48,
            64,
            (0.4, 2.0),
            "uint8",
            Pinhole(51.2, 50.1, 32.5, 23.0),
            Sampling(640, 480, 1, 2, 64, 48, 9),
        ),
        DepthImage(48, 64),
        PointCloud(7, "base", (0.1, -0.2, 0.3)),
        RgbImage(2, 3),
        RgbImage(2, 3, Sampling(9, 9, 0, 0, 3, 2, 3)),
        Dict({"b": Box(0.0, 1.0, (2,), np.float32), "a": RgbImage(1, 1)}),
        Dict(OrderedDict(b=Box(0.0, 1.0, (2,), np.float32), a=Box(0.0, 1.0, (2,), np.float32))),
    ],
)
def test_a_space_comes_back_through_json(space: gymnasium.Space[Any]) -> None:
    back = space_from_plain(json.loads(json.dumps(space_to_plain(space), allow_nan=False)))
    assert back == space
    assert type(back) is type(space)
    assert back.dtype == space.dtype
    if isinstance(space, Dict):
        assert isinstance(back, Dict)
        assert list(back.spaces) == list(space.spaces)


def test_equal_bounds_are_written_once() -> None:
    plain = space_to_plain(Box(0, 255, (84, 84, 4), np.uint8))
    assert plain == {"type": "box", "low": 0, "high": 255, "shape": [84, 84, 4], "dtype": "uint8"}


def test_a_depth_image_of_before_has_its_axis_in_the_middle() -> None:
    plain = {"type": "depth_image", "height": 48, "width": 64, "range_m": [0.4, 2.0]}
    plain |= {"encoding": "uint16", "focal_length_px": 51.2}
    expected = DepthImage(48, 64, pinhole=Pinhole(51.2, 51.2, 32.0, 24.0))
    assert space_from_plain(plain) == expected


def test_what_can_not_be_written_is_refused() -> None:
    with pytest.raises(ValueError, match="Text"):
        space_to_plain(Text(3))
    with pytest.raises(ValueError, match="unknown type 'graph'"):
        space_from_plain({"type": "graph"})


def test_a_policy_from_before_samplings_sees_the_whole_sensor():
    plain = space_to_plain(DepthImage(2, 3, pinhole=Pinhole(4.0, 4.0, 1.5, 1.0)))
    del plain["sampling"], plain["pinhole"]
    read = space_from_plain({**plain, "focal_length_px": 4.0})
    whole = Sampling(3, 2, 0, 0, 3, 2, 1)
    assert read == DepthImage(2, 3, pinhole=Pinhole(4.0, 4.0, 1.5, 1.0), sampling=whole)
    assert space_from_plain({"type": "rgb_image", "height": 2, "width": 3}) == RgbImage(
        2, 3, sampling=whole
    )


BOX = {"type": "box", "low": -1.0, "high": 1.0, "shape": [2], "dtype": "float32"}


@pytest.mark.parametrize(
    ("plain", "said"),
    [
        (BOX | {"shape": [2**20 + 1]}, "in all 1048576"),
        (BOX | {"shape": [2**13, 2**13, 2]}, "in all 67108864"),
        (BOX | {"shape": [0]}, "sizes are from 1 on"),
        (BOX | {"shape": [2.0]}, "sizes are from 1 on"),
        (BOX | {"low": "nan"}, "a bound is 'nan'"),
        (BOX | {"low": [0.0, float("nan")]}, "a space of float32 from nan"),
        (BOX | {"high": True}, "a bound is True"),
        (BOX | {"high": -2.0}, "a space of float32 from -1.0 to -2.0"),
        ({"type": "discrete", "n": 10**9, "start": 0}, "in all 1048576"),
        ({"type": "rgb_image", "height": 10**6, "width": 10**6}, "in all 67108864"),
        ({"type": "depth_image", "height": 10**6, "width": 10**6}, "in all 67108864"),
        ({"type": "dict", "entries": {}}, "no observations"),
    ],
)
def test_a_space_that_no_environment_has_is_refused(plain: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        space_from_plain(plain)
