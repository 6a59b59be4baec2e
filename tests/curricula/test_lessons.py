"""Walks through curricula with made-up episodes."""

import copy
import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from curricula.curriculum import FinishedEpisodes
from curricula.lessons import Lessons
from curricula.plugin import ventosa_curricula
from curricula.samplers import UniformSampler

GOAL = {"goal_m": {"first": 0.1, "last": 0.01}}


def compact(count=3, thresholds=(0.0, 1.0), **settings):
    ends = dict(zip(("first", "last"), thresholds, strict=True))
    return Lessons(
        Lessons.Settings(
            **{"count": count, "thresholds": ends, "parameters": GOAL, **settings},
        )
    )


def ended(rewards=(), successes=None, run_fraction=0.0):
    rewards = np.array(rewards, dtype=float)
    if successes is None:
        successes = np.zeros(len(rewards), dtype=bool)
    return FinishedEpisodes(rewards, np.array(successes, dtype=bool), run_fraction)


def test_a_lesson_ends_exactly_at_its_minimum_length():
    lessons = compact(min_lesson_length=5, smoothing_episodes=100)
    state = lessons.advance(lessons.initial_state(), ended([0.5] * 4))
    assert lessons.lesson(state) == 0
    assert lessons.lesson(lessons.advance(state, ended([0.5]))) == 1


def test_an_episode_under_the_threshold_starts_the_count_anew():
    lessons = compact(min_lesson_length=3, smoothing_episodes=1)
    state = lessons.initial_state()
    walk = []
    for reward in [1, 1, -1, 1, 1, 1]:
        state = lessons.advance(state, ended([reward]))
        walk.append(lessons.lesson(state))
    assert walk == [0, 0, 0, 0, 0, 1]


def test_the_mean_is_over_the_latest_episodes():
    lessons = compact(min_lesson_length=1, smoothing_episodes=2)
    # Means over the last two: -4, -2, 0 (not over 0), 0.5.
    state = lessons.advance(lessons.initial_state(), ended([-4, 0, 0]))
    assert (lessons.lesson(state), state["window"]) == (0, [0.0, 0.0])
    assert lessons.lesson(lessons.advance(state, ended([1.0]))) == 1
    # Over three it would be -1 there.
    long = compact(min_lesson_length=1, smoothing_episodes=4)
    state = long.advance(long.initial_state(), ended([-4, 0, 0, 1.0]))
    assert long.lesson(state) == 0


def test_being_on_the_threshold_is_not_being_over_it():
    lessons = compact(thresholds=(0.1, 0.8), min_lesson_length=1, smoothing_episodes=10)
    state = lessons.advance(lessons.initial_state(), ended([0.1] * 1000))
    assert lessons.lesson(state) == 0
    assert lessons.lesson(lessons.advance(state, ended([np.nextafter(0.1, 1)]))) == 1


def test_each_lesson_has_its_own_threshold_and_an_empty_window():
    lessons = compact(min_lesson_length=2, smoothing_episodes=10)
    state = lessons.advance(lessons.initial_state(), ended([50, 50]))
    assert state == {"lesson": 1, "window": [], "over": 0}
    # The great rewards of the first lesson don't count: 0.9 is under the second threshold, 1.
    state = lessons.advance(state, ended([0.9] * 10))
    assert (state["lesson"], state["over"]) == (1, 0)
    assert lessons.lesson(lessons.advance(state, ended([1.2] * 12))) == 2


def test_what_ends_in_the_same_call_after_a_lesson_counts_for_nothing():
    lessons = compact(count=4, min_lesson_length=3, smoothing_episodes=5)
    state = lessons.advance(lessons.initial_state(), ended([9] * 100))
    assert state == {"lesson": 1, "window": [], "over": 0}


def test_episodes_count_in_the_order_they_come():
    lessons = compact(min_lesson_length=2, smoothing_episodes=1)
    start = lessons.initial_state()
    assert lessons.lesson(lessons.advance(start, ended([-1, 1, 1, -1]))) == 1
    assert lessons.lesson(lessons.advance(start, ended([1, -1, 1, -1]))) == 0


def test_the_last_lesson_never_ends_and_remembers_nothing():
    lessons = compact(count=2, thresholds=(0, 0), min_lesson_length=1)
    state = lessons.advance(lessons.initial_state(), ended([1]))
    for _ in range(3):
        state = lessons.advance(state, ended([1e6] * 500, run_fraction=1.0))
    assert state == {"lesson": 1, "window": [], "over": 0}


def test_success_is_measured_apart_from_reward():
    lessons = compact(
        measure="success", thresholds=(0.5, 0.9), min_lesson_length=1, smoothing_episodes=4
    )
    start = lessons.initial_state()
    half = lessons.advance(start, ended([99] * 4, [False, False, True, True]))
    assert lessons.lesson(half) == 0
    assert lessons.lesson(lessons.advance(half, ended([-99], [True]))) == 1


