"""Rewards of crafted transitions, worked out by hand, and properties that forbid farming."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from rewards.grasp.transition import GraspTransition
from rewards.plugin import ventosa_rewards
from rewards.reward import fits

REWARDS = {k: cls for k, cls in ventosa_rewards().items() if fits(cls, GraspTransition)}


def make(name, **settings):
    reward = REWARDS[name]
    return reward(reward.Settings(**settings))


def still(n=1):
    """N environments where nothing happens: the tool 1 m in front of a face that looks at it."""
    point = np.tile([1.0, 0.0, 0.5], (n, 1))
    no = np.zeros(n, dtype=bool)
    return GraspTransition(
        previous_tooltip_m=point - [1.0, 0.0, 0.0],
        tooltip_m=point - [1.0, 0.0, 0.0],
        tool_axis=np.tile([1.0, 0.0, 0.0], (n, 1)),
        duration_s=np.ones(n),
        target_point_m=point,
        target_normal=np.tile([-1.0, 0.0, 0.0], (n, 1)),
        offset_m=np.tile([0.0, 0.0, 1.0], (n, 1)),
        yaw_error_rad=np.zeros(n),
        touched=no,
        collided=no,
        position_right=no,
        rotation_right=no,
        touched_before=no,
        position_right_before=no,
        rotation_right_before=no,
    )


def moved(start, stop, target, duration_s=1.0):
    return replace(
        still(),
        previous_tooltip_m=np.array([start], dtype=float),
        tooltip_m=np.array([stop], dtype=float),
        target_point_m=np.array([target], dtype=float),
        duration_s=np.array([duration_s]),
    )


NOW_AND_BEFORE = [[False, True, False, True], [False, False, True, True]]


@pytest.mark.parametrize(
    ("name", "now", "before", "amount"),
    [
        ("touch", "touched", "touched_before", 0.1),
        ("position", "position_right", "position_right_before", 0.5),
        ("rotation", "rotation_right", "rotation_right_before", 0.5),
        ("sparse", "rotation_right", "rotation_right_before", 1.0),
    ],
)
def test_events_are_paid_the_first_time_alone(name, now, before, amount):
    flags = np.array(NOW_AND_BEFORE)
    transition = replace(still(4), **{now: flags[0], before: flags[1]})
    np.testing.assert_array_equal(make(name)(transition), [0.0, amount, 0.0, 0.0])
    np.testing.assert_array_equal(make(name, amount=7)(transition), [0.0, 7.0, 0.0, 0.0])


@pytest.mark.parametrize("name", ["touch", "position", "rotation", "sparse", "collision"])
def test_an_event_is_not_paid_for_another_one(name):
    own = {
        "touch": "touched",
        "position": "position_right",
        "rotation": "rotation_right",
        "sparse": "rotation_right",
        "collision": "collided",
    }
    others = set(own.values()) - {own[name]}
    transition = replace(still(3), **{other: np.ones(3, dtype=bool) for other in others})
    np.testing.assert_array_equal(make(name)(transition), np.zeros(3))


def test_collision_is_punished_at_every_step():
    transition = replace(still(2), collided=np.array([True, False]))
    for _ in range(2):
        np.testing.assert_array_equal(make("collision")(transition), [-0.1, 0.0])
    np.testing.assert_array_equal(make("collision", amount=-2)(transition), [-2.0, 0.0])


@pytest.mark.parametrize(
    ("stop", "expected"),
    [
        ([0.5, 0, 0], 0.03 * 0.5),  # half-way straight on
        ([-1, 0, 0], -0.03),  # straight away
        ([1.5, 0, 0], -0.03 * 1.5),  # overshot by half a metre, although 0.5 m nearer
        ([1, 0, 0], 0.0),  # exactly there: no direction, and not NaN
        ([0, 0, 0], 0.0),  # no motion
        ([1, 1, 0], -0.03),  # v = (1, 1, 0), n = (0, -1, 0)
        ([0.7, 0.4, 0], 0.03 * (0.7 * 0.6 - 0.4 * 0.8)),  # n = (0.3, -0.4, 0) / 0.5
    ],
)
def test_approach_by_hand(stop, expected):
    reward = make("approach")(moved([0, 0, 0], stop, [1, 0, 0]))
    assert reward.shape == (1,)
    assert reward[0] == pytest.approx(expected, abs=1e-15)


def test_approach_per_second_divides_by_the_duration():
    transition = moved([0, 0, 0], [0.5, 0, 0], [1, 0, 0], duration_s=0.25)
    assert make("approach", velocity="per_second", gain=1)(transition)[0] == pytest.approx(2.0)
    assert make("approach", gain=1)(transition)[0] == pytest.approx(0.5)


def test_approach_per_second_of_no_motion_in_no_time_is_zero():
    transition = moved([0, 0, 0], [0, 0, 0], [1, 0, 0], duration_s=0.0)
    np.testing.assert_array_equal(make("approach", velocity="per_second")(transition), [0.0])


def test_approach_treats_environments_apart():
    ahead = moved([0, 0, 0], [0.5, 0, 0], [1, 0, 0])
    there = moved([0, 0, 0], [1, 0, 0], [1, 0, 0])
    away = moved([0, 0, 0], [0, 0, -2], [0, 0, 3])
    both = replace(
        still(3),
        **{
            key: np.concatenate([getattr(one, key) for one in (ahead, there, away)])
            for key in ("previous_tooltip_m", "tooltip_m", "target_point_m")
        },
    )
    np.testing.assert_allclose(make("approach", gain=1)(both), [0.5, 0.0, -2.0])


points = arrays(np.float64, 3, elements=st.floats(-2, 2, width=32))


def walk(path, target):
    """Return the transitions of a tooltip that visits the points of a path in turn."""
    path = np.array(path)
    n = len(path) - 1
    return replace(
        still(n),
        previous_tooltip_m=path[:-1],
        tooltip_m=path[1:],
        target_point_m=np.tile(target, (n, 1)),
    )


@given(st.lists(points, min_size=2, max_size=8), points)
def test_approach_pays_at_most_the_distance_gained(path, target):
    paid = make("approach", gain=1)(walk(path, target))
    distance = np.linalg.norm(np.array(path) - target, axis=1)
    assert (paid <= distance[:-1] - distance[1:] + 1e-12).all()


@pytest.mark.parametrize("velocity", ["per_step", "per_second"])
@given(path=st.lists(points, min_size=2, max_size=8), target=points)
def test_no_closed_path_earns_by_approach(velocity, path, target):
    closed = [*path, path[0]]
    assert make("approach", gain=1, velocity=velocity)(walk(closed, target)).sum() <= 1e-12


@given(points, points)
def test_swinging_across_the_target_is_punished(target, swing):
    assume(np.linalg.norm(swing) > 1e-3)
    path = [target - swing, target + swing, target - swing]
    paid = make("approach", gain=1)(walk(path, target))
    np.testing.assert_allclose(paid, -2 * np.linalg.norm(swing), rtol=1e-6)


@pytest.mark.parametrize(
    ("axis", "expected"),
    [
        ([1, 0, 0], 0.01),  # looks at the face, whose normal is -x
        ([-1, 0, 0], -0.01),  # has its back to it
        ([0, 1, 0], 0.0),
        ([0.6, 0.8, 0], 0.006),
    ],
)
def test_facing_by_hand(axis, expected):
    transition = replace(still(), tool_axis=np.array([axis], dtype=float))
    assert make("facing")(transition)[0] == pytest.approx(expected)
    assert make("facing", gain=1)(transition)[0] == pytest.approx(100 * expected)


def test_every_reward_has_one_float_per_environment():
    for name, reward in REWARDS.items():
        value = reward(reward.Settings())(still(5))
        assert (name, value.shape, value.dtype) == (name, (5,), np.float64)


def test_single_precision_does_not_become_the_precision_of_the_reward():
    single = {
        key: value.astype(np.float32) if value.dtype == np.float64 else value
        for key, value in vars(still(2)).items()
    }
    for reward in REWARDS.values():
        assert reward(reward.Settings())(GraspTransition(**single)).dtype == np.float64


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("touch", {"amount": -0.1}),
        ("collision", {"amount": 0.1}),
        ("sparse", {"amount": float("inf")}),
        ("approach", {"gain": float("nan")}),
        ("approach", {"velocity": "per_minute"}),
        ("facing", {"amount": 1}),
    ],
)
def test_unfit_settings_are_refused(name, settings):
    with pytest.raises(ValidationError):
        make(name, **settings)


def test_settings_describe_every_field_and_survive_a_dump():
    for reward in REWARDS.values():
        settings = reward.Settings()
        assert all(field.description for field in reward.Settings.model_fields.values())
        assert reward.Settings.model_validate(settings.model_dump(mode="json")) == settings


def off_by(offset_m, yaw_deg):
    return replace(
        still(),
        offset_m=np.array([offset_m], dtype=float),
        yaw_error_rad=np.radians([yaw_deg]),
    )


@pytest.mark.parametrize(
    ("offset_m", "yaw_deg", "expected"),
    [
        ((0.0, 0.0, 0.015), 0.0, 0.0),
        ((0.005, 0.0, 0.015), 0.0, -0.1 * np.log(2) / 2),
        ((0.0, -0.005, 0.020), -1.0, -0.1 * 3 * np.log(2) / 2),
        ((0.0, 0.0, 0.015), 3.0, -0.1 * np.log(10) / 2),
    ],
)
def test_precision_by_hand(offset_m, yaw_deg, expected):
    (value,) = make("precision")(off_by(offset_m, yaw_deg))
    assert value == pytest.approx(expected)


@given(st.floats(0.1, 1.0), st.sampled_from([0, 1, 2]))
def test_halving_a_large_error_pays_the_same_however_large(error_m, axis):
    def pay(size_m):
        offset_m = np.array([0.0, 0.0, 0.015])
        offset_m[axis] += size_m
        return make("precision", position_scale_m=1e-4)(off_by(offset_m, 0.0))[0]

    assert pay(error_m / 2) - pay(error_m) == pytest.approx(0.1 * np.log(2), rel=1e-3)


def test_precision_knows_the_goal_it_is_told():
    reward = make("precision", gap_m=0.03, gain=1.0, yaw_scale_deg=2.0)
    assert reward(off_by((0.0, 0.0, 0.03), 2.0))[0] == pytest.approx(-np.log(2) / 2)
