"""Policies of known success before the lessons of a real task: which they pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from envs.grasp.scene.sampler import heading
from envs.grasp.vector_env import GraspVectorEnv
from trainers.session import Session

GRASP = {
    "type": "grasp",
    "num_envs": 8,
    "workers": 0,
    "episode_steps": 4,
    "cameras": {"depth": {"type": "depth", "width": 36, "height": 36}},
}
# Sideways 100 mm in the first lesson, 5 mm less in each that follows; the other limits are wide.
LESSONS = {
    "type": "lessons",
    "measure": "success",
    "smoothing_episodes": 8,
    "min_lesson_length": 8,
    "count": 19,
    "thresholds": {"first": 0.6, "last": 0.9},
    "parameters": {"lateral_limit_m": {"first": 0.1, "last": 0.01}},
}
COLLECTION_STEPS, COLLECTIONS = 4, 30


def beside(env: GraspVectorEnv, offset_m: float) -> np.ndarray:
    """Actions that bring the cups so far beside the grasp points, 15 mm in front of them."""
    yaw = env.scenes.target_yaw_rad
    lateral = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros(len(yaw))], axis=1)
    tooltip = env.scenes.target_m - 0.015 * heading(yaw) + offset_m * lateral
    return env.action_for(tooltip, yaw)


@pytest.mark.parametrize(
    ("offset_m", "passed"),
    [
        (0.1025, 0),
        (0.0525, 10),  # lesson 10 allows 55 mm, lesson 11 allows 50
        (0.0025, 18),  # the last lesson never ends
    ],
)
def test_a_policy_passes_the_lessons_whose_threshold_it_is_over(
    make_session: Callable[..., Session], offset_m: float, passed: int
) -> None:
    session = make_session(
        GRASP, encoders={"depth": {"type": "paper", "size": 32}}, curriculum=LESSONS
    )
    env: Any = session.env_runner.env
    for _ in range(COLLECTIONS):
        for _ in range(COLLECTION_STEPS):
            session.env_runner.step(beside(env, offset_m))
        session.advance_curriculum(session.env_runner.pop_finished(), 0.0)
    assert session.lesson == passed
    session.close()
