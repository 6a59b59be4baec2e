"""Rows of values against rows worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from curricula.interpolation import Interpolation


def test_linear_by_default():
    assert Interpolation(first=-0.5, last=1.5).values(5) == (-0.5, 0.0, 0.5, 1.0, 1.5)


def test_exponential_halves_each_time():
    row = Interpolation(first=8, last=0.5, interpolation="exponential").values(5)
    assert row == pytest.approx((8, 4, 2, 1, 0.5))
    row = Interpolation(first=-1, last=-100, interpolation="exponential").values(3)
    assert row == pytest.approx((-1, -10, -100))


def test_power():
    row = Interpolation(first=0, last=16, interpolation="power", power=2).values(5)
    assert row == pytest.approx((0, 1, 4, 9, 16))
    row = Interpolation(first=4, last=0, interpolation="power", power=0.5).values(5)
    assert row == pytest.approx((4, 2, 4 - 8**0.5, 4 - 12**0.5, 0))


KINDS = [{}, {"interpolation": "exponential"}, {"interpolation": "power", "power": 3}]


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.integers(2, 30), st.sampled_from(KINDS))
def test_every_row_keeps_its_ends_and_never_turns_back(first, last, count, kind):
    row = Interpolation(first=first, last=last, **kind).values(count)
    assert len(row) == count
    assert (row[0], row[-1]) == (first, last)
    assert (np.diff(row) * np.sign(last - first) >= -1e-12 * max(first, last)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_equal_ends_stay_exactly_equal(kind):
    assert Interpolation(first=0.1, last=0.1, **kind).values(7) == (0.1,) * 7


def test_a_single_value_is_the_last():
    row = Interpolation(first=1, last=2)
    assert row.values(1) == (2.0,)
    assert row.values(0) == ()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"first": -0.1, "last": 0.8, "interpolation": "exponential"}, "-0.1 to 0.8"),
        ({"first": 0, "last": 0.8, "interpolation": "exponential"}, "neither be zero"),
        ({"first": 1, "last": 0, "interpolation": "exponential"}, "neither be zero"),
        ({"first": 1e-300, "last": 1e300, "interpolation": "exponential"}, "too far apart"),
        ({"first": -1.7e308, "last": 1.7e308}, "too far apart"),
        ({"first": 1, "last": 2, "interpolation": "power"}, "give a power"),
        ({"first": 1, "last": 2, "power": 2}, "give a power"),
        ({"first": 1, "last": 2, "interpolation": "power", "power": 0}, "greater than 0"),
        ({"first": 1, "last": float("nan")}, "finite"),
        ({"first": 1}, "last"),
        ({"first": 1, "last": 2, "interpolation": "cubic"}, "linear"),
    ],
)
def test_unfit_settings_are_refused(settings, message):
    with pytest.raises(ValidationError, match=message):
        Interpolation(**settings)
