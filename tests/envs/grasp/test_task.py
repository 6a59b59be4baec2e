from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from envs.grasp.robot.arm import Tools
from envs.grasp.scene.sampler import Scenes
from envs.grasp.settings import Goal
from envs.grasp.simulators.base import Contacts
from envs.grasp.task import (
    EpisodeProgress,
    GoalRegion,
    Motion,
    advance,
    block_offset,
    judge,
    yaw_error,
)

# -- goal ------------------------------------------------------------------------------------------

REGION = GoalRegion.like(Goal(), 1)


@pytest.mark.parametrize(
    ("offset", "right"),
    [
        ((0.0, 0.0, 0.015), True),
        ((0.01, -0.01, 0.01), True),
        ((-0.01, 0.01, 0.02), True),
        ((0.0101, 0.0, 0.015), False),
        ((-0.0101, 0.0, 0.015), False),
        ((0.0, 0.0101, 0.015), False),
        ((0.0, -0.0101, 0.015), False),
        ((0.0, 0.0, 0.0099), False),
        ((0.0, 0.0, 0.0201), False),
        ((0.0, 0.0, -0.015), False),
    ],
)
def test_borders_of_the_goal_region(offset: tuple[float, ...], right: bool) -> None:
    assert REGION.position_is_right(np.array([offset])).tolist() == [right]


def test_every_environment_has_its_own_region() -> None:
    region = GoalRegion(
        lateral_limit_m=np.array([0.1, 0.01, 0.1, 0.1]),
        vertical_limit_m=np.array([0.1, 0.1, 0.01, 0.1]),
        gap_min_m=np.full(4, 0.01),
        gap_limit_m=np.array([0.12, 0.12, 0.12, 0.02]),
        yaw_limit_deg=np.full(4, 2.0),
    )
    offset = np.tile([0.05, 0.05, 0.05], (4, 1))
    assert region.position_is_right(offset).tolist() == [True, False, False, False]


def test_block_offset_hand_computed() -> None:
    # Tool and block at yaw 0: the face looks towards -x, seen from it lateral x is -y.
    square = block_offset(
        np.array([[0.9, 0.1, 0.75]]), np.array([[1.0, 0.0, 0.7]]), np.array([0.0])
    )
    np.testing.assert_allclose(square, [[-0.1, 0.05, 0.1]], atol=1e-12)
    # A block at yaw 30 deg: 0.2 in front along its normal -(cos 30, sin 30), 0.1 along its lateral
    # axis (sin 30, -cos 30), 0.05 below.
    cosine, sine = np.sqrt(3) / 2, 0.5
    tooltip = [1.0 - 0.2 * cosine + 0.1 * sine, 0.3 - 0.2 * sine - 0.1 * cosine, 0.65]
    turned = block_offset(np.array([tooltip]), np.array([[1.0, 0.3, 0.7]]), np.array([np.pi / 6]))
    np.testing.assert_allclose(turned, [[0.1, -0.05, 0.2]], atol=1e-12)


@pytest.mark.parametrize(
    ("yaw", "target", "error"),
    [
        (10, 4, 6),
        (4, 10, -6),
        (350, 10, -20),
        (10, 350, 20),
        (-170, 170, 20),
        (170, -170, -20),
        (725, 0, 5),
        (180, 0, -180),
    ],
)
def test_yaw_errors_wrap(yaw: float, target: float, error: float) -> None:
    value = yaw_error(np.radians([float(yaw)]), np.radians([float(target)]))
    np.testing.assert_allclose(np.degrees(value), [error], atol=1e-9)


# -- what is true after a motion -------------------------------------------------------------------


def tools(tooltip: np.ndarray, yaw: np.ndarray) -> Tools:
    axis = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], -1)
    return Tools(np.zeros((len(yaw), 3, 6)), tooltip, yaw, axis)