def test_progress_walks_by_the_thresholds_alone():
    lessons = compact(count=5, measure="progress", thresholds=(0.2, 0.8))  # 0.2 0.4 0.6 0.8
    state = lessons.initial_state()
    walk = []
    for run_fraction in (0.0, 0.2, 0.21, 0.7, 0.3, 0.81, 1.0):
        state = lessons.advance(state, ended([1000] * 200, run_fraction=run_fraction))
        walk.append(lessons.lesson(state))
    assert walk == [0, 0, 1, 3, 3, 4, 4]


def test_no_episodes_change_nothing():
    lessons = compact(min_lesson_length=3)
    state = lessons.advance(lessons.initial_state(), ended([1, 1]))
    assert lessons.advance(state, ended()) == state


rewards = st.lists(st.floats(-3, 3), max_size=60)


def split(values, cuts):
    edges = [0, *sorted(min(cut, len(values)) for cut in cuts), len(values)]
    return [values[a:b] for a, b in pairwise(edges)]


@given(rewards, st.lists(st.integers(0, 60), max_size=5), st.integers(1, 4), st.integers(1, 6))
def test_a_state_read_back_from_json_goes_on_identically(values, cuts, smoothing, length):
    lessons = compact(count=8, smoothing_episodes=smoothing, min_lesson_length=length)
    state = restored = lessons.initial_state()
    for part in split(values, cuts):
        before = copy.deepcopy(state)
        state, old = lessons.advance(state, ended(part)), state
        assert old == before  # the state that goes in is left alone
        restored = json.loads(json.dumps(restored))
        restored = compact(count=8, smoothing_episodes=smoothing, min_lesson_length=length).advance(
            restored, ended(part)
        )
        assert restored == state
        assert len(state["window"]) <= smoothing


@given(rewards, st.integers(1, 5), st.integers(1, 6))
def test_walk_agrees_with_a_naive_one(values, smoothing, length):
    lessons = compact(
        count=6, thresholds=(-1, 1), smoothing_episodes=smoothing, min_lesson_length=length
    )
    thresholds = [-1, -0.5, 0, 0.5, 1]
    values = [round(value * 8) / 8 for value in values]  # exact sums
    index, of_lesson = 0, []
    state = lessons.initial_state()
    for value in values:
        state = lessons.advance(state, ended([value]))
        if index < 5:
            of_lesson.append(value)
            means = [
                np.mean(of_lesson[max(0, end - smoothing) : end])
                for end in range(1, len(of_lesson) + 1)
            ]
            latest = means[-length:]
            if len(latest) == length and min(latest) > thresholds[index]:
                index, of_lesson = index + 1, []
        assert lessons.lesson(state) == index


def test_where_a_call_ends_makes_no_difference():
    values = np.random.default_rng(1).normal(0.0, 1.0, 400)
    lessons = compact(thresholds=(0.9, 0.9), smoothing_episodes=30, min_lesson_length=5)
    together = lessons.advance(lessons.initial_state(), ended(values))
    one_by_one = lessons.initial_state()
    for value in values:
        one_by_one = lessons.advance(one_by_one, ended([value]))
    assert together == one_by_one
    assert together["window"] == values[-30:].tolist()


def test_parameters_of_the_compact_form():
    lessons = compact(
        count=3,
        min_lesson_length=1,
        parameters={**GOAL, "yaw_deg": {"first": 8, "last": 2, "interpolation": "exponential"}},
    )
    state, seen = lessons.initial_state(), []
    for _ in range(3):
        seen.append((lessons.lesson_name(state), lessons.parameters(state)))
        state = lessons.advance(state, ended([5]))
    assert [name for name, _ in seen] == [None, None, None]
    assert [row["goal_m"] for _, row in seen] == pytest.approx([0.1, 0.055, 0.01])
    assert [row["yaw_deg"] for _, row in seen] == pytest.approx([8, 4, 2])


def test_the_paper_has_18_thresholds_for_19_lessons():
    lessons = compact(count=19, thresholds=(-0.1, 0.75), min_lesson_length=1)
    assert lessons.lesson_count == 19
    state = lessons.initial_state()
    for index in range(18):
        threshold = -0.1 + 0.05 * index
        assert lessons.lesson(lessons.advance(state, ended([threshold - 1e-9]))) == index
        state = lessons.advance(state, ended([threshold + 1e-9]))
        assert lessons.lesson(state) == index + 1


def test_a_single_lesson_is_the_last_one():
    lessons = Lessons(Lessons.Settings(count=1, parameters=GOAL))
    assert lessons.parameters(lessons.initial_state()) == {"goal_m": 0.01}
    state = lessons.advance(lessons.initial_state(), ended([1e9] * 1000, run_fraction=1.0))
    assert lessons.lesson(state) == 0


YAW = {"sampler_type": "uniform", "sampler_parameters": {"min_value": -5, "max_value": 5}}
LISTED = [
    {"name": "wide", "threshold": -0.1, "parameters": {"goal_m": 0.1, "yaw_deg": 0}},
    {"threshold": 0.5, "parameters": {"yaw_deg": YAW}},
    {"name": "narrow", "parameters": {"goal_m": 0.01}},
]


