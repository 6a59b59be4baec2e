"""Ranges, moments and errors of the samplers."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from curricula.samplers import ParameterValue, draw

VALUE = TypeAdapter(ParameterValue)


def sampler(kind, **parameters):
    return VALUE.validate_python({"sampler_type": kind, "sampler_parameters": parameters})


def uniform(low, high):
    return sampler("uniform", min_value=low, max_value=high)


def rng():
    return np.random.default_rng(0)


def test_uniform_fills_its_range():
    values = uniform(-30, 10).sample(rng(), 20_000)
    assert values.shape == (20_000,)
    assert -30 <= values.min() < -29.9
    assert 9.9 < values.max() <= 10
    assert values.mean() == pytest.approx(-10, abs=0.3)
    assert values.std() == pytest.approx(40 / 12**0.5, rel=0.02)


def test_gaussian_moments():
    values = sampler("gaussian", mean=5, st_dev=2).sample(rng(), 20_000)
    assert values.mean() == pytest.approx(5, abs=0.05)
    assert values.std() == pytest.approx(2, rel=0.02)
    assert np.mean(np.abs(values - 5) < 2) == pytest.approx(0.6827, abs=0.01)


def test_multirange_picks_intervals_by_width():
    values = sampler("multirangeuniform", intervals=[[10, 13], [-2, -1]]).sample(rng(), 20_000)
    low, high = values[values < 0], values[values > 0]
    assert len(high) / len(values) == pytest.approx(0.75, abs=0.01)
    assert -2 <= low.min() < -1.99
    assert -1.01 < low.max() <= -1
    assert 10 <= high.min() < 10.01
    assert 12.99 < high.max() <= 13
    assert low.mean() == pytest.approx(-1.5, abs=0.02)
    assert high.mean() == pytest.approx(11.5, abs=0.03)


@given(
    st.lists(
        st.tuples(st.floats(-1e6, 1e6), st.floats(1e-9, 1e6)).map(lambda p: (p[0], p[0] + p[1])),
        min_size=1,
        max_size=5,
    ).filter(lambda intervals: all(a < b for a, b in intervals)),
    st.integers(0, 2**32),
)
def test_multirange_stays_inside_its_intervals(intervals, seed):
    chosen = sampler("multirangeuniform", intervals=intervals)
    for value in chosen.sample(np.random.default_rng(seed), 20):
        assert any(start <= value <= stop for start, stop in intervals)


def test_limits_hold_all_that_is_drawn():
    assert uniform(-30, 10).limits == (-30, 10)
    assert sampler("multirangeuniform", intervals=[[10, 13], [-2, -1]]).limits == (-2, 13)
    assert sampler("gaussian", mean=0, st_dev=1).limits == (-np.inf, np.inf)


def test_draws_are_independent_and_seeded():
    for chosen in (
        uniform(0, 1),
        sampler("gaussian", mean=0, st_dev=1),
        sampler("multirangeuniform", intervals=[[0, 1], [2, 3]]),
    ):
        values = chosen.sample(rng(), 5)
        assert len(set(values)) == 5
        np.testing.assert_array_equal(values, chosen.sample(rng(), 5))
        assert chosen.sample(rng(), 0).shape == (0,)


def test_a_number_is_a_constant_that_draws_nothing():
    generator = rng()
    np.testing.assert_array_equal(draw(VALUE.validate_python(3), generator, 4), [3.0] * 4)
    assert generator.random() == rng().random()
    np.testing.assert_array_equal(draw(uniform(0, 1), rng(), 4), uniform(0, 1).sample(rng(), 4))


def test_ranges_without_width_are_constants():
    np.testing.assert_array_equal(uniform(2, 2).sample(rng(), 3), [2.0] * 3)
    np.testing.assert_array_equal(sampler("gaussian", mean=2, st_dev=0).sample(rng(), 3), [2.0] * 3)


@pytest.mark.parametrize(
    "value",
    [
        3.5,
        uniform(0, 1),
        sampler("gaussian", mean=0, st_dev=1),
        sampler("multirangeuniform", intervals=[[0, 1], [2, 3]]),
    ],
)
def test_values_survive_a_dump(value):
    plain = VALUE.dump_python(value, mode="json")
    assert VALUE.validate_python(plain) == value
    assert VALUE.validate_json(json.dumps(plain), strict=True) == value


INF = float("inf")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (True, "a number or a sampler"),
        ("0.5", "a number or a sampler"),
        (None, "a number or a sampler"),
        ([0, 1], "a number or a sampler"),
        (INF, "finite"),
        ({"sampler_type": "normal", "sampler_parameters": {}}, "'gaussian'"),
        ({"sampler_parameters": {"min_value": 0, "max_value": 1}}, "sampler_type"),
        (("uniform", {"min_value": 2, "max_value": 1}), "min_value 2 .* max_value 1"),
        (("uniform", {"min_value": 0, "max_value": INF}), "finite"),
        (("uniform", {"min_value": -1.7e308, "max_value": 1.7e308}), "too wide"),
        (("uniform", {"min_value": 0}), "max_value"),
        (("uniform", {"min_value": 0, "max_value": 1, "mean": 2}), "mean"),
        (("gaussian", {"mean": 0, "st_dev": -1}), "st_dev"),
        (("multirangeuniform", {"intervals": []}), "at least 1"),
        (("multirangeuniform", {"intervals": [[0, 1], [3, 2]]}), r"\[3, 2\].*swap"),
        (("multirangeuniform", {"intervals": [[0, 1], [2, 2]]}), r"\[2, 2\].*no width"),
        (("multirangeuniform", {"intervals": [[0, 1, 2]]}), "at most 2"),
    ],
)
def test_unfit_values_are_refused(value, message):
    if isinstance(value, tuple):
        value = {"sampler_type": value[0], "sampler_parameters": value[1]}
    with pytest.raises(ValidationError, match=f"(?s){message}") as caught:
        VALUE.validate_python(value)
    # Only the member of the union that was meant is spoken of.
    assert len({error["loc"][:1] for error in caught.value.errors()}) == 1
