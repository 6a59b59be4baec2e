"""One run of one side, in a process of its own, which `benchmarks.learning` starts."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.learning import ours, theirs
from benchmarks.learning.cases import OURS, PEER, Case, Entry
from benchmarks.learning.evaluation import Referee, returns
from trainers.common.files import write_atomically
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import load_run
from trainers.session import build_environment

EVALUATION_ENVS = 10
EVALUATIONS = 20
FINAL_EPISODES_EACH = 3
LEARNERS = {OURS: ours.learn, PEER: theirs.learn}


def play(entry: Entry, path: Path) -> None:
    """Learns, evaluates, and writes what came out as JSON."""
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
    algorithm, task, steps, side, seed, file = sys.argv[1:]
    play(Entry(Case(algorithm, task, int(steps)), side, int(seed)), Path(file))
