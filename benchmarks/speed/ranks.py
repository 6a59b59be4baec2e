"""This project's training loop on several of torchrun's processes, a thread of torch each.

They gather a checkpoint after each update, as they do where it is saved, which it is not here.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TextIO

from benchmarks.command import ROOT, torchrun
from benchmarks.speed.training import Ventosa
from trainers.common import process
from trainers.common.timers import Timer, add_timed, recording
from trainers.distributed.processes import connected
from trainers.runfile.settings import RunSettings


class OfRanks:
    """One contender of several processes; see `benchmarks.speed.training.Contender`.

    The first of them is told to begin by a line, and answers with one of JSON.

    Args:
        ranks: how many processes.
        run: of all of them together.

    Raises:
        RuntimeError: the processes have ended; what they said is above.
    """

    def __init__(self, ranks: int, run: RunSettings):
        with ExitStack() as stack:
            file = Path(stack.enter_context(tempfile.TemporaryDirectory()), "run")
            file.write_bytes(pickle.dumps(run))
            self._process = subprocess.Popen(
                torchrun(ranks, __name__, str(file)),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                cwd=ROOT,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                text=True,
            )
            stack.callback(self._end)
            self.parameters = int(self._told()["parameters"])
            self.close = stack.pop_all().close

    def learn(self) -> None:
        """See `Contender`."""
        assert self._process.stdin is not None
        print(file=self._process.stdin, flush=True)
        for name, total_s in self._told().items():
            add_timed(name, total_s)

    def _told(self) -> dict[str, float]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                found: dict[str, float] = json.loads(line)
                return found
        raise RuntimeError("the ranks have ended")

    def _end(self) -> None:
        self._process.communicate()  # without another line, they end


def main(path: Path, commands: TextIO) -> None:
    """One rank: learns as often as there are lines."""
    run: RunSettings = pickle.loads(path.read_bytes())
    with connected() as world, closing(Ventosa(run, world)) as contender:
        print(json.dumps({"parameters": contender.parameters}), flush=True)
        while world.first(commands.readline() if world.writes else ""):
            root = Timer()
            with recording(root):
                contender.learn()
            times_s = {name: part.total_s for name, part in root.children.items()}
            print(json.dumps(times_s), flush=True)


if __name__ == "__main__":
    process.prepare()
    main(Path(sys.argv[1]), sys.stdin)
