"""Depth and RGB spaces: encoding, decoding, identity."""

import copy
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from encoders.cameras import Pinhole, Sampling
from encoders.spaces import DepthImage, RgbImage


def encode_one(space, metres):
    return space.encode(np.full(space.shape[:2], metres, dtype=np.float32))


def decode_one(space, value):
    raw = torch.from_numpy(np.full(space.shape, value, dtype=space.dtype))
    metres = space.decode(raw)
    assert metres.dtype == torch.float32
    assert metres.shape == space.shape
    return metres.unique().item()


ENCODINGS = pytest.mark.parametrize("encoding", ["uint16", "uint8"])


@ENCODINGS
@given(near=st.floats(0.0, 3.0), span=st.floats(0.002, 4.0), share=st.floats(-0.5, 1.5, width=32))
def test_what_is_in_the_range_is_seen_within_a_step_and_nothing_else_is(
    encoding, near, span, share
):
    space = DepthImage(1, 1, (near, near + span), encoding)
    depth_m = np.float32(near + share * span)
    raw = torch.from_numpy(encode_one(space, depth_m))
    inside = np.float32(near) <= depth_m <= np.float32(near + span)
    assert space.seen(raw).item() == inside == (raw.item() != 0)
    step_m = 0.001 if encoding == "uint16" else span / 255
    expected = depth_m if inside else near + span
    assert space.decode(raw).item() == pytest.approx(expected, abs=step_m + 1e-6)
    decoded = space.decode_seen(raw).item()
    assert decoded == (space.decode(raw).item() if inside else np.inf)


@ENCODINGS
@given(depth_m=st.floats(0.41, 1.99))
def test_a_round_trip_is_within_half_a_step(encoding, depth_m):
    space = DepthImage(1, 1, encoding=encoding)
    decoded = space.decode(torch.from_numpy(encode_one(space, depth_m))).item()
    half_m = 0.000_501 if encoding == "uint16" else 0.5 * 1.6 / 255 + 1e-6
    assert decoded == pytest.approx(depth_m, abs=half_m)


