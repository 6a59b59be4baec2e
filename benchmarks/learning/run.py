"""One run of one side, in a process of its own: `python -m benchmarks.learning.run`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.learning import ours, theirs
from benchmarks.learning.cases import OURS, PEER, SIDES, Case, Entry
from benchmarks.learning.evaluation import Referee, returns
from trainers.common.files import write_atomically
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import load_run
from trainers.session import build_environment

EVALUATION_ENVS = 10
EVALUATIONS = 20
FINAL_EPISODES_EACH = 3
LEARNERS = {OURS: ours.learn, PEER: theirs.learn}


def main(arguments: Sequence[str] | None = None) -> int:
    """Learns, evaluates, and writes what came out."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learning.run", description=__doc__)
    parser.add_argument("algorithm")
    parser.add_argument("task")
    parser.add_argument("steps", type=int)
    parser.add_argument("side", choices=SIDES)
    parser.add_argument("seed", type=int)
    parser.add_argument("--to", type=Path, required=True, help="the file of results")
    options = parser.parse_args(arguments)
    case = Case(options.algorithm, options.task, options.steps)
    play(Entry(case, options.side, options.seed), options.to)
    return 0


def play(entry: Entry, path: Path) -> None:
    """Does one run, and writes its results as JSON."""
    registries = load_registries()
    overrides = [f"trainer.max_steps={entry.case.steps}", f"seed={entry.seed}"]
    run = load_run(entry.case.run_file, overrides, registries)
    judged = load_run(
        entry.case.run_file, [*overrides, f"environment.num_envs={EVALUATION_ENVS}"], registries
    )
    env = build_environment(judged, entry.seed)
    referee = Referee(env, max(1, entry.case.steps // EVALUATIONS))
    act = LEARNERS[entry.side](run, registries, referee)
    seconds = referee.stop()
    final = returns(env, act, FINAL_EPISODES_EACH)
    env.close()
    result = {
        **asdict(entry),
        "seconds": seconds,
        "final_return": float(final.mean()),
        "curve": referee.curve,
    }
    write_atomically(path, json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
