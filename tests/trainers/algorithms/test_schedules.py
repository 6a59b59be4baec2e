import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from trainers.algorithms.schedules import Schedule

TYPES = ["constant", "linear", "polynomial", "exponential"]


@pytest.mark.parametrize(
    ("schedule", "progress", "expected"),
    [
        ({"type": "constant"}, 0.7, 8.0),
        ({"type": "linear"}, 0.25, 6.0),
        ({"type": "linear"}, 1.0, 0.0),
        ({"type": "linear", "final_fraction": 0.5}, 0.25, 7.0),
        ({"type": "polynomial"}, 0.5, 2.0),
        ({"type": "polynomial", "power": 3}, 0.5, 1.0),
        ({"type": "polynomial", "power": 3, "final_fraction": 0.5}, 0.5, 4.5),
        ({"type": "exponential"}, 0.5, 0.8),
        ({"type": "exponential", "final_fraction": 0.25}, 0.5, 4.0),
        ({"type": "exponential", "final_fraction": 0.25}, 1.0, 2.0),
    ],
)
def test_values_by_hand(schedule, progress, expected):
    assert Schedule.model_validate(schedule).value(8.0, progress) == pytest.approx(expected)


@pytest.mark.parametrize("kind", TYPES)
def test_progress_is_clamped(kind):
    schedule = Schedule(type=kind)
    assert schedule.value(3e-4, -0.5) == schedule.value(3e-4, 0.0) == 3e-4
    assert schedule.value(3e-4, 1.5) == schedule.value(3e-4, 1.0)


schedules = st.one_of(
    st.builds(Schedule, type=st.just("constant")),
    st.builds(Schedule, type=st.just("linear"), final_fraction=st.floats(0, 1)),
    st.builds(
        Schedule,
        type=st.just("polynomial"),
        power=st.floats(0.1, 10),
        final_fraction=st.floats(0, 1),
    ),
    st.builds(Schedule, type=st.just("exponential"), final_fraction=st.floats(1e-6, 1)),
)


@given(schedules, st.floats(1e-6, 10), st.floats(0, 1), st.floats(0, 1))
def test_falls_from_the_initial_value_to_the_final_fraction(schedule, initial, one, other):
    earlier, later = sorted([one, other])
    fraction = 1.0 if schedule.type == "constant" else schedule.final_fraction
    assert schedule.value(initial, 0) == initial
    assert schedule.value(initial, 1) == pytest.approx(initial * fraction, rel=1e-12)
    assert schedule.value(initial, later) <= schedule.value(initial, earlier) * (1 + 1e-12)


@given(st.floats(0, 1), st.floats(0, 1))
def test_a_polynomial_of_power_one_is_linear(fraction, progress):
    polynomial = Schedule(type="polynomial", power=1, final_fraction=fraction)
    linear = Schedule(type="linear", final_fraction=fraction)
    assert polynomial.value(5.0, progress) == linear.value(5.0, progress)


class RunFile(BaseModel):
    learning_rate_schedule: Schedule = Schedule(type="linear")


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("kind", TYPES)
def test_a_name_alone_is_shorthand(kind, strict):
    assert Schedule.model_validate(kind, strict=strict) == Schedule(type=kind)
    run = RunFile.model_validate({"learning_rate_schedule": kind}, strict=strict)
    assert run.learning_rate_schedule == Schedule(type=kind)


@pytest.mark.parametrize("strict", [False, True])
@given(schedule=schedules)
def test_a_dump_validates_to_an_equal_model(strict, schedule):
    run = RunFile(learning_rate_schedule=schedule)
    for options in ({}, {"exclude_none": True}, {"exclude_unset": True}):
        assert RunFile.model_validate(run.model_dump(**options), strict=strict) == run
    assert RunFile.model_validate(json.loads(run.model_dump_json()), strict=strict) == run


def test_defaults_are_resolved():
    assert Schedule(type="constant").model_dump() == {
        "type": "constant",
        "power": None,
        "final_fraction": None,
    }
    assert Schedule(type="linear").final_fraction == 0
    assert Schedule(type="polynomial").power == 2
    assert Schedule(type="exponential").final_fraction == 0.01


@pytest.mark.parametrize(
    ("settings", "key", "hint"),
    [
        ({"type": "linear", "power": 2}, "power", "type linear has no power.*: polynomial"),
        ({"type": "exponential", "power": 2}, "power", "type exponential has no power"),
        ({"type": "constant", "final_fraction": 0.5}, "final_fraction", "has no final_fraction"),
        ({"type": "exponential", "final_fraction": 0}, "final_fraction", "never reaches 0"),
        ({"type": "linear", "final_fraction": 1.5}, "final_fraction", "less than or equal to 1"),
        ({"type": "linear", "final_fraction": -0.1}, "final_fraction", "greater than or equal"),
        ({"type": "linear", "final_fraction": math.nan}, "final_fraction", "Input should be"),
        ({"type": "polynomial", "power": 0}, "power", "greater than 0"),
        ({"type": "polynomial", "power": math.inf}, "power", "finite"),
        ({"type": "cosine", "power": 2}, "type", "'constant', 'linear'"),
        ("lineal", "type", "'constant', 'linear'"),
        ({"type": "linear", "final": 0.1}, "final", "not permitted"),
        ({}, "type", "required"),
    ],
)
def test_mistakes_are_refused_at_their_key(settings, key, hint):
    with pytest.raises(ValidationError, match=hint) as caught:
        Schedule.model_validate(settings)
    assert [error["loc"] for error in caught.value.errors()] == [(key,)]


def test_a_schedule_is_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        Schedule(type="linear").type = "constant"


def test_every_field_is_described():
    assert all(field.description for field in Schedule.model_fields.values())