def test_listed_lessons_inherit_what_they_leave_out():
    lessons = Lessons(Lessons.Settings(lessons=LISTED, min_lesson_length=1))
    yaw = UniformSampler.model_validate(YAW)
    state, seen = lessons.initial_state(), []
    for _ in range(3):
        seen.append((lessons.lesson_name(state), lessons.parameters(state)))
        state = lessons.advance(state, ended([0.6]))
    assert seen == [
        ("wide", {"goal_m": 0.1, "yaw_deg": 0.0}),
        (None, {"goal_m": 0.1, "yaw_deg": yaw}),
        ("narrow", {"goal_m": 0.01, "yaw_deg": yaw}),
    ]


def test_parameters_handed_out_are_the_callers_own():
    lessons = Lessons(Lessons.Settings(lessons=LISTED))
    lessons.parameters(lessons.initial_state())["goal_m"] = 99.0
    assert lessons.parameters(lessons.initial_state())["goal_m"] == 0.1


@pytest.mark.parametrize(
    "settings",
    [
        {"lessons": LISTED, "measure": "reward"},
        {"count": 1, "parameters": GOAL},
        {
            "count": 19,
            "measure": "success",
            "thresholds": {"first": 0.1, "last": 0.7, "interpolation": "power", "power": 2},
            "parameters": GOAL,
        },
    ],
)
def test_settings_survive_a_dump(settings):
    settings = Lessons.Settings(**settings)
    plain = settings.model_dump(mode="json")
    assert Lessons.Settings.model_validate(plain) == settings
    assert Lessons.Settings.model_validate_json(json.dumps(plain), strict=True) == settings


COMPACT = {"count": 3, "thresholds": {"first": 0.1, "last": 0.8}, "parameters": GOAL}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "there are no lessons"),
        ({**COMPACT, "count": None}, "there are no lessons"),
        ({**COMPACT, "thresholds": None}, "3 lessons need thresholds"),
        ({**COMPACT, "parameters": None}, "3 lessons without 'parameters'"),
        ({**COMPACT, "parameters": {}}, "at least 1"),
        ({**COMPACT, "count": 0}, "greater than or equal to 1"),
        ({**COMPACT, "smoothing_episodes": 0}, "greater than or equal to 1"),
        ({**COMPACT, "min_lesson_length": 0}, "greater than or equal to 1"),
        ({**COMPACT, "lessons": LISTED}, "'count', 'thresholds', 'parameters' are both given"),
        ({"count": 3, "lessons": LISTED}, "'lessons' and 'count' are both given"),
        ({"lessons": []}, "at least 1"),
        ({"lessons": LISTED[:2]}, "threshold 0.5, but never ends"),
        ({"lessons": [LISTED[2], LISTED[2]]}, "lesson 1 of 2 has no threshold"),
        ({"lessons": [{"threshold": 0.1}, {}]}, "all the same"),
        ({"lessons": [{**LISTED[0], "parameters": {}}, LISTED[2]]}, "lesson 2 sets 'goal_m'"),
        (
            {**COMPACT, "thresholds": {"first": -0.1, "last": 1, "interpolation": "exponential"}},
            "neither be zero",
        ),
        (
            {**COMPACT, "measure": "progress", "thresholds": {"first": 0.6, "last": 0.3}},
            "0.3 follows 0.6",
        ),
        (
            {**COMPACT, "measure": "progress", "thresholds": {"first": 0.5, "last": 0.5}},
            "must rise",
        ),
        (
            {**COMPACT, "measure": "progress", "thresholds": {"first": -0.1, "last": 0.5}},
            "progress threshold -0.1",
        ),
        (
            {**COMPACT, "measure": "progress", "thresholds": {"first": 0.5, "last": 1.5}},
            "progress threshold 1.5",
        ),
        (
            {**COMPACT, "measure": "success", "thresholds": {"first": 0.5, "last": 1.0}},
            "success threshold 1 ",
        ),
        ({**COMPACT, "measure": "loss"}, "reward"),
        ({**COMPACT, "treshold": 1}, "treshold"),
    ],
)
def test_unfit_settings_are_refused(settings, message):
    with pytest.raises(ValidationError, match=message):
        Lessons.Settings(**settings)


def test_a_state_of_another_curriculum_is_refused():
    state = {"lesson": 3, "window": [], "over": 0}
    with pytest.raises(ValueError, match="index 3, but this curriculum has 3 lessons"):
        compact().advance(state, ended([1]))


@pytest.mark.parametrize(
    ("values", "successes", "message"),
    [
        ([1.0, 2.0], [True], "one value per episode"),
        ([[1.0]], [[True]], "one value per episode"),
        ([np.nan], [True], "not a finite number"),
    ],
)
def test_malformed_episodes_are_refused(values, successes, message):
    with pytest.raises(ValueError, match=message):
        ended(values, successes)


def test_it_is_registered_and_every_setting_is_described():
    assert ventosa_curricula() == {"lessons": Lessons}
    assert all(field.description for field in Lessons.Settings.model_fields.values())
