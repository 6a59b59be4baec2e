"""Harder tasks: one thing is harder in each, and the policy sees and does the same."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import BaseModel

from envs.grasp.harder import harder
from envs.grasp.sensors.structured_light import Gaussian, StructuredLight
from envs.grasp.settings import Camera, GraspSettings, Randomize, Surroundings
from envs.grasp.vector_env import GraspVectorEnv

DEPTH = Camera(type="depth", width=40, height=40, noise_sigma_m=0.003)
COLOR = Camera(type="rgb", width=24, height=24)
LIGHT = DEPTH.model_copy(update={"sensor": StructuredLight(strength=(0.0, 6.0))})
TASKS = {
    "gaussian": GraspSettings(cameras={"eye": DEPTH, "above": COLOR}),
    "structured light": GraspSettings(
        cameras={"eye": LIGHT}, randomize=Randomize(surroundings=Surroundings())
    ),
    "points": GraspSettings(cameras={"eye": DEPTH.model_copy(update={"type": "points"})}),
}


def changed(before: BaseModel, after: BaseModel, path: str = "") -> set[str]:
    """Paths of the settings that differ."""
    found: set[str] = set()
    for name, old in before:
        new = getattr(after, name)
        if isinstance(old, dict):
            for key in old:
                found |= changed(old[key], new[key], f"{path}{name}.{key}.")
        elif isinstance(old, BaseModel) and type(old) is type(new):
            found |= changed(old, new, f"{path}{name}.")
        elif old != new:
            found.add(f"{path}{name}")
    return found


@pytest.mark.parametrize("name", TASKS)
def test_they_are_tasks_of_the_same_observations(name: str) -> None:
    task = TASKS[name].model_copy(update={"num_envs": 3, "simulator": "fast"})
    ordinary = GraspVectorEnv(task, ())
    for what, settings in harder(task).items():
        # What was copied without being looked at is valid all the same.
        assert GraspSettings.model_validate(settings.model_dump(round_trip=True)), what
        env = GraspVectorEnv(settings, ())
        try:
            assert env.single_observation_space == ordinary.single_observation_space, what
            assert env.single_action_space == ordinary.single_action_space
            env.reset(seed=0)
            *_, infos = env.step(np.zeros((3, 4)))
            assert infos["episode_metrics"].keys() >= set(env.evaluator().answer_limits)
        finally:
            env.close()
    ordinary.close()


def test_one_thing_is_harder_in_each() -> None:
    task = TASKS["gaussian"]
    moved = {"randomize.camera_position_m", "randomize.camera_rotation_deg"}
    expected = {
        "twice the noise": {"cameras.eye.noise_sigma_m"},
        "four times the noise": {"cameras.eye.noise_sigma_m"},
        "pixels missing": {"cameras.eye.missing_fraction"},
        "another sensor": {"cameras.eye.sensor"},
        "cameras moved three times as far": moved,
        "cameras moved six times as far": moved,
        "larger blocks": {"randomize.block_size_m"},
        "other surroundings": {"randomize.surroundings"},
        "one block": {"blocks"},
        "more blocks": {"blocks"},
    }
    assert {what: changed(task, other) for what, other in harder(task).items()} == expected
    points = TASKS["points"]
    assert {what: changed(points, other) for what, other in harder(points).items()} == expected
    assert harder(task)["twice the noise"].cameras["eye"].noise_sigma_m == pytest.approx(0.006)


def test_what_is_as_hard_as_can_be_stays_so() -> None:
    found = harder(TASKS["structured light"].model_copy(update={"blocks": 6}))
    assert "more blocks" not in found
    sensor = found["four times the noise"].cameras["eye"].sensor
    assert isinstance(sensor, StructuredLight)
    assert sensor.strength == (1.0, 10.0)
    assert found["another sensor"].cameras["eye"].sensor == Gaussian()
    assert found["other surroundings"].randomize.surroundings is None
    only_colours = harder(GraspSettings(cameras={"above": COLOR}))
    assert not {"twice the noise", "pixels missing", "another sensor"} & only_colours.keys()
    fixed = Randomize(camera_position_m=0.0, camera_rotation_deg=0.0)
    moved = harder(GraspSettings(randomize=fixed))["cameras moved six times as far"].randomize
    assert (moved.camera_position_m, moved.camera_rotation_deg) == (0.06, 6.0)
