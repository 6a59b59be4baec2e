"""Paths of joint angles: parabolas through knots."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.grasp.robot.paths import (
    duration_s,
    joined,
    leg_poses,
    leg_speeds,
    legs,
    path_poses,
    straight_leg,
)
from envs.grasp.robot.urdf import load_robot

angle = st.floats(-6.0, 6.0)


def test_a_leg_is_the_parabola_through_its_knots() -> None:
    # 3 t^2 - t + 2: 2, 2.25, 4; and the straight 1 + 2 t.
    leg = np.array([[2.0, 1.0], [2.25, 2.0], [4.0, 3.0]])
    poses = leg_poses(leg, np.array([0.0, 0.5, 1.0, 0.2]))
    np.testing.assert_allclose(poses[:, 0], [2.0, 2.25, 4.0, 1.92])
    np.testing.assert_allclose(poses[:, 1], [1.0, 2.0, 3.0, 1.4])
    np.testing.assert_allclose(leg_speeds(leg), [5.0, 2.0])  # 6 t - 1 at t = 1


@given(angle, angle, angle)
def test_no_joint_is_faster_than_its_bound(start: float, middle: float, end: float) -> None:
    leg = np.array([[start], [middle], [end]])
    poses = leg_poses(leg, np.linspace(0.0, 1.0, 201))
    fastest = np.abs(np.diff(poses[:, 0])).max() * 200
    assert fastest <= leg_speeds(leg)[0] + 1e-9
    assert fastest >= 0.98 * leg_speeds(leg)[0] - 1e-9


def test_poses_of_a_path_come_in_the_order_that_they_are_asked_for() -> None:
    path = np.array([[0.0], [0.5], [1.0], [2.0], [3.0]])  # legs of 1 and of 2
    part = np.array([1.0, 0.25, 0.75, 0.0, 0.5])
    np.testing.assert_allclose(path_poses(path, part)[:, 0], [3.0, 0.5, 2.0, 0.0, 1.0])


def test_paths_are_joined_at_their_ends() -> None:
    start, end = np.zeros((2, 6)), np.ones((2, 6))
    path = joined(straight_leg(start, end), straight_leg(end, start))
    np.testing.assert_array_equal(path[0, :, 0], [0.0, 0.5, 1.0, 0.5, 0.0])
    np.testing.assert_array_equal(legs(path[1])[:, :, 3], [[0.0, 0.5, 1.0], [1.0, 0.5, 0.0]])
    poses = path_poses(path[0], np.array([0.0, 0.25, 0.5, 0.75, 0.9, 1.0]))
    np.testing.assert_allclose(poses[:, 0], [0.0, 0.5, 1.0, 0.5, 0.2, 0.0], atol=1e-15)
    assert legs(path[0, :1]).shape == (0, 3, 6)


def test_paths_have_an_odd_number_of_knots() -> None:
    with pytest.raises(ValueError, match=r"2 k \+ 1 knots .* not the shape \(4, 6\)"):
        legs(np.zeros((4, 6)))


def test_slowest_joint_sets_the_duration_from_knot_to_knot() -> None:
    # 78 deg of A1 at 156 deg/s; A6 needs less for 123 deg at 615 deg/s; 66 deg of A5 at 330 deg/s
    turns = np.deg2rad([[-78, 0, 0, 0, 0, 123], [0, 0, 0, 0, 66, 0], [0, 0, 0, 0, 0, 0]])
    path = np.concatenate([np.zeros((1, 6)), np.cumsum(turns, axis=0)])
    robot = load_robot()
    assert duration_s(robot, path) == pytest.approx(0.7)
    np.testing.assert_allclose(
        duration_s(robot, np.stack([path, path[::-1], path[:1].repeat(4, 0)])), [0.7, 0.7, 0]
    )
