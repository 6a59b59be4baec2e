"""The console command `ventosa`: `ventosa learn quick.yaml`."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from trainers.common.options import version
from trainers.common.shadowing import HOME

COMMANDS = {
    "init": ("trainers.console.init", "copy a run file or a trained policy to here"),
    "learn": ("trainers.learn", "train as a run file says"),
    "evaluate": ("trainers.evaluate", "report how good a policy is"),
    "predict": ("trainers.predict", "say what a policy does before an image"),
    "export": ("trainers.export", "write what it takes to use a policy"),
    "calibrate": ("trainers.calibrate", "learn how sure a policy may be of its answers"),
    "compare": ("trainers.compare", "train run files with several seeds, side by side"),
    "sweep": ("trainers.sweep.__main__", "try settings of a run file"),
    "convert": ("trainers.convert.__main__", "make a run file of ML-Agents' configuration"),
    "plugins": ("trainers.plugins", "list all components and their settings"),
}
"""By name: the module, whose `main` takes the rest of the line, and what it does."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit code. argparse itself exits with 2 on a mistake."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    name = parse(words[:1] or ["--help"]).command
    look_here_last()
    module = importlib.import_module(COMMANDS[name][0])
    code: int = module.main(words[1:])
    return code


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Reads the name of a command; what follows is its own."""
    lines = [f"  {name:<10} {described}" for name, (_, described) in COMMANDS.items()]
    parser = argparse.ArgumentParser(
        prog="ventosa",
        description="A trainer of policies.",
        epilog="\n".join(["commands:", *lines, "", "`ventosa COMMAND --help` says more."]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=version())
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="see below")
    return parser.parse_args(words)


def look_here_last() -> None:
    """Lets modules of the current folder be found, as by `python -m`, but after our own.

    The folder may have an envs/ that is not ours. Processes that a command starts do likewise.
    """
    here = os.getcwd()
    if here not in sys.path:
        sys.path += [str(HOME), here]
        os.environ["PYTHONSAFEPATH"] = "1"


if __name__ == "__main__":
    sys.exit(main())
