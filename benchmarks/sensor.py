"""How a simulated structured-light camera's frames compare with real ones.

    python -m benchmarks.sensor [FRAME.png] [--frames 32]

Frames of 640x480 pixels with the default faults, f = 585 px and a baseline of 75 mm, of scenes with
all that may stand around, are measured as a real frame is: a 16-bit PNG in millimetres, such as one
of your own camera. Then frames/s are compared with those of the Gaussian sensor.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.tables import table
from encoders.spaces import DepthImage
from envs.grasp.observations import observation_space, picture_seeds
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import SceneSampler
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.fast import FastSimulator
from trainers.common.command import tells_failures
from trainers.common.errors import UserError

Frame = NDArray[np.uint16]

STEPS_AT_M = (0.97, 1.2, 1.5)
PLANES_AT_M = (1.2, 1.45)
PATCH_PX = 24
NEAR_M = 0.03
# A patch with a pixel so far from its plane has an edge.
EDGE_MM = 30.0
MISSING = "missing pixels (%)"
NAMES = (
    MISSING,
    *(f"step at {depth_m} m (mm)" for depth_m in STEPS_AT_M),
    *(f"deviation from planes at {depth_m} m (mm)" for depth_m in PLANES_AT_M),
)
# Of one public frame (640x480, f = 585 px) of a Kinect-like camera, whose steps are those of a
# baseline of 75 mm: a desk at 1.0 to 1.5 m, with black things on it.
REAL = dict(zip(NAMES, (12.0, 2.71, 4.14, 6.50, 2.63, 3.18), strict=True))

RANGE_M = (0.4, 3.0)
# From over the robot's base, at about the distance of the real frame's desk.
VIEW: dict[str, Any] = {
    "type": "depth",
    "width": 640,
    "height": 480,
    "intrinsics": {"fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0},
    "position_m": (0.30, 0.0, 1.20),
    "target_m": (1.10, 0.0, 0.68),
    "range_m": RANGE_M,
}
SPEED_WORLDS, SPEED_ROUNDS = 256, 30


def measure(frame: Frame) -> dict[str, float]:
    """The figures of `NAMES` of a frame (H, W) in millimetres, NaN where it doesn't show them."""
    steps = [_step_mm(frame, depth_m) for depth_m in STEPS_AT_M]
    deviations = [_deviation_mm(frame, depth_m) for depth_m in PLANES_AT_M]
    values = (100.0 * float((frame == 0).mean()), *steps, *deviations)
    return dict(zip(NAMES, values, strict=True))


def _step_mm(frame: Frame, depth_m: float) -> float:
    """Mean distance of neighbouring levels about a depth, where none is left out."""
    levels = np.unique(frame).astype(float)
    steps = np.diff(levels[np.abs(levels / 1000.0 - depth_m) < NEAR_M])
    return float(steps[steps < 1.6 * np.median(steps)].mean()) if len(steps) else np.nan


def _deviation_mm(frame: Frame, depth_m: float) -> float:
    """RMS deviation from planes fitted to patches without edges about a depth: their median."""
    basis = np.indices((PATCH_PX, PATCH_PX)).reshape(2, -1).T.astype(float)
    basis, found = np.c_[basis, np.ones(len(basis))], []
    height, width = frame.shape
    for top in range(0, height - PATCH_PX + 1, PATCH_PX // 2):
        for left in range(0, width - PATCH_PX + 1, PATCH_PX // 2):
            patch = frame[top : top + PATCH_PX, left : left + PATCH_PX].ravel().astype(float)
            if patch.all() and abs(patch.mean() / 1000.0 - depth_m) < NEAR_M:
                rest = patch - basis @ np.linalg.lstsq(basis, patch, rcond=None)[0]
                if np.abs(rest).max() < EDGE_MM:
                    found.append(float(np.sqrt(np.mean(rest**2))))
    return float(np.median(found)) if found else np.nan


def simulated(frames: int) -> dict[str, float]:
    """Means of the figures over frames of as many scenes; of what is in range, what is missing."""
    sensor = {**VIEW, "sensor": "structured_light"}
    take, true_m = camera(sensor, frames, {"surroundings": {}})
    images, depths = take()[..., 0], true_m()
    found = [measure(image) for image in images]
    figures = {name: float(np.nanmean([each[name] for each in found])) for name in NAMES}
    in_range = (depths > RANGE_M[0]) & (depths < RANGE_M[1])
    return figures | {MISSING: 100.0 * float((images == 0)[in_range].mean())}


def camera(
    view: dict[str, Any], worlds: int, randomize: dict[str, Any]
) -> tuple[Callable[[], NDArray[np.uint16]], Callable[[], NDArray[np.float32]]]:
    """What takes depth images of as many scenes by a camera, and what renders their true depths."""
    settings = GraspSettings.model_validate({"cameras": {"depth": view}, "randomize": randomize})
    rng, everywhere = np.random.default_rng(0), np.arange(worlds)
    scenes, views = SceneSampler(settings).sample(rng, np.full(worlds, np.pi))
    robot, space = load_robot(), observation_space(settings)["depth"]
    assert isinstance(space, DepthImage)
    simulator = FastSimulator(worlds, robot, settings.support)
    simulator.load(everywhere, scenes, np.tile(robot.home_rad, (worlds, 1)))
    seeds = picture_seeds(rng, worlds)
    return (
        partial(simulator.render_depth, everywhere, views["depth"], space, seeds),
        partial(simulator.render, everywhere, views["depth"]),
    )


def frames_per_second(view: dict[str, Any]) -> dict[str, float]:
    """Frames per second of processor time by sensor, each at its best, measured in turn."""
    sensors = ("gaussian", "structured_light")
    takes = {name: camera({**view, "sensor": name}, SPEED_WORLDS, {})[0] for name in sensors}
    best = dict.fromkeys(sensors, np.inf)
    for _ in range(SPEED_ROUNDS):
        for name, take in takes.items():
            start_s = time.process_time()
            take()
            best[name] = min(best[name], time.process_time() - start_s)
    return {name: SPEED_WORLDS / spent_s for name, spent_s in best.items()}


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Measures and prints."""
    options = parse(arguments)
    own = {} if options.frame is None else {options.frame.name: measure(read(options.frame))}
    columns = {"simulated": simulated(options.frames), "a real one": REAL, **own}
    rows = [(name, *(f"{found[name]:.2f}" for found in columns.values())) for name in NAMES]
    Console().print(table("frames of 640x480", ("figure", *columns), rows))
    views = {"80x80": {"type": "depth"}, "640x480, every 6th": {**VIEW, "sampling": {"every": 6}}}
    speeds = {name: tuple(frames_per_second(view).values()) for name, view in views.items()}
    cells = [(name, f"{a:,.0f}", f"{b:,.0f}", f"{b / a:.0%}") for name, (a, b) in speeds.items()]
    head = ("frames per second of one core", "gaussian", "structured_light", "share")
    Console().print(table("speed", head, cells))
    return 0


def read(path: Path) -> Frame:
    """A frame from a file.

    Raises:
        UserError: it can't be read, or is no 16-bit PNG of one channel.
    """
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror}") from error
    frame = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if frame is not None and frame.dtype == np.uint16 and frame.ndim == 2:
        return frame.astype(np.uint16)
    found = "no image" if frame is None else f"{frame.dtype} of shape {frame.shape}"
    raise UserError(f"{path}: {found}; expected is a 16-bit PNG of depths in millimetres")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sensor",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("frame", type=Path, nargs="?", help="16-bit PNG of depths in millimetres")
    parser.add_argument("--frames", type=int, default=32, help="that are simulated")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    raise SystemExit(main())
