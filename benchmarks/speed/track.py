"""A history of speed, a line of JSON for each commit: `python -m benchmarks.speed --track FILE`."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import re
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field

from benchmarks.command import ROOT
from benchmarks.speed.figures import FRAME_GRAB, RIVALS, Figures, speedup
from benchmarks.speed.simulation import frames, steps
from benchmarks.speed.training import contenders, training
from trainers.common.cores import usable_cores
from trainers.common.errors import UserError
from trainers.common.files import write_atomically
from trainers.runfile.validation import InvalidError, validate

SIZE_PX = 80
NUM_ENVS = 256
ROUNDS = 5
SECONDS = 1.0
TOLERATED_FALL = 0.10
PACKAGES = ("torch", "numpy", "numba", "pybullet", "stable-baselines3")
CPUINFO = Path("/proc/cpuinfo")


class Machine(BaseModel, frozen=True, extra="forbid"):
    """A machine, and what is installed on it."""

    cores: int = Field(ge=1, description="That the process may use.")
    processor: str = Field(description="The CPU's model.")
    python: str = Field(description="Version.")
    packages: dict[str, str] = Field(description="Versions of those that matter.")

    def like(self, other: Machine) -> bool:
        """Whether figures can be compared: the same CPU model and as many cores."""
        return (self.processor, self.cores) == (other.processor, other.cores)


Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Spread = tuple[Positive, Positive, Positive]
"""Median, smallest and largest over the rounds."""


class Line(BaseModel, frozen=True, extra="forbid"):
    """One line of a history."""

    date: str = Field(description="When, in UTC (ISO 8601).")
    revision: str = Field(description="The git commit that was checked out.")
    dirty: bool = Field(description="Whether files differed from it.")
    machine: Machine = Field(description="Where.")
    ratios: dict[str, Spread] = Field(
        description="How many times as fast as the peer in the same run."
    )
    per_second: dict[str, dict[str, Spread]] = Field(
        description="The speeds of both, by contender."
    )


def track(path: Path) -> int:
    """Measures a fixed set and adds it to the history at `path`; says what fell.

    Returns:
        1 if a ratio fell by more than `TOLERATED_FALL`, else 0.

    Raises:
        UserError: the history has a line that is none, or there is no git checkout.
    """
    # What may be refused is asked before minutes are spent.
    history, (commit, dirty) = read(path), revision(path)
    line = line_of(measure(), commit, dirty)
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [*history, line]
    write_atomically(path, "".join(f"{one.model_dump_json()}\n" for one in lines))
    for what, (median, low, high) in line.ratios.items():
        print(f"{what}: {median:.3g} times the peer's ({low:.3g} to {high:.3g})")
    before = [one for one in history if one.machine.like(line.machine)]
    if not before:
        print(f"nothing to compare with: {path} has no other line of such a machine")
        return 0
    return compare(before[-1], line)


def read(path: Path) -> list[Line]:
    """The lines of a history; none where there is no file yet.

    Raises:
        UserError: a line is not one of a history.
    """
    try:
        texts = path.read_text().splitlines() if path.exists() else []
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: can't be read as a history: {error}") from error
    lines = []
    for number, text in enumerate(texts, start=1):
        try:
            lines.append(validate(Line, json.loads(text)))
        except (json.JSONDecodeError, InvalidError) as error:
            raise UserError(
                f"{path}:{number}: not a line of `benchmarks.speed --track`: {error}; mend it, or "
                "take it out"
            ) from error
    return lines


def revision(history: Path) -> tuple[str, bool]:
    """The commit that is checked out, and whether files differ from it, but for the history.

    Raises:
        UserError: this is no git checkout.
    """
    commands = (("rev-parse", "HEAD"), ("status", "--porcelain", "--untracked-files=all"))
    try:
        commit, changed = (
            subprocess.run(
                ["git", *command], cwd=ROOT, check=True, capture_output=True, text=True
            ).stdout.splitlines()
            for command in commands
        )
    except (OSError, subprocess.CalledProcessError) as error:
        reason = getattr(error, "stderr", None) or error
        raise UserError(
            f"--track notes the git commit, and in {ROOT} git fails: {reason}"
        ) from error
    files = {(ROOT / line[3:]).resolve() for line in changed}
    return commit[0], bool(files - {history.resolve()})


def measure() -> Figures:
    """The fixed set: depth frames, environment steps and PPO, 80x80, with frame grab."""
    size, rounds, seconds = SIZE_PX, ROUNDS, SECONDS
    loops, _ = training(FRAME_GRAB, size, NUM_ENVS, rounds, seconds, contenders(peer=True))
    pictures = frames("depth", size, NUM_ENVS, rounds, seconds)
    return pictures | steps(FRAME_GRAB, size, [NUM_ENVS], rounds, seconds) | loops


def line_of(figures: Figures, commit: str, dirty: bool) -> Line:
    """What was measured here and now, as a line."""
    ratios = {case.what: speedup(found) for case, found in figures.items()}
    return Line(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        revision=commit,
        dirty=dirty,
        machine=this_machine(),
        ratios={what: ratio.spread for what, ratio in ratios.items() if ratio is not None},
        per_second={
            case.what: {name: samples.spread for name, samples in found.items()}
            for case, found in figures.items()
        },
    )


def this_machine() -> Machine:
    """The machine this process runs on."""
    text = CPUINFO.read_text() if CPUINFO.exists() else ""
    model = re.search(r"^model name\s*: (.*)$", text, re.MULTILINE)
    return Machine(
        cores=usable_cores(),
        processor=model[1] if model else platform.processor(),
        python=platform.python_version(),
        packages={name: importlib.metadata.version(name) for name in PACKAGES},
    )


def compare(before: Line, now: Line) -> int:
    """Prints what fell since an earlier line; returns 1 if that is a ratio, else 0."""
    print(f"since {before.revision[:12]}{' (dirty)' if before.dirty else ''} of {before.date}:")
    ratios, speeds = fallen(before.ratios, now.ratios), fallen(_own(before), _own(now))
    for name, change in ratios.items():
        print(f"  {name}, times the peer's: {change}")
    for name, change in speeds.items():
        print(f"  {name} a second: {change}")
    if not ratios and not speeds:
        print(f"  nothing fell by more than {TOLERATED_FALL:.0%}")
    return 1 if ratios else 0


def fallen(before: Mapping[str, Spread], now: Mapping[str, Spread]) -> dict[str, str]:
    """What has a median that is lower by more than `TOLERATED_FALL`, and by how much."""
    pairs = {name: (before[name][0], now[name][0]) for name in before if name in now}
    return {
        name: f"{old:.4g} -> {new:.4g} ({new / old - 1.0:+.0%})"
        for name, (old, new) in pairs.items()
        if new < (1.0 - TOLERATED_FALL) * old
    }


def _own(line: Line) -> dict[str, Spread]:
    """The speeds of this project's contenders."""
    return {
        what: found[name]
        for what, found in line.per_second.items()
        for name in RIVALS
        if name in found
    }
