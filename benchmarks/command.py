"""What the commands have in common: mistakes told, extras asked for, jobs and their results."""

from __future__ import annotations

import argparse
import functools
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec

from trainers.common.errors import UserError
from trainers.comparison.jobs import CORES
from trainers.learn import MISTAKE

ROOT = Path(__file__).parents[1]
INSTALL = "pip install -c constraints.txt -e '.[bench]'"
P = ParamSpec("P")


def missing(*packages: str) -> list[str]:
    """Those of the extra's packages that are not installed."""
    return [name for name in packages if importlib.util.find_spec(name) is None]


def require(*packages: str) -> None:
    """Refuses to begin without packages of the extra `bench`.

    Raises:
        UserError: names what is missing, and the command that installs it.
    """
    if absent := missing(*packages):
        raise UserError(
            f"not installed: {', '.join(absent)}, of the extra `bench`; install it with: {INSTALL}"
        )


def tells_mistakes(main: Callable[P, int]) -> Callable[P, int]:
    """A command whose user's mistakes are an `error: ...` and exit code 2."""

    @functools.wraps(main)
    def command(*arguments: P.args, **options: P.kwargs) -> int:
        try:
            return main(*arguments, **options)
        except UserError as mistake:
            print(f"error: {mistake}", file=sys.stderr)
            return MISTAKE

    return command


def add_options(parser: argparse.ArgumentParser, results: str) -> None:
    """Adds the options of a command that runs jobs and reports on them."""
    parser.add_argument("--jobs", type=int, default=CORES, help="at a time")
    parser.add_argument("--results", type=Path, default=Path(results), metavar="DIR")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table as Markdown")
