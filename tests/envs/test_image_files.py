"""Image files are read as they are; what is wrong with them is named, with what is expected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from encoders.cameras import Sampling
from encoders.raw_inputs import raw_input
from encoders.spaces import DepthImage, RgbImage
from envs.image_files import read_image

TAKEN = Sampling(12, 10, 2, 1, 3, 2, 4)
DEPTH = raw_input(DepthImage(2, 3, (0.4, 2.0), sampling=TAKEN))
TENTHS = raw_input(DepthImage(2, 3, (0.4, 2.0), sampling=TAKEN), unit_per_m=10_000.0)
COLOR = raw_input(RgbImage(2, 3, TAKEN))
MILLIMETRES = np.random.default_rng(0).integers(500, 1500, (10, 12), np.uint16)
MILLIMETRES[0, :3] = 0


def file(folder: Path, content: np.ndarray, name: str = "image.png") -> Path:
    path = folder / name
    if path.suffix == ".npy":
        np.save(path, content)
    else:
        assert cv2.imwrite(str(path), content)
    return path


@pytest.mark.parametrize("name", ["image.png", "image.npy"])
def test_sixteen_bits_come_as_they_are(name: str, tmp_path: Path) -> None:
    found = read_image(file(tmp_path, MILLIMETRES, name), DEPTH)
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, MILLIMETRES)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floats_are_metres(dtype: Any, tmp_path: Path) -> None:
    path = file(tmp_path, (MILLIMETRES / 1000).astype(dtype), "image.npy")
    off = read_image(path, TENTHS).astype(int) - 10 * MILLIMETRES.astype(int)
    assert np.abs(off).max() <= (10 if dtype == np.float16 else 0)


def test_a_last_axis_of_one_is_no_channel_too_many(tmp_path: Path) -> None:
    found = read_image(file(tmp_path, MILLIMETRES[..., None], "image.npy"), DEPTH)
    np.testing.assert_array_equal(found, MILLIMETRES)


def test_colors_are_red_green_blue(tmp_path: Path) -> None:
    red = np.zeros((10, 12, 3), np.uint8)
    red[..., 2] = 200  # OpenCV writes blue first
    found = read_image(file(tmp_path, red), COLOR)
    assert found[0, 0].tolist() == [200, 0, 0]


def test_an_image_in_which_nothing_was_seen_is_an_image(tmp_path: Path) -> None:
    assert not read_image(file(tmp_path, np.zeros((10, 12), np.uint16)), DEPTH).any()


@pytest.mark.parametrize(
    ("content", "name", "expected", "said"),
    [
        (MILLIMETRES.astype(np.uint8), "a.png", DEPTH, "12x10 pixels (width x height), uint8"),
        (
            np.zeros((10, 12, 3), np.uint8),
            "a.png",
            DEPTH,
            "uint8, 3 channels; expected is a 16-bit",
        ),
        (np.zeros((10, 12, 3), np.uint16), "a.png", DEPTH, "uint16, 3 channels"),
        (MILLIMETRES.T.copy(), "a.png", DEPTH, "10x12 pixels (width x height), uint16; expected"),
        (MILLIMETRES, "a.png", COLOR, "expected is an image of uint8, of 12x10 pixels"),
        (MILLIMETRES.astype(np.int32), "a.npy", DEPTH, "12x10 pixels (width x height), int32"),
        (np.ones(5), "a.npy", DEPTH, "an array of shape (5,), float64"),
        (MILLIMETRES.astype(np.float32), "a.npy", DEPTH, "are they millimetres? Floats have to be"),
        (MILLIMETRES // 10, "a.png", DEPTH, "1000 is taken for one metre"),
        (MILLIMETRES * np.uint16(10), "a.png", DEPTH, "tenths of a millimetre? --unit N"),
        (MILLIMETRES, "a.png", TENTHS, "are they millimetres? --unit N says"),
        (np.full((10, 12), -1.0), "a.npy", DEPTH, "depths down to -1 m"),
        (np.where(MILLIMETRES, 1.0, np.nan), "a.npy", DEPTH, "3 values are NaN or infinite"),
    ],
)
def test_what_does_not_fit_is_named(
    content: np.ndarray, name: str, expected: Any, said: str, tmp_path: Path
) -> None:
    path = file(tmp_path, content, name)
    with pytest.raises(ValueError, match="expected") as error:
        read_image(path, expected)
    assert str(error.value).startswith(f"{path}: ")
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("content", "name", "said"),
    [
        (None, "a.png", "can't be read: No such file or directory"),
        (b"", "a.png", "no image that OpenCV can read; expected is a PNG"),
        (b"hello", "a.png", "no image that OpenCV can read; expected is a PNG"),
        (b"hello", "a.npy", "no array file that NumPy can read"),
        (b"", "a.npy", "no array file that NumPy can read"),
    ],
)
def test_what_is_no_image_is_named(
    content: bytes | None, name: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match="read") as error:
        read_image(path, DEPTH)
    assert str(error.value).startswith(f"{path}: {said}")
