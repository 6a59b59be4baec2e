"""Steps per second of PPO's training loop: this project's and Stable-Baselines3's, in turn.

Both act in the same batched environment, with the same network, hyper-parameters and threads.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console

from benchmarks.speed.figures import MODES, OURS, PEER, Figures, race
from trainers.algorithms.base import TrainerSettings
from trainers.common.timers import Timer, recording
from trainers.distributed.world import ALONE, World
from trainers.reporting.event_log import RunLog
from trainers.reporting.silent import SilentLog
from trainers.reporting.summary import Summary
from trainers.reporting.terminal import make_display
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import RunSettings, load_run
from trainers.saving.checkpoint import Checkpoints
from trainers.session import Session
from trainers.training import Training

RUN_FILE = Path(__file__).with_name("training.yaml")
BUFFER_STEPS = 32
"""Of each environment between two updates."""

PEER_PACKAGES = ("stable_baselines3", "sb3_contrib")
"""What the peer is in, of the extra `bench`."""

WHATS = {
    "collection steps": "collect",
    "update steps": "update",
    "training steps": None,
}
"""What is measured, and the timer it is read from; None: the whole loop."""


class Contender(Protocol):
    """A trainer with its environments.

    Attributes:
        parameters: how many its networks have.
    """

    parameters: int

    def learn(self) -> None:
        """Collects once and learns from it; times `collect` and `update` as parts."""

    def close(self) -> None:
        """Ends the environments."""


Maker = Callable[[RunSettings], Contender]
Makers = Mapping[str, Maker]


def load(size: int, mode: str, num_envs: int) -> RunSettings:
    """The run of both contenders, with images of a size in pixels and one of `MODES`."""
    camera = "environment.cameras.depth"
    overrides = {
        "environment.num_envs": num_envs,
        "environment.frame_grab": str(MODES[mode]).lower(),
        f"{camera}.width": size,
        f"{camera}.height": size,
        "encoders.depth.size": size,
        "trainer.hyperparameters.buffer_size": BUFFER_STEPS * num_envs,
    }
    lines = [f"{key}={value}" for key, value in overrides.items()]
    return load_run(RUN_FILE, lines, load_registries())


class Ventosa:
    """Trains as `trainers.learn` does, summaries included; only checkpoints are left out."""

    def __init__(self, run: RunSettings, world: World = ALONE):
        self._settings: TrainerSettings = run.trainer.settings  # type: ignore[assignment]
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            self.session = stack.enter_context(
                closing(Session(run, load_registries(), world=world))
            )
            self._log = log = stack.enter_context(
                closing(RunLog(folder) if world.writes else SilentLog())
            )
            self.session.reset()
            env = self.session.env_runner.env
            self._summary = Summary(log, "speed", env, 1, self._settings.summary_freq)
            self._checkpoints = _NoCheckpoints(folder, 1)
            self._display = make_display("speed", 1, 1, console=Console(quiet=True))
            self.close = stack.pop_all().close
        self.parameters = sum(p.numel() for p in self.session.algorithm.policy.parameters())

    def learn(self) -> None:
        """See `Contender`."""
        session = self.session
        steps = session.env_runner.step_count + session.algorithm.collection_steps
        settings = self._settings.model_copy(update={"max_steps": steps})
        summary, checkpoints = self._summary, self._checkpoints
        Training(session, settings, self._log, summary, checkpoints, self._display).run()


class _NoCheckpoints(Checkpoints):
    """Where nothing is saved, as the peer saves nothing."""

    def save(self, *_: Any, **__: Any) -> Path:
        return Path()


def contenders(peer: bool, ours: Maker = Ventosa) -> Makers:
    """What is compared: this project's trainer, and its peer if asked for."""
    if not peer:
        return {OURS: ours}
    # Imported late, for it needs the extra `bench`.
    from benchmarks.speed.stable_baselines import StableBaselines  # noqa: PLC0415

    return {OURS: ours, PEER: StableBaselines}


def training(
    mode: str, size: int, num_envs: int, rounds: int, seconds: float, makers: Makers
) -> tuple[Figures, int]:
    """Measures the training loops.

    Args:
        mode: one of `MODES`.
        size: side of the images in pixels.
        num_envs: environments stepped together.
        rounds: of measurements in turn.
        seconds: of each measurement, rounded up to whole buffers.
        makers: build the contenders.

    Returns:
        The figures; and how many parameters the networks have.

    Raises:
        RuntimeError: the contenders differ in that.
    """
    run = load(size, mode, num_envs)
    with ExitStack() as stack:
        teams = {name: stack.enter_context(closing(make(run))) for name, make in makers.items()}
        parameters = {name: one.parameters for name, one in teams.items()}
        if len(set(parameters.values())) > 1:
            raise RuntimeError(f"the networks differ in their numbers of parameters: {parameters}")
        for one in teams.values():
            one.learn()  # compiles, and takes what memory it needs
        measures = {
            (name, num_envs): partial(_speeds, one, BUFFER_STEPS * num_envs, seconds)
            for name, one in teams.items()
        }
        return race(measures, size, mode, rounds), next(iter(parameters.values()))


def _speeds(contender: Contender, buffer_size: int, seconds: float) -> dict[str, float]:
    """Steps per second of the whole loop and its two parts."""
    root, steps = Timer(), 0
    while root.total_s < seconds:
        with recording(root):
            contender.learn()
        steps += buffer_size
    return {
        what: steps / (root if part is None else root.children[part]).total_s
        for what, part in WHATS.items()
    }
