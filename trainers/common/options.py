"""What commands are told: their parser, and the options that several of them have."""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
from pathlib import Path
from typing import Any

from trainers.hookspecs import PROJECT_NAME

SEED_LIMIT = 2**31
"""Seeds of episodes and counts are below it."""


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Help with defaults, but for those that say nothing: switches are off, lists empty."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default in (None, []) or action.default is False:
            return action.help
        return super()._get_help_string(action)


def version() -> str:
    """Name and version, as they are installed."""
    return f"{PROJECT_NAME} {importlib.metadata.version(PROJECT_NAME)}"


def program(command: str) -> str:
    """How a command is called, as this one was: by `ventosa`, or by `python -m`."""
    by_console = Path(sys.argv[0]).stem == PROJECT_NAME
    return f"{PROJECT_NAME} {command}" if by_console else f"python -m trainers.{command}"


def command_parser(command: str, **about: Any) -> argparse.ArgumentParser:
    """A command's parser, with `--version`; its help tells defaults.

    Args:
        command: its name.
        about: more of `argparse.ArgumentParser`'s.
    """
    parser = argparse.ArgumentParser(prog=program(command), formatter_class=_Help, **about)
    parser.add_argument(
        "--version", action="version", version=version(), help="show the version and exit"
    )
    return parser


def add_results_option(parser: argparse.ArgumentParser, default: str = "results") -> None:
    """Adds the option that says where runs are."""
    parser.add_argument(
        "--results-dir", type=Path, default=Path(default), help="where runs are kept"
    )


def add_trust_option(parser: argparse.ArgumentParser) -> None:
    """Adds the option with which a policy's environment may import what its run file names."""
    parser.add_argument(
        "--trust",
        action="store_true",
        help="import the modules that the policy's environment names, as in id: MODULE:ID",
    )


def positive(text: str) -> int:
    """A command line's count.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    return _whole_number(text, 1)


def seed_number(text: str) -> int:
    """A command line's seed of episodes.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    return _whole_number(text, 0)


def _whole_number(text: str, least: int) -> int:
    """Raises: argparse.ArgumentTypeError: it is none, or not within its limits."""
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value < SEED_LIMIT:
        raise argparse.ArgumentTypeError(
            f"should be a whole number from {least} to {SEED_LIMIT - 1}, not {text!r}"
        )
    return value
