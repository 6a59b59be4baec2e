"""One of torchrun's processes, which measures what its updates take: see `benchmarks.ranks`."""

from __future__ import annotations

import json
import pickle
import statistics
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from benchmarks.ranks.model import BATCH, BUFFER, ENVS
from trainers.common import process
from trainers.common.timers import Timer, recording, timed
from trainers.distributed.processes import connected
from trainers.distributed.world import ALONE, Ranks, World
from trainers.runfile.registry import Registries, load_registries
from trainers.runfile.settings import RunSettings, load_run
from trainers.session import Session

WARM_UP = 2
SIZES = (1, 10_000, 100_000, 1_000_000)
"""Of sums, in numbers of four bytes."""
SUMS = 20
SUM, GATHER, WAIT = "all_reduce", "gather", "wait"
"""Timers of what ranks tell each other, and of waiting for those that have not come to it."""


def main(path: Path, run_file: Path, updates: int) -> None:
    """Measures so many updates, in turn apart from the others and together with them.

    Writes what `benchmarks.ranks.model.Measured` reads.
    """
    registries = load_registries()
    alone = of_ranks(run_file, registries, ALONE.size)
    with (
        connected() as world,
        closing(begun(alone, registries, ALONE)) as own,
        closing(begun(of_ranks(run_file, registries, world.size), registries, world)) as session,
    ):
        for _ in range(WARM_UP):
            update(own)
            update(session)
        turns = world.gather([turn(world, own, session) for _ in range(updates)])
        state = session.state_dict()
        begin_s = time.perf_counter()
        checkpoint = session.joined_state(state)
        checkpoint_s = time.perf_counter() - begin_s
        found = {
            "turns": [_mean(ranks) for ranks in zip(*turns, strict=True)],
            "gradient_bytes": sum(p.nbytes for p in session.algorithm.policy.parameters()),
            "sum_s": dict(sums(world)) if isinstance(world, Ranks) else {},
            "checkpoint_s": checkpoint_s,
            "checkpoint_bytes": len(pickle.dumps((session.weights(), checkpoint))),
            "tries": tries(alone.environment.settings),
        }
        if world.writes:
            path.write_text(json.dumps(found))


def begun(run: RunSettings, registries: Registries, world: World) -> Session:
    """A run, at its beginning."""
    session = Session(run, registries, world=world)
    session.reset()
    return session


def of_ranks(run_file: Path, registries: Registries, ranks: int) -> RunSettings:
    """A file's run of so many ranks, each with a thread."""
    overrides = {
        "environment.num_envs": ENVS * ranks,
        "trainer.hyperparameters.buffer_size": BUFFER * ranks,
        "trainer.hyperparameters.batch_size": BATCH * ranks,
    }
    if hasattr(load_run(run_file, [], registries).environment.settings, "workers"):
        overrides["environment.workers"] = 1
    return load_run(run_file, [f"{key}={value}" for key, value in overrides.items()], registries)


def tries(settings: Any) -> int:
    """Actions at an image, unless one succeeds, in the environments of a run file."""
    return settings.episode_steps if getattr(settings, "frame_grab", False) else 1


def update(session: Session) -> Timer:
    """Collects once and learns from it; returns where the time went."""
    root = Timer()
    with recording(root):
        with timed("collect"):
            session.algorithm.collect()
        with timed("update"):
            session.algorithm.update(0.0)
        session.env_runner.pop_finished()
    return root


def turn(world: World, own: Session, session: Session) -> dict[str, float]:
    """What an update takes apart, and what one takes together; all ranks begin at once."""
    world.any(False)
    apart = update(own)
    world.any(False)
    together = update(session)
    telling = [_named(together, name) for name in (SUM, GATHER)]
    sums_s, gathers_s = (timer.total_s - _named(timer, WAIT).total_s for timer in telling)
    told_s = sum(timer.total_s for timer in telling)
    collect = together.children["collect"]
    collection_s = collect.total_s - sum(_named(collect, n).total_s for n in (SUM, GATHER))
    return {
        "apart_s": apart.total_s,
        "together_s": together.total_s,
        "collection_s": collection_s,
        "learning_s": together.total_s - told_s - collection_s,
        "sums_s": sums_s,
        "gathers_s": gathers_s,
        "waiting_s": told_s - sums_s - gathers_s,
        "sums": telling[0].count,
    }


def sums(world: Ranks) -> Iterator[tuple[int, float]]:
    """By how many bytes, the median seconds of their sum once all are there."""
    for size in SIZES:
        values, times_s = torch.zeros(size), []
        for _ in range(SUMS):
            root = Timer()
            with recording(root):
                world.sum([values], 1.0)
            times_s.append(root.total_s - _named(root, WAIT).total_s)
        yield values.nbytes, statistics.median(times_s)


def _named(root: Timer, name: str) -> Timer:
    """All parts of a name taken together, with their own parts; anywhere in a tree."""
    found = Timer()
    for part, timer in root.children.items():
        one = timer if part == name else _named(timer, name)
        found.total_s, found.count = found.total_s + one.total_s, found.count + one.count
        found.children[f"{len(found.children)}"] = one
    return found


def _mean(ranks: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: statistics.mean(rank[name] for rank in ranks) for name in ranks[0]}


if __name__ == "__main__":
    process.prepare()
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
