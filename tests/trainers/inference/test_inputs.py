from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

from encoders.spaces import DepthImage
from trainers.inference.inputs import checked

VECTOR = Box(-1.0, 1.0, (2,), np.float32)
SPACE = Dict({"camera": DepthImage(3, 4), "speed": VECTOR})
IMAGE = np.zeros((3, 4, 1), np.uint16)


def test_one_observation_gets_a_leading_axis() -> None:
    arrays, is_single = checked({"camera": IMAGE, "speed": np.zeros(2, np.float32)}, SPACE)
    assert is_single
    assert (arrays["camera"].shape, arrays["speed"].shape) == ((1, 3, 4, 1), (1, 2))


def test_a_batch_stays_as_it_is() -> None:
    given = {"camera": np.stack([IMAGE] * 5), "speed": np.zeros((5, 2), np.float32)}
    arrays, is_single = checked(given, SPACE)
    assert not is_single
    assert arrays["camera"] is given["camera"]


@pytest.mark.parametrize("given", [[0.5, -1], np.array([0.5, -1.0]), np.array([1, -1])])
def test_numbers_of_any_type_are_vectors(given: Any) -> None:
    arrays, is_single = checked({"speed": given}, Dict({"speed": VECTOR}))
    assert arrays["speed"].dtype == np.float32
    assert is_single


def test_a_single_observation_needs_no_name() -> None:
    arrays, _ = checked(np.ones((7, 2), np.float32), Dict({"speed": VECTOR}))
    assert arrays["speed"].shape == (7, 2)
    with pytest.raises(ValueError, match="a mapping by name is expected, of camera, speed"):
        checked(IMAGE, SPACE)


def test_everything_that_is_wrong_is_named() -> None:
    given = {"camra": IMAGE, "speed": np.zeros((5, 3), np.float32), "extra": IMAGE}
    with pytest.raises(ValueError, match=r"^observations: ") as error:
        checked(given, SPACE, ignored=("extra",))
    message = str(error.value)
    assert "'camera' is missing" in message
    assert "'camra' is unknown; did you mean 'camera'?" in message
    assert "'speed': of shape (5, 3), where (2,) or (B, ...) of it is expected" in message
    assert "extra" not in message


def test_codes_of_another_type_are_refused_for_they_mean_something_else() -> None:
    given = {"camera": IMAGE.astype(np.uint8), "speed": np.zeros(2, np.float32)}
    with pytest.raises(ValueError, match="'camera': of type uint8, where uint16 is expected"):
        checked(given, SPACE)


@pytest.mark.parametrize("count", [None, 4])
def test_observations_have_the_same_leading_axis(count: int | None) -> None:
    speed = np.zeros((5, 2) if count else 2, np.float32)
    camera = np.stack([IMAGE] * (count or 5))
    with pytest.raises(ValueError, match="of different leading axes B"):
        checked({"camera": camera, "speed": speed}, SPACE)
