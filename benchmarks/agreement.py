"""Whether the fast simulator shows and feels what PyBullet does: `python -m benchmarks.agreement`.

Random scenes, the robot at random poses of its workspace, one picture of each by both simulators;
then random motions, and what they touch. Where the contacts differ, PyBullet is asked again with
all boxes a millimetre larger or smaller, which tells whether the shapes were about to touch.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.tables import table
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.urdf import Robot, load_robot
from envs.grasp.scene.sampler import Scenes, SceneSampler
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.settings import Camera, GraspSettings, Randomize, Support, Surroundings
from envs.grasp.simulators.base import Contacts, Simulator
from envs.grasp.simulators.fast import FastSimulator
from envs.grasp.simulators.pybullet import PyBulletSimulator

DEPTH_TOLERANCE_M = 0.001
COLOR_TOLERANCE = 2
# A surface that leaves the plane through its neighbours by so much has an edge there.
EDGE_M = 0.005
# Growing every half extent by this moves no corner by more than a millimetre.
NEARLY_TOUCHING_M = 0.001 / np.sqrt(3.0)
FIGURES = {
    "all_pixels": (f"pixels within {1000 * DEPTH_TOLERANCE_M:g} mm of depth", None),
    "depth": (f"pixels off edges within {1000 * DEPTH_TOLERANCE_M:g} mm of depth", 0.99),
    "color": (f"pixels off edges within {COLOR_TOLERANCE} of 255 levels of color", None),
    "contacts": ("motions with the same contacts", 0.995),
    "contacts_or_near": ("the same, or with shapes within 1 mm of it", 1.0),
}
"""What each figure of `Agreement` is, and how much of it there must be."""

ROBOT = load_robot()
RESOLUTION_M = GraspSettings().contact_resolution_m

Images = NDArray[Any]
Flags = NDArray[np.bool_]
MakeSimulator = Callable[[int, Robot, Support], Simulator]


@dataclass(frozen=True)
class Agreement:
    """What was found: shares of the pixels and of the motions.

    `FIGURES` says what most are; `off_edges` is the share of the pixels that lie off edges, and
    `touched` and `collided` are shares of the motions, by PyBullet.
    """

    scenes: int
    motions: int
    off_edges: float
    all_pixels: float
    depth: float
    color: float
    contacts: float
    contacts_or_near: float
    touched: float
    collided: float


class Sample:
    """Random scenes, and random poses and motions of the robots before them.

    Args:
        scenes: how many.
        size: width and height of the pictures.
        seed: of everything random.
        surroundings: what stands around; None: nothing.
    """

    def __init__(
        self,
        scenes: int,
        size: tuple[int, int],
        seed: int = 0,
        surroundings: Surroundings | None = None,
    ):
        width, height = size
        self.rng = np.random.default_rng(seed)
        cameras = {kind: Camera(type=kind, width=width, height=height) for kind in ("depth", "rgb")}
        settings = GraspSettings(cameras=cameras, randomize=Randomize(surroundings=surroundings))
        limits = np.full(scenes, np.pi)
        self.scenes, self.views = SceneSampler(settings).sample(self.rng, limits)
        self.everywhere = np.arange(scenes)
        self._arm = Arm.of(settings, ROBOT)
        self.start = self._arm.home(scenes)
        self._advance()  # the home pose is out of the camera's sight

    def _advance(self) -> NDArray[np.float64]:
        """Goes on to random poses of the workspace; returns the joint paths there."""
        actions = self.rng.uniform(-1.0, 1.0, (len(self.scenes), 4))
        self.start, path, _ = self._arm.reach(self.start, *self._arm.pose(actions))
        return path

    def paths(self, rounds: int) -> list[NDArray[np.float64]]:
        """Joint paths (n, 2 k + 1, 6) of so many motions one after the other."""
        return [self._advance() for _ in range(rounds)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Compares, prints a table, and writes JSON where asked; 1 if they agree too little."""
    options = parse(arguments)
    surroundings = Surroundings() if options.surroundings else None
    found, _ = compare(
        options.scenes, options.motions, tuple(options.size), options.seed, surroundings
    )
    if options.json is not None:
        options.json.write_text(json.dumps(asdict(found), indent=2) + "\n")
    Console().print(shown(found))
    met = [getattr(found, name) >= (least or 0.0) for name, (_, least) in FIGURES.items()]
    return 0 if all(met) else 1


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.agreement", description=__doc__)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--motions", type=int, default=20, help="of each scene")
    parser.add_argument("--size", type=int, nargs=2, default=[80, 80], metavar=("W", "H"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--surroundings", action="store_true", help="with all that can stand around the blocks"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here, too")
    return parser.parse_args(arguments)


def compare(
    scenes: int,
    motions: int,
    size: tuple[int, int],
    seed: int = 0,
    surroundings: Surroundings | None = None,
) -> tuple[Agreement, tuple[Images, Images]]:
    """Compares the simulators.

    Args:
        scenes: how many.
        motions: of each scene.
        size: width and height of the pictures.
        seed: of everything random.
        surroundings: what stands around in the scenes; None: nothing.

    Returns:
        What was found, and the depths (n, H, W) in metres by PyBullet and by the fast simulator.
    """
    sample = Sample(scenes, size, seed, surroundings)
    exact, fast = (
        photographs(simulator, sample) for simulator in (PyBulletSimulator, FastSimulator)
    )
    compared = off_edges(exact[0]) & off_edges(fast[0])
    close = difference(exact[0], fast[0]) <= DEPTH_TOLERANCE_M
    color = np.abs(exact[1].astype(int) - fast[1]).max(axis=-1) <= COLOR_TOLERANCE
    paths = sample.paths(motions)
    flags, near = compare_contacts(sample, paths)
    agree = (flags[0] == flags[1]).all(axis=1)
    found = Agreement(
        scenes=scenes,
        motions=len(agree),
        off_edges=float(compared.mean()),
        all_pixels=float(close.mean()),
        depth=float(close[compared].mean()),
        color=float(color[compared].mean()),
        contacts=float(agree.mean()),
        contacts_or_near=float((agree | near).mean()),
        touched=float(flags[0][:, 0].mean()),
        collided=float(flags[0][:, 1].mean()),
    )
    return found, (exact[0], fast[0])


def photographs(make: MakeSimulator, sample: Sample) -> tuple[Images, Images]:
    """Depth (n, H, W) and color (n, H, W, 3) of the scenes, with the robots in view."""
    simulator = make(len(sample.scenes), ROBOT, Support())
    try:
        simulator.load(sample.everywhere, sample.scenes, sample.start.joints_rad)
        depth = simulator.render(sample.everywhere, sample.views["depth"])
        # Where the depth camera stands, so that their pixels show the same.
        views = CameraPoses(sample.views["rgb"].camera, **sample.views["depth"].arrays())
        return depth, simulator.render(sample.everywhere, views)
    finally:
        simulator.close()


def off_edges(depth: Images) -> Flags:
    """Pixels (n, H, W) that lie, with their neighbours, on one smooth surface.

    On a plane, the inverse depth is an affine function of the pixel, and its second differences
    vanish; where they don't, there is an edge. The picture's border is compared as it is.
    """
    inverse = np.where(np.isfinite(depth), 1.0 / depth, 0.0)
    padded = np.pad(inverse, ((0, 0), (1, 1), (1, 1)), mode="reflect", reflect_type="odd")
    height, width = depth.shape[1:]
    edge = np.zeros(depth.shape, bool)
    for rows, columns in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead, behind = (
            padded[:, 1 + s * rows :, 1 + s * columns :][:, :height, :width] for s in (1, -1)
        )
        bend = np.abs(ahead + behind - 2.0 * inverse)
        edge |= bend > EDGE_M * np.maximum(inverse, np.maximum(ahead, behind)) ** 2
    return ~edge


def difference(first: Images, second: Images) -> Images:
    """Absolute differences of depths in metres; none where both see nothing."""
    both_nothing = np.isinf(first) & np.isinf(second)
    return np.abs(np.where(both_nothing, 0.0, first) - np.where(both_nothing, 0.0, second))


def compare_contacts(
    sample: Sample, paths: list[NDArray[np.float64]]
) -> tuple[tuple[Flags, Flags], Flags]:
    """What the motions touch.

    Returns:
        By PyBullet and by the fast simulator, whether motions touched and collided (m, 2); and
        whether those that differ were about to do as the other says (m,).
    """
    exact, fast = (
        contacts(simulator, sample, paths, 0.0) for simulator in (PyBulletSimulator, FastSimulator)
    )
    larger = contacts(PyBulletSimulator, sample, paths, NEARLY_TOUCHING_M)
    smaller = contacts(PyBulletSimulator, sample, paths, -NEARLY_TOUCHING_M)
    near = (smaller <= fast) & (fast <= larger)
    return (exact, fast), np.asarray(near.all(axis=1))


def contacts(
    make: MakeSimulator,
    sample: Sample,
    paths: list[NDArray[np.float64]],
    grow_m: float,
    resolution_m: float = RESOLUTION_M,
) -> Flags:
    """Whether motions touched and collided (m, 2), with all boxes grown by `grow_m`."""
    support = Support()
    support = Support(
        x_m=(support.x_m[0] - grow_m, support.x_m[1] + grow_m),
        y_m=(support.y_m[0] - grow_m, support.y_m[1] + grow_m),
        top_m=support.top_m + grow_m,
        thickness_m=support.thickness_m + 2.0 * grow_m,
    )
    simulator = make(len(sample.scenes), ROBOT, support)
    try:
        simulator.load(sample.everywhere, grown(sample.scenes, grow_m), paths[0][:, 0])
        found: list[Contacts] = [
            simulator.move(sample.everywhere, path, resolution_m) for path in paths
        ]
    finally:
        simulator.close()
    return np.concatenate([np.stack([c.touched, c.collided], axis=1) for c in found])


def grown(scenes: Scenes, grow_m: float) -> Scenes:
    """The same scenes with larger boxes."""
    return scenes.with_arrays(
        {
            name: np.where(half > 0.0, half + grow_m, 0.0)
            for name, half in scenes.arrays().items()
            if name in ("box_half_m", "around_half_m")
        }
    )


def shown(found: Agreement) -> Table:
    """The figures for people."""
    rows = [
        (what, f"{getattr(found, name):.3%}", "" if least is None else f"{least:.1%}")
        for name, (what, least) in FIGURES.items()
    ]
    return table(
        f"fast against pybullet: {found.scenes} scenes, {found.motions} motions",
        ("", "agree", "at least"),
        rows,
        f"{found.off_edges:.0%} of the pixels are off edges; "
        f"{found.touched:.0%} of the motions touch, {found.collided:.0%} collide",
    )


if __name__ == "__main__":
    raise SystemExit(main())
