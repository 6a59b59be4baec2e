"""The command line: `python -m trainers.convert 3DBall.yaml > run.yaml`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from trainers.common.command import DONE, tells_failures
from trainers.common.options import command_parser


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a run file made of a configuration of ML-Agents; returns the exit code."""
    options = _parse(arguments)
    # Imported late, so that `--help` answers at once.
    from trainers.convert.conversion import convert  # noqa: PLC0415
    from trainers.runfile.registry import load_registries  # noqa: PLC0415

    print(convert(options.config, options.behavior, options.env, load_registries()), end="")
    return DONE


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = command_parser(
        "convert",
        description="Make a run file of a trainer configuration of ML-Agents, and print it.",
    )
    parser.add_argument("config", type=Path, metavar="FILE", help="the trainer configuration")
    parser.add_argument("--behavior", metavar="NAME", help="which of its behaviors, if several")
    parser.add_argument(
        "--env", metavar="ID", help="the gymnasium environment in the place of Unity's executable"
    )
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
