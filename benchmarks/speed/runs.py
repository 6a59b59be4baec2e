"""Steps per second of the project's own run files on a device, and where their time goes."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from rich.table import Table

from benchmarks.command import ROOT
from benchmarks.speed.training import Ventosa
from benchmarks.tables import table
from trainers.algorithms.off_policy import OffPolicySettings
from trainers.common.devices import resolve_device
from trainers.common.timers import Timer, recording
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import RunSettings, load_run

RUN_FILES = tuple(ROOT / "config" / f"{name}.yaml" for name in ("run", "structured_light", "ppo"))
CPU = "cpu"
WARM_UP = 4
"""Collections and updates before any that count: kernels are compiled, and graphs captured."""

HEAD = ("run file", "device", "steps/s", "environment", "encode and act", "update")


def table_of_runs(device: str, seconds: float) -> Table:
    """Speeds on the CPU and on a device, of parts the share of the time.

    Args:
        device: as in a run file.
        seconds: of each measurement, at least.

    Raises:
        UserError: the device can't be used.
    """
    resolve_device(device)
    devices = dict.fromkeys((CPU, device))
    rows = [row(path, each, seconds) for path in RUN_FILES for each in devices]
    return table("whole runs", HEAD, rows, left=2)


def load(path: Path, device: str) -> RunSettings:
    """A run file, for a device; what learns from a replay buffer begins at once."""
    registries = load_registries()
    run = load_run(path, [f"device={device}"], registries)
    if not isinstance(run.trainer.settings, OffPolicySettings):
        return run
    batch_size = run.trainer.settings.hyperparameters.batch_size
    first = f"trainer.hyperparameters.buffer_init_steps={batch_size}"
    return load_run(path, [f"device={device}", first], registries)


def row(path: Path, device: str, seconds: float) -> list[str]:
    """Measures one run file on one device."""
    with closing(Ventosa(load(path, device))) as run:
        for _ in range(WARM_UP):
            run.learn()
        root, steps = Timer(), 0
        while root.total_s < seconds:
            with recording(root):
                run.learn()
            steps += run.session.algorithm.collection_steps
    collect, update = root.children["collect"], root.children["update"]
    environment_s = collect.children["environment"].total_s
    parts = (environment_s, collect.total_s - environment_s, update.total_s)
    shares = [f"{100.0 * part / root.total_s:.0f} %" for part in parts]
    return [path.name, device, f"{steps / root.total_s:,.0f}", *shares]
