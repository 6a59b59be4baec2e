"""What actions mean, and where a place is that a camera saw which is elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.deployment import MAX_TILT_DEG, Meaning, Mount, Quantity, correction

angles = st.floats(-np.pi, np.pi)
lengths = st.floats(-2.0, 2.0)


def turned(axis: int, angle: float) -> np.ndarray:
    """Rotation (3, 3) about an axis of the world."""
    turn = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn[[a, b], [a, b]] = np.cos(angle)
    turn[b, a], turn[a, b] = np.sin(angle), -np.sin(angle)
    return turn


NOMINAL = Mount.of(np.array([0.3, 0.1, 1.2]), turned(1, 0.4) @ turned(0, -1.9))


def moved(shift: np.ndarray, turn: np.ndarray) -> Mount:
    return Mount.of(turn @ np.array(NOMINAL.position_m) + shift, turn @ np.array(NOMINAL.rotation))


@given(x=lengths, y=lengths, z=lengths, heading=angles, by=angles)
def test_what_moves_with_the_camera_is_where_it_was_moved_to(
    x: float, y: float, z: float, heading: float, by: float
) -> None:
    shift, turn = np.array([0.05, -0.02, 0.1]), turned(2, by)
    matrix, offset = correction(NOMINAL, moved(shift, turn))
    real = matrix @ [x, y, z, heading] + offset
    np.testing.assert_allclose(real[:3], turn @ [x, y, z] + shift, atol=1e-9)
    # Headings are equal up to whole turns.
    off = np.exp(1j * real[3]) - np.exp(1j * (heading + by))
    assert abs(off) < 1e-9


@given(heading=angles, about=angles, by=angles)
def test_positions_are_exact_and_headings_nearly_so_where_it_is_tilted(
    heading: float, about: float, by: float
) -> None:
    tilt = turned(2, about) @ turned(0, np.radians(MAX_TILT_DEG - 0.01)) @ turned(2, -about)
    turn = tilt @ turned(2, by)
    matrix, offset = correction(NOMINAL, moved(np.zeros(3), turn))
    real = matrix @ [0.9, 0.2, 0.7, heading] + offset
    np.testing.assert_allclose(real[:3], turn @ [0.9, 0.2, 0.7], atol=1e-9)
    ahead = turn @ [np.cos(heading), np.sin(heading), 0.0]
    off = np.angle(np.exp(1j * (real[3] - np.arctan2(ahead[1], ahead[0]))))
    assert abs(np.degrees(off)) < 0.12


def test_a_camera_that_is_tilted_too_much_is_refused() -> None:
    with pytest.raises(ValueError, match=r"tilted by 6\.0 deg .* where 5 deg are borne"):
        correction(NOMINAL, moved(np.zeros(3), turned(0, np.radians(6.0))))


def test_an_outline_is_drawn_where_the_place_is() -> None:
    speed = Quantity(name="x_m", low=0.0, high=1.0, label="x")
    meaning = Meaning(
        name="place",
        quantities=(speed,) * 4,
        is_place=True,
        outline=(((1.0, 0.0, 0.0), (0.0, 2.0, 3.0)),),
    )
    (line,) = meaning.lines(np.array([10.0, 20.0, 30.0, np.pi / 2]))
    np.testing.assert_allclose(line, [[10.0, 21.0, 30.0], [8.0, 20.0, 33.0]], atol=1e-12)


def test_people_read_quantities_in_their_own_units() -> None:
    assert Quantity(name="v_m", low=0, high=1, label="v", unit="mm", scale=1e3).shown(0.25) == (
        "v 250.00 mm"
    )
