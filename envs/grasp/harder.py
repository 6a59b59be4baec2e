"""Grasp tasks that are harder than a given one, with the same observations and actions.

Policies are not trained for them. From them they can learn when to be unsure.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from envs.grasp.sensors.structured_light import MAX_STRENGTH, Gaussian, StructuredLight
from envs.grasp.settings import MAX_NOISE_SIGMA_M, Camera, GraspSettings, Surroundings

MISSING = (0.0, 0.4)
LEAST_NOISE_M = 0.002
LEAST_MOVED_M, MOST_MOVED_M = 0.01, 0.5
LEAST_TURNED_DEG, MOST_TURNED_DEG = 1.0, 45.0
LARGER = 1.4
MOST_BLOCKS = 6


def harder(settings: GraspSettings) -> dict[str, GraspSettings]:
    """Settings of tasks that are each harder in one respect, by what that is."""
    randomize = settings.randomize
    smallest_m, largest_m = randomize.block_size_m
    larger_m = ((smallest_m + largest_m) / 2.0, LARGER * largest_m)
    around = Surroundings() if randomize.surroundings is None else None
    more = min(settings.blocks + 2, MOST_BLOCKS)
    changed = {
        "twice the noise": _cameras(settings, partial(_noisier, factor=2.0)),
        "four times the noise": _cameras(settings, partial(_noisier, factor=4.0)),
        "pixels missing": _cameras(settings, _missing),
        "another sensor": _cameras(settings, _another_sensor),
        "cameras moved three times as far": _randomize(settings, **_moved(settings, 3.0)),
        "cameras moved six times as far": _randomize(settings, **_moved(settings, 6.0)),
        "larger blocks": _randomize(settings, block_size_m=larger_m),
        "other surroundings": _randomize(settings, surroundings=around),
        "one block": settings.model_copy(update={"blocks": 1}),
        "more blocks": settings.model_copy(update={"blocks": more}),
    }
    return {name: task for name, task in changed.items() if task != settings}


def _cameras(settings: GraspSettings, changed: Callable[[Camera], dict[str, Any]]) -> GraspSettings:
    """The same with something changed of the cameras that measure depth."""
    cameras = {
        name: camera.model_copy(update=changed(camera)) if camera.type != "rgb" else camera
        for name, camera in settings.cameras.items()
    }
    return settings.model_copy(update={"cameras": cameras})


def _randomize(settings: GraspSettings, **changed: Any) -> GraspSettings:
    randomize = settings.randomize.model_copy(update=changed)
    return settings.model_copy(update={"randomize": randomize})


def _noisier(camera: Camera, factor: float) -> dict[str, Any]:
    if isinstance(camera.sensor, StructuredLight):
        low, high = camera.sensor.strength
        strength = (max(low, 1.0), min(factor * max(high, 1.0), MAX_STRENGTH))
        return {"sensor": camera.sensor.model_copy(update={"strength": strength})}
    sigma_m = factor * max(camera.noise_sigma_m, LEAST_NOISE_M)
    return {"noise_sigma_m": min(sigma_m, MAX_NOISE_SIGMA_M)}


def _missing(camera: Camera) -> dict[str, Any]:
    return {"missing_fraction": MISSING}


def _another_sensor(camera: Camera) -> dict[str, Any]:
    is_gaussian = isinstance(camera.sensor, Gaussian)
    return {"sensor": StructuredLight() if is_gaussian else Gaussian()}


def _moved(settings: GraspSettings, factor: float) -> dict[str, Any]:
    position_m = factor * max(settings.randomize.camera_position_m, LEAST_MOVED_M)
    rotation_deg = factor * max(settings.randomize.camera_rotation_deg, LEAST_TURNED_DEG)
    return {
        "camera_position_m": min(position_m, MOST_MOVED_M),
        "camera_rotation_deg": min(rotation_deg, MOST_TURNED_DEG),
    }
