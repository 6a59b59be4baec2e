"""The pieces that time goes to: what each does, and the arithmetic and memory that it takes.

Operations are of 32 bits, a fused multiplication and addition counting as two. Those of the
simulator are counted off its loops and are the least that it could do: a picture of one surface,
for instance, without finding out where each box and cylinder is. Those of the networks are torch's
own count. Bytes are what is read and written where caches hold nothing from one loop, or from one
operation of torch, to the next.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.agreement import ROBOT
from benchmarks.speed.figures import FAST, MODES
from benchmarks.speed.runs import CPU, RUN_FILES
from benchmarks.speed.runs import load as load_file
from benchmarks.speed.simulation import Worlds
from benchmarks.speed.training import Ventosa, load
from envs.grasp.robot.arm import Arm
from envs.grasp.scene.sampler import SceneSampler
from envs.grasp.settings import Camera, GraspSettings
from trainers.algorithms.off_policy import OffPolicySettings
from trainers.runfile.settings import RunSettings

COUNT = 256
"""Worlds, scenes and motions at a time."""
PPO_ENVS = 64
SIZES = (80, 256)

# Operations of a pixel. Drawing: it is cleared, and covered by one face. The sensor: one over it,
# the noise added, rounded to a code within the range. Normal numbers: Threefry's 13 rounds, a
# logarithm, a root, a sine and a cosine for two. Structured light: random bits, averages over two
# kinds of windows, shadows, slopes, edges. Color: the face's, and three bytes of it.
DRAWN, SENSED, NORMAL, MATCHED, COLORED = 7, 13, 55, 150, 7
CODE_BYTES, COLOR_BYTES = 2, 3
CAMERAS: dict[str, tuple[dict[str, Any], int, int]] = {
    "depth, no noise": ({"noise_sigma_m": 0.0}, DRAWN + SENSED, CODE_BYTES),
    "depth, gaussian": ({"noise_sigma_m": 0.002}, DRAWN + SENSED + NORMAL, CODE_BYTES),
    "depth, structured light": (
        {"sensor": {"type": "structured_light"}},
        DRAWN + MATCHED,
        CODE_BYTES,
    ),
    "color": ({"type": "rgb"}, DRAWN + COLORED, COLOR_BYTES),
}
"""Settings of the cameras, and the operations and bytes of a pixel."""

# Looks at a motion, counted over 5,120 random ones; a look is at the frames and velocities of 10
# links, at 15 shapes before all that is near, and at the boxes that may be in the way.
CONTACT_OPERATIONS = 18 * 4_000
# Random numbers drawn until a scene obeys the rules, counted over 1,280.
SCENE_OPERATIONS = 200 * 60
# Three poses of the tool and their limits, of 13 lengths and angles each, by series of some 20.
MOTION_OPERATIONS = 3 * 13 * 30
BOX_BYTES, BOXES, KNOT_BYTES, KNOTS = 128, 10, 48, 9


@dataclass(frozen=True)
class Work:
    """A piece, ready to be measured.

    Attributes:
        do: does it once; returns the number of items.
        operations: of an item.
        bytes: of an item.
        prepare: comes before each time, and does not count.
        close: ends it.
    """

    do: Callable[[], int]
    operations: float
    bytes: float
    prepare: Callable[[], None] = lambda: None
    close: Callable[[], object] = lambda: None


Pieces = dict[tuple[str, str], Callable[[], Work]]
"""By their names and what an item is; each is made ready on the cores that its thread may use."""


def pieces() -> Pieces:
    """All of them."""
    found: Pieces = {
        (f"{name} {size}x{size}", "image"): functools.partial(_pictures, size, *camera)
        for size in SIZES
        for name, camera in CAMERAS.items()
    }
    found |= {
        ("contacts", "motion"): _contacts,
        ("inverse kinematics", "motion"): _motions,
        ("scenes", "scene"): _scenes,
    }
    for mode in MODES:
        run = functools.partial(load, SIZES[0], mode, PPO_ENVS)
        found[f"PPO's update {SIZES[0]}x{SIZES[0]}, {mode}", "transition"] = functools.partial(
            _update, run
        )
    run = functools.partial(load_file, RUN_FILES[0], CPU)
    found[f"DDPG's update, {RUN_FILES[0].name}", "transition"] = functools.partial(_update, run)
    return found


def _pictures(size: int, camera: dict[str, Any], operations: int, of_pixel: int) -> Work:
    settings = {"type": "depth", "width": size, "height": size, **camera}
    worlds, pixels = Worlds(FAST, Camera.model_validate(settings), COUNT), size * size
    return Work(
        worlds.shoot, operations * pixels, of_pixel * pixels, worlds.change, worlds.simulator.close
    )


def _contacts() -> Work:
    worlds = Worlds(FAST, Camera(type="depth"), COUNT)
    moved = BOXES * BOX_BYTES + KNOTS * KNOT_BYTES
    return Work(worlds.move, CONTACT_OPERATIONS, moved, worlds.plan, worlds.simulator.close)


def _motions() -> Work:
    arm, rng = Arm.of(GraspSettings(), ROBOT), np.random.default_rng(0)
    home = arm.home(COUNT)

    def plan() -> int:
        arm.reach(home, *arm.pose(rng.uniform(-1.0, 1.0, (COUNT, 4))))
        return COUNT

    return Work(plan, MOTION_OPERATIONS, KNOTS * KNOT_BYTES)


def _scenes() -> Work:
    sampler, rng = SceneSampler(GraspSettings()), np.random.default_rng(0)
    limits = np.full(COUNT, np.pi)

    def draw() -> int:
        sampler.sample(rng, limits)
        return COUNT

    return Work(draw, SCENE_OPERATIONS, BOXES * BOX_BYTES)


def _update(load_run: Callable[[], RunSettings]) -> Work:
    """An algorithm's updates; an item is a transition of a minibatch, once in an epoch."""
    run = load_run()
    trainer, settings = Ventosa(run), run.trainer.settings
    algorithm, hyper = trainer.session.algorithm, cast(Any, settings).hyperparameters
    times = (
        hyper.updates_per_step * hyper.batch_size
        if isinstance(settings, OffPolicySettings)
        else hyper.num_epoch
    )
    items = algorithm.collection_steps * times

    def update() -> int:
        algorithm.update(0.0)
        return int(items)

    algorithm.collect()
    update()  # takes what memory it needs
    algorithm.collect()
    with FlopCounterMode(display=False) as flops, _Traffic() as traffic:
        update()
    operations, moved = flops.get_total_flops() / items, traffic.bytes / items
    return Work(update, operations, moved, algorithm.collect, trainer.close)


class _Traffic(TorchDispatchMode):
    """Adds up the bytes of all that torch's operations read and write."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        if name.startswith("index"):  # of what is chosen from, or written to, only the rows
            self.bytes += 2 * _bytes(args[1:] if name.endswith("_") else found)
        elif not func.is_view and not name.startswith("empty"):
            self.bytes += _bytes((args, kwargs, found))
        return found


def _bytes(tree: Any) -> int:
    return sum(each.nbytes for each in tree_leaves(tree) if isinstance(each, Tensor))
