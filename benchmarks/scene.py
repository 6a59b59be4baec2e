"""Draws the picture of docs/grasp.md: `python -m benchmarks.scene docs/images/scene.png`."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from envs.grasp.env import make_vector_env
from envs.grasp.scene.sampler import heading
from trainers.reporting.images import picture

SEED = 3
GAP_M = 0.015
HEIGHT_PX = 480


def main(path: Path) -> None:
    """Renders one scene from outside, at the goal, beside what the depth camera saw before."""
    env = make_vector_env(1, render_mode="rgb_array", seed=SEED, workers=0)
    try:
        observations, _ = env.reset()
        scenes = env.scenes
        goal_m = scenes.target_m - GAP_M * heading(scenes.target_yaw_rad)
        env.step_without_reset(env.action_for(goal_m, scenes.target_yaw_rad))
        outside = (env.render() or ())[0]
        depth = picture(env.single_observation_space["depth"], observations["depth"][0])
    finally:
        env.close()
    seen = cv2.resize(depth, (HEIGHT_PX, HEIGHT_PX), interpolation=cv2.INTER_NEAREST)
    both = np.hstack([outside, seen])
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), cv2.cvtColor(both, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
