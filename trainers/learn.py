"""The command line: `python -m trainers.learn config/run.yaml`."""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from trainers.common import process, stopping
from trainers.common.command import DONE, FAILED, INTERRUPTED, TERMINATED, tells_failures
from trainers.common.options import add_results_option, command_parser, version

ASKING_TO_STOP = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Trains as the run file says; returns the exit code."""
    options = parse(arguments)
    process.prepare()
    # Imported late, so that `--help` and a mistyped option answer at once.
    # And so does the line that says that something happens.
    if _is_first():
        print(f"{version()}: {options.config}", flush=True)
    from trainers.distributed.processes import connected  # noqa: PLC0415
    from trainers.distributed.world import RankFailure  # noqa: PLC0415
    from trainers.run import check_file, run_file  # noqa: PLC0415

    with stop_on_signals() as stop, connected() as world:
        try:
            if options.check:
                finished = check_file(options, stop.requested)
            else:
                finished = run_file(options, stop.requested, world)
        except KeyboardInterrupt:
            return stop.exit_code
        except RankFailure:
            if world.writes:
                raise
            return FAILED  # as the first and the one that failed tell
    return DONE if finished else stop.exit_code


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line; argparse itself exits with 2 on a mistake."""
    parser = command_parser("learn", description="Train as a run file says.")
    parser.add_argument("config", type=Path, help="the run file")
    parser.add_argument(
        "overrides",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="a dotted path into the run file, such as trainer.hyperparameters.learning_rate=3e-4",
    )
    parser.add_argument("--run-id", help="name of the run (default: the run file's name)")
    existing = parser.add_mutually_exclusive_group()
    existing.add_argument("--resume", action="store_true", help="go on with the run of that name")
    existing.add_argument("--force", action="store_true", help="delete the run of that name first")
    existing.add_argument(
        "--check",
        action="store_true",
        help="only build the run, print the resolved run file, spaces, networks and memory needed",
    )
    parser.add_argument(
        "--initialize-from", metavar="RUN", help="begin with the weights of a run or a checkpoint"
    )
    parser.add_argument("--seed", type=int, help="overrides `seed`")
    parser.add_argument("--num-envs", type=int, help="overrides `environment.num_envs`")
    parser.add_argument("--device", help="overrides `device`, such as cpu or cuda")
    add_results_option(parser)
    options = parser.parse_intermixed_args(arguments)
    if options.resume and options.initialize_from:
        parser.error("--resume goes on with the run's own weights: leave --initialize-from out")
    return options


class Stop:
    """Whether a signal asked the run to stop, and the exit code that says so."""

    def __init__(self) -> None:
        self.exit_code = DONE

    def requested(self) -> bool:
        """Whether to stop."""
        return self.exit_code != DONE

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        """Handles a signal: the first asks to stop, the second insists.

        The first sets an alarm, too, for an environment that does not return; again and again, as
        an environment may be called without a question whether to stop, or swallow the alarm.

        Under torchrun none insists: it passes on what its processes got already, and kills those
        that do not end.

        Raises:
            KeyboardInterrupt: it is the second.
        """
        if self.requested():
            if "TORCHELASTIC_RUN_ID" in os.environ:
                return
            raise KeyboardInterrupt
        self.exit_code = INTERRUPTED if number == signal.SIGINT else TERMINATED
        signal.setitimer(signal.ITIMER_REAL, stopping.PATIENCE_S, 1.0)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Turns Ctrl-C, SIGTERM and the end of the terminal into a request to stop and save."""
    stop = Stop()
    handlers: dict[int, Any] = {
        signal.SIGINT: stop,
        signal.SIGTERM: stop,
        signal.SIGALRM: stopping.give_up,
    }
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as it is under nohup
        handlers[signal.SIGHUP] = stop
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        with _answered():
            yield stop
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _answered() -> Iterator[None]:
    """Answers the first signal at once, in a thread: a handler waits for the call under way."""
    heard, write = socket.socketpair()
    write.setblocking(False)
    before = signal.set_wakeup_fd(write.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=_answer, args=(heard,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        write.close()
        thread.join()
        heard.close()


def _is_first() -> bool:
    """Whether it is this one that speaks, of the processes that torchrun started."""
    return os.environ.get("RANK", "0") == "0"


def _answer(heard: socket.socket) -> None:
    """Answers the first request to stop among the signals, whose numbers come in as bytes."""
    while number := heard.recv(1):
        if number[0] in ASKING_TO_STOP and _is_first():
            name = signal.Signals(number[0]).name
            print(f"{name}: stopping, and saving first; once more stops at once", file=sys.stderr)
            return


if __name__ == "__main__":
    sys.exit(main())
