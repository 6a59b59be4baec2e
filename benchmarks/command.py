"""What the commands have in common: extras asked for, jobs and their results."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

from trainers.common.errors import UserError
from trainers.comparison.jobs import CORES

ROOT = Path(__file__).parents[1]
INSTALL = "pip install -c constraints.txt -e '.[bench]'"


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


def add_options(parser: argparse.ArgumentParser, results: str) -> None:
    """Adds the options of a command that runs jobs and reports on them."""
    parser.add_argument("--jobs", type=int, default=CORES, help="at a time")
    parser.add_argument("--results", type=Path, default=Path(results), metavar="DIR")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table as Markdown")
