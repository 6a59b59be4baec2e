"""Depth and RGB spaces: encoding, decoding, identity."""

import copy
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from encoders.spaces import DepthImage, RgbImage

DEPTHS_M = st.floats(0.0, 10.0, width=32)


def encode_one(space, metres):
    return space.encode(np.full(space.shape[:2], metres, dtype=np.float32))


def decode_one(space, value):
    raw = torch.from_numpy(np.full(space.shape, value, dtype=space.dtype))
    metres = space.decode(raw)
    assert metres.dtype == torch.float32
    assert metres.shape == space.shape
    return metres.unique().item()


@pytest.mark.parametrize(
    ("encoding", "error_m"), [("uint16", 0.000_501), ("uint8", 0.5 * 1.6 / 255 + 1e-6)]
)
@given(metres=DEPTHS_M)
def test_round_trip_is_the_clamped_depth_within_half_a_step(encoding, error_m, metres):
    space = DepthImage(1, 1, encoding=encoding)
    decoded = space.decode(torch.from_numpy(encode_one(space, metres))).item()
    assert decoded == pytest.approx(min(max(metres, 0.4), 2.0), abs=error_m)


@pytest.mark.parametrize("encoding", ["uint16", "uint8"])
@given(near=st.integers(0, 900), span=st.integers(10, 3000), values=st.lists(st.integers(0, 255)))
def test_codes_survive_decoding_and_encoding(encoding, near, span, values):
    space = DepthImage(1, len(values) or 1, (near / 1000, (near + span) / 1000), encoding)
    codes = np.array(values or [0], dtype=space.dtype)
    if encoding == "uint16":  # the camera's own range, in whole millimetres
        codes = (near + codes.astype(int) * span // 255).astype(np.uint16)
    raw = codes.reshape(space.shape)
    metres = space.decode(torch.from_numpy(raw)).numpy()[..., 0]
    np.testing.assert_array_equal(space.encode(metres), raw)


@pytest.mark.parametrize(
    ("value", "metres"), [(0, 0.4), (51, 0.72), (102, 1.04), (204, 1.68), (255, 2.0)]
)
def test_bytes_follow_the_papers_clamp_equation(value, metres):
    assert decode_one(DepthImage(2, 3, encoding="uint8"), value) == pytest.approx(metres, abs=1e-6)


@pytest.mark.parametrize(
    ("value", "metres"),
    [(0, 0.4), (399, 0.4), (401, 0.401), (1234, 1.234), (2001, 2.0), (40_000, 2.0), (65_535, 2.0)],
)
def test_uint16_is_millimetres_clamped_to_the_range(value, metres):
    assert decode_one(DepthImage(2, 3), value) == pytest.approx(metres, abs=1e-6)


def test_values_above_the_signed_half_of_uint16_are_not_negative():
    assert decode_one(DepthImage(1, 1, (0.0, 60.0)), 40_000) == pytest.approx(40.0)


def test_encode_rounds_clamps_and_appends_the_channel():
    metres = np.array([[[0.0, 0.5004, 0.5006, np.inf]]])
    uint16 = DepthImage(1, 4).encode(metres)
    assert uint16.dtype == np.uint16
    assert uint16.shape == (1, 1, 4, 1)
    assert uint16.ravel().tolist() == [400, 500, 501, 2000]
    # (0.5 - 0.4) / 1.6 * 255 = 15.9375
    uint8 = DepthImage(1, 3, encoding="uint8").encode(np.array([[0.0, 0.5, np.inf]]))
    assert uint8.dtype == np.uint8
    assert uint8.ravel().tolist() == [0, 16, 255]


def test_encode_leaves_its_argument_alone():
    metres = np.array([[0.1, 1.0]])
    DepthImage(1, 2).encode(metres)
    assert metres.tolist() == [[0.1, 1.0]]


@pytest.mark.parametrize("space", [DepthImage(4, 5), DepthImage(4, 5, (0, 3), "uint8")])
def test_encoded_images_belong_to_the_space(space):
    metres = np.random.default_rng(0).uniform(0, 3, (4, 5))
    assert space.contains(space.encode(metres))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_copies_keep_their_meaning(duplicate):
    space = DepthImage(2, 3, (0.3, 1.0), "uint8")
    twin = duplicate(space)
    assert twin == space
    assert hash(twin) == hash(space)
    assert twin.range_m == (0.3, 1.0)
    assert twin.encoding == "uint8"


def test_spaces_of_other_range_or_encoding_differ():
    assert DepthImage(2, 3) != DepthImage(2, 3, (0.4, 3.0))
    assert DepthImage(2, 3) != DepthImage(2, 3, encoding="uint8")
    assert DepthImage(2, 3) != DepthImage(2, 3, focal_length_px=5.0)
    assert DepthImage(2, 3) != DepthImage(3, 2)


def test_rgb_is_bytes_with_three_channels():
    space = RgbImage(4, 6)
    assert space.shape == (4, 6, 3)
    assert space.dtype == np.uint8
    assert space.contains(np.full((4, 6, 3), 255, dtype=np.uint8))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"range_m": (2.0, 0.4)}, r"\[2.0, 0.4\]"),
        ({"range_m": (-0.1, 0.4)}, r"\[-0.1, 0.4\]"),
        ({"range_m": (0.1, float("nan"))}, "nan"),
        ({"range_m": (0.4, 66.0)}, r"66.0 m .* 65.535 m"),
        ({"encoding": "uint32"}, "'uint32'.*'uint16'"),
        ({"height": 0}, "3x0"),
        ({"focal_length_px": 0.0}, "focal length of 0.0 pixels"),
        ({"focal_length_px": float("inf")}, "focal length of inf pixels"),
    ],
)
def test_senseless_depth_cameras_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        DepthImage(**({"height": 2, "width": 3} | arguments))