def test_judge_and_advance(box_scene: Callable[..., Scenes]) -> None:
    one: Scenes = box_scene([((1.0, 0.0), 0.0, (0.1, 0.2, 0.2))])  # grasp point (1, 0, 0.7)
    scenes = one[np.zeros(5, int)]
    yaw = np.radians([0.0, 1.99, -2.01, 0.0, 0.0])
    tooltip = np.tile([0.985, 0.0, 0.7], (5, 1))
    tooltip[3] = [0.985, 0.02, 0.7]  # beside
    tooltip[4] = [0.995, 0.0, 0.7]  # too near
    before = tools(np.tile([0.9, 0.0, 0.7], (5, 1)), np.zeros(5))
    contacts = Contacts(np.array([0, 0, 1, 0, 0], bool), np.array([0, 1, 0, 0, 0], bool))
    motion = Motion(before, tools(tooltip, yaw), np.arange(5.0), contacts)
    begun = EpisodeProgress.start(5)
    transition = judge(motion, scenes, GoalRegion.like(Goal(), 5), begun)
    assert transition.position_right.tolist() == [True, True, True, False, False]
    assert transition.rotation_right.tolist() == [True, True, False, False, False]
    assert transition.touched.tolist() == [False, False, True, False, False]
    assert transition.collided.tolist() == [False, True, False, False, False]
    np.testing.assert_allclose(transition.target_normal, np.tile([-1.0, 0, 0], (5, 1)), atol=1e-12)
    np.testing.assert_array_equal(transition.target_point_m, scenes.target_m)
    np.testing.assert_array_equal(transition.previous_tooltip_m, before.tooltip_m)
    np.testing.assert_array_equal(transition.tooltip_m, tooltip)
    np.testing.assert_array_equal(transition.duration_s, np.arange(5.0))
    np.testing.assert_allclose(transition.offset_m[3], [-0.02, 0.0, 0.015], atol=1e-12)
    np.testing.assert_allclose(np.degrees(transition.yaw_error_rad), [0, 1.99, -2.01, 0, 0])
    for name in ("touched_before", "position_right_before", "rotation_right_before"):
        assert not getattr(transition, name).any()

    progress = advance(begun, transition)
    assert progress.steps.tolist() == [1] * 5
    assert begun.steps.tolist() == [0] * 5
    nothing = Contacts(np.zeros(5, bool), np.zeros(5, bool))
    away = Motion(before, before, np.ones(5), nothing)
    later = judge(away, scenes, GoalRegion.like(Goal(), 5), progress)
    assert not later.position_right.any()
    np.testing.assert_array_equal(later.touched_before, transition.touched)
    np.testing.assert_array_equal(later.position_right_before, transition.position_right)
    np.testing.assert_array_equal(later.rotation_right_before, transition.rotation_right)
    progress = advance(progress, later)
    assert progress.steps.tolist() == [2] * 5
    np.testing.assert_array_equal(progress.collided, transition.collided)
    np.testing.assert_array_equal(progress.touched, transition.touched)


def test_a_lax_yaw_limit_is_obeyed_for_each(box_scene: Callable[..., Scenes]) -> None:
    one: Scenes = box_scene([((1.0, 0.0), 0.2, (0.1, 0.2, 0.2))])
    scenes = one[np.zeros(2, int)]
    normal = np.array([np.cos(0.2), np.sin(0.2), 0.0])
    tooltip = scenes.target_m - 0.015 * normal
    region = GoalRegion.like(Goal(), 2).with_arrays({"yaw_limit_deg": np.array([10.0, 2.0])})
    nothing = Contacts(np.zeros(2, bool), np.zeros(2, bool))
    turned = tools(tooltip, np.full(2, 0.2 + np.radians(8.0)))
    transition = judge(
        Motion(turned, turned, np.ones(2), nothing), scenes, region, EpisodeProgress.start(2)
    )
    assert transition.position_right.all()
    assert transition.rotation_right.tolist() == [True, False]
