"""Images from files, as a sensor delivers them: every mistake is named, none is guessed away."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from encoders.raw_inputs import RawDepth, RawInput
from encoders.spaces import MM_PER_M, NOTHING_SEEN, UINT16_MAX

ARRAY_SUFFIX = ".npy"
# Units are mistaken by a factor of 10 or 1000; scenes leave the range by less than this.
FAR_OUTSIDE = 2.0
KNOWN_UNITS = {"metres": 1.0, "millimetres": float(MM_PER_M), "tenths of a millimetre": 10_000.0}


def read_image(path: Path, expected: RawInput) -> NDArray[Any]:
    """One raw image, of the shape and type that are expected.

    Depth may be a 16-bit PNG or an array (.npy) of uint16 in the input's unit, or an array of
    floats in metres; color a PNG or an array of bytes.

    Args:
        path: of the file.
        expected: the input that it is for.

    Raises:
        ValueError: the message names the file, what was found in it, and what is expected.
    """
    try:
        found = _read(path)
    except OSError as error:
        raise ValueError(f"{path}: can't be read: {error.strerror or error}") from error
    if isinstance(expected, RawDepth):
        return _depth(path, found, expected)
    _check(path, found, expected, expected.dtype == found.dtype, f"an image of {expected.dtype}")
    return found


def _read(path: Path) -> NDArray[Any]:
    """An array file, or an image as it is: OpenCV's BGR becomes RGB."""
    if path.suffix == ARRAY_SUFFIX:
        try:
            array: NDArray[Any] = np.load(path, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise ValueError(f"{path}: no array file that NumPy can read: {error}") from error
        return array
    import cv2  # noqa: PLC0415

    coded = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED) if coded.size else None
    if image is None:
        raise ValueError(
            f"{path}: no image that OpenCV can read; expected is a PNG or an .npy file"
        )
    return image[..., ::-1] if image.shape[2:] == (3,) else image


def _depth(path: Path, found: NDArray[Any], expected: RawDepth) -> NDArray[np.uint16]:
    if found.ndim == 3 and found.shape[2] == 1:
        found = found[..., 0]
    is_float = found.dtype.kind == "f"
    fits = is_float or found.dtype == np.uint16
    _check(path, found, expected, fits, "a 16-bit PNG, or uint16 or metres as floats (.npy)")
    if not np.isfinite(found).all():
        raise ValueError(
            f"{path}: {np.count_nonzero(~np.isfinite(found))} values are NaN or infinite; expected "
            "are numbers, and 0 where nothing was seen: np.nan_to_num(image, posinf=0, neginf=0)"
        )
    metres = found.astype(np.float64) / (1.0 if is_float else expected.unit_per_m)
    _check_scale(path, metres, expected, is_float)
    if not is_float:
        return found
    return np.rint(metres * expected.unit_per_m).clip(0, UINT16_MAX).astype(np.uint16)


def _check(path: Path, found: NDArray[Any], expected: RawInput, fits: bool, what: str) -> None:
    """Refuses an image of another size or type."""
    if found.shape == expected.shape and fits:
        return
    rows, columns, *channels = expected.shape
    layers = f"{channels[0]} channels" if channels else "one channel"
    raise ValueError(
        f"{path}: {_described(found)}; expected is {what}, of {columns}x{rows} pixels "
        f"(width x height) and {layers}, as the sensor delivers it"
    )


def _described(found: NDArray[Any]) -> str:
    """What was found: `640x480 pixels (width x height), uint8, 3 channels`."""
    if found.ndim not in (2, 3):
        return f"an array of shape {found.shape}, {found.dtype}"
    rows, columns, *channels = found.shape
    layers = f", {channels[0]} channels" if channels else ""
    return f"{columns}x{rows} pixels (width x height), {found.dtype}{layers}"


def _check_scale(
    path: Path, metres: NDArray[np.float64], expected: RawDepth, is_float: bool
) -> None:
    """Refuses depths in another unit: their median is far outside the camera's range then."""
    near_m, far_m = expected.space.range_m
    seen = metres[metres != NOTHING_SEEN]
    if (metres < 0.0).any():
        raise ValueError(f"{path}: depths down to {metres.min():g} m; expected are 0 and more")
    median_m = float(np.median(seen)) if seen.size else near_m
    if near_m / FAR_OUTSIDE <= median_m <= far_m * FAR_OUTSIDE:
        return
    unit = 1.0 if is_float else expected.unit_per_m
    likely = [
        name for name, per_m in KNOWN_UNITS.items() if near_m <= median_m * unit / per_m <= far_m
    ]
    kind = "floats are metres" if is_float else f"{unit:g} is taken for one metre"
    hint = f"; are they {likely[0]}?" if likely else ""
    raise ValueError(
        f"{path}: half of its depths are over {median_m:g} m, where {kind}, and expected are "
        f"{near_m:g} to {far_m:g} m{hint} {_way_out(is_float)}"
    )


def _way_out(is_float: bool) -> str:
    if is_float:
        return "Floats have to be metres: convert them."
    return "--unit N says that N is one metre: 1000 for millimetres, 10000 for tenths of them."