@ENCODINGS
@given(near=st.integers(0, 900), span=st.integers(10, 3000), values=st.lists(st.integers(0, 255)))
def test_codes_survive_decoding_and_encoding(encoding, near, span, values):
    space = DepthImage(1, len(values) or 1, (near / 1000, (near + span) / 1000), encoding)
    codes = np.array(values or [0], dtype=space.dtype)
    if encoding == "uint16":  # the camera's own range, in whole millimetres, and nothing seen
        codes = np.where(codes, near + codes.astype(int) * span // 255, 0).astype(np.uint16)
        codes[codes == near] = max(near, 1)
    raw = codes.reshape(space.shape)
    metres = space.decode_seen(torch.from_numpy(raw)).numpy()[..., 0]
    # Apart from the float32 that metres are, which may lie beyond the end that they stand for.
    metres = np.where(np.isfinite(metres), metres.clip(*np.float32(space.range_m)), np.inf)
    np.testing.assert_array_equal(space.encode(metres), raw)


@pytest.mark.parametrize(
    ("value", "metres"), [(51, 0.72), (102, 1.04), (204, 1.68), (255, 2.0), (0, 2.0)]
)
def test_bytes_follow_the_papers_clamp_equation_but_for_nothing_seen(value, metres):
    assert decode_one(DepthImage(2, 3, encoding="uint8"), value) == pytest.approx(metres, abs=1e-6)


@pytest.mark.parametrize(
    ("value", "metres"),
    [(0, 2.0), (399, 2.0), (400, 0.4), (1234, 1.234), (2000, 2.0), (2001, 2.0), (65_535, 2.0)],
)
def test_uint16_is_millimetres_and_the_far_end_outside_the_range(value, metres):
    assert decode_one(DepthImage(2, 3), value) == pytest.approx(metres, abs=1e-6)


@pytest.mark.parametrize(
    ("range_m", "encoding", "codes"),
    [
        ((0.4, 2.0), "uint16", (400, 2000)),
        ((0.57, 1.09), "uint16", (570, 1090)),  # 0.57 * 1000 is 569.9999999999999
        ((0.4004, 1.9996), "uint16", (401, 1999)),  # those that lie inside
        ((0.0, 65.535), "uint16", (1, 65535)),
        ((0.4, 1.6), "uint8", (1, 255)),
        ((0.0, 3.0), "uint8", (1, 255)),
    ],
)
def test_codes_of_the_ranges_ends(range_m, encoding, codes):
    space = DepthImage(1, 4, range_m, encoding)
    assert space.codes == codes
    around = np.array([codes[0] - 1, *codes, min(codes[1] + 1, 255 if codes[1] == 255 else 65535)])
    seen = space.seen(torch.from_numpy(around.astype(space.dtype))).tolist()
    assert seen == [False, True, True, codes[1] in (255, 65535)]
    assert space.encode(np.array([range_m])).ravel().tolist() == list(codes)


def test_values_above_the_signed_half_of_uint16_are_not_negative():
    assert decode_one(DepthImage(1, 1, (0.0, 60.0)), 40_000) == pytest.approx(40.0)


def test_encode_rounds_and_gives_0_to_what_is_outside_the_range():
    metres = np.array([[[0.3999, 0.4, 0.5004, 0.5006, 2.0, 2.0001, np.inf, np.nan]]])
    uint16 = DepthImage(1, 8).encode(metres)
    assert uint16.dtype == np.uint16
    assert uint16.shape == (1, 1, 8, 1)
    assert uint16.ravel().tolist() == [0, 400, 500, 501, 2000, 0, 0, 0]
    # (0.5 - 0.4) / 1.6 * 255 = 15.9375; the near end rounds to 0, which is taken
    metres = np.array([[0.39, 0.4, 0.402, 0.5, 2.0, 2.001, np.inf]])
    uint8 = DepthImage(1, 7, encoding="uint8").encode(metres)
    assert uint8.dtype == np.uint8
    assert uint8.ravel().tolist() == [0, 1, 1, 16, 255, 0, 0]


@pytest.mark.parametrize("method", ["decode", "decode_seen", "seen"])
def test_decoding_leaves_its_argument_alone(method):
    space = DepthImage(1, 3)
    raw = torch.tensor([0.0, 1000.0, 3000.0])
    getattr(space, method)(raw)
    assert raw.tolist() == [0.0, 1000.0, 3000.0]


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
    assert DepthImage(2, 3) != DepthImage(2, 3, pinhole=Pinhole(5.0, 5.0, 1.5, 1.0))
    assert DepthImage(2, 3) != DepthImage(2, 3, sampling=Sampling(4, 4, 0, 0, 3, 2, 1))
    assert RgbImage(2, 3) != RgbImage(2, 3, Sampling(4, 4, 0, 0, 3, 2, 1))
    assert DepthImage(2, 3) != DepthImage(3, 2)


@ENCODINGS
def test_a_picture_is_warm_near_cold_far_and_gray_where_nothing_was_seen(encoding):
    space = DepthImage(2, 3, (1.0, 40.0), encoding)
    depth_m = np.array([[1.0, 40.0, 20.5], [0.9, 40.1, np.inf]])
    image = space.picture(space.encode(depth_m))
    assert image.dtype == np.uint8
    assert image.shape == (2, 3, 3)
    (near, far, middle), unseen = image[0].astype(int), image[1]
    assert near[0] > 100 > near[2]  # red
    assert far[2] >= far[0]  # blue
    assert middle[1] > max(near[1], far[1])  # green
    assert (unseen == 128).all()


def test_a_picture_of_colors_is_the_image():
    frame = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
    np.testing.assert_array_equal(RgbImage(4, 6).picture(frame), frame)


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
        ({"range_m": (0.4002, 0.4008)}, r"no whole millimetre.*'uint8'"),
        ({"encoding": "uint32"}, "'uint32'.*'uint16'"),
        ({"height": 0}, "3x0"),
        ({"sampling": Sampling(8, 8, 0, 0, 4, 2, 2)}, "another size than 3x2"),
    ],
)
def test_senseless_depth_cameras_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        DepthImage(**({"height": 2, "width": 3} | arguments))
