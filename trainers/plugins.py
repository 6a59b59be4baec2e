"""Lists all components with their settings: `python -m trainers.plugins`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trainers.common.command import DONE, tells_failures
from trainers.common.files import naming, write_atomically
from trainers.common.options import command_parser

if TYPE_CHECKING:
    from trainers.runfile.registry import Registries

PRINTED = Path("-")


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """List the components and what can be set; returns the exit code, 2 when a plugin is broken."""
    options = parse_options(arguments)
    # Imported late, so that `--help` answers at once.
    from trainers.reporting.tags import TAGS  # noqa: PLC0415
    from trainers.runfile.reference import reference  # noqa: PLC0415
    from trainers.runfile.registry import load_registries  # noqa: PLC0415
    from trainers.runfile.schema import run_schema  # noqa: PLC0415
    from trainers.sweep.plan import SweepSettings  # noqa: PLC0415
    from trainers.sweep.schema import sweep_schema  # noqa: PLC0415

    registries = load_registries()
    pages = [
        (options.schema, lambda: _json(run_schema(registries))),
        (options.sweep_schema, lambda: _json(sweep_schema(registries))),
        (options.reference, lambda: "\n".join(reference(registries, SweepSettings, TAGS))),
    ]
    wanted = [(path, page) for path, page in pages if path is not None]
    for path, page in wanted:
        _write(path, page())
    if not wanted:
        _list(options, registries)
    return DONE


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = command_parser(
        "plugins", description="List the components and what can be set of each."
    )
    parser.add_argument(
        "name", nargs="?", metavar="NAME", help="a kind, a component or a key: that alone"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    pages = {
        "--schema": "the JSON schema of run files, for editors",
        "--sweep-schema": "that of sweep files",
        "--reference": "all keys and TensorBoard tags, in Markdown",
    }
    for flag, page in pages.items():
        text = f"write {page}; without FILE: print it"
        parser.add_argument(flag, nargs="?", type=Path, const=PRINTED, metavar="FILE", help=text)
    return parser.parse_args(arguments)


def _list(options: argparse.Namespace, registries: Registries) -> None:
    """Prints what can be set, as the output can show it."""
    from rich.console import Console  # noqa: PLC0415

    from trainers.runfile.listing import (  # noqa: PLC0415
        component_rows,
        print_plain,
        print_wrapped,
        run_file_row,
        selected,
    )

    rows: Sequence[Mapping[str, Any]] = [run_file_row(), *component_rows(registries)]
    if options.name is not None:
        rows = selected(rows, options.name)
    console = Console()
    if options.json:
        print(_json(rows))
    elif console.is_terminal:
        print_wrapped(rows, console)
    else:
        print_plain(rows)


def _json(data: Any) -> str:
    return json.dumps(data, indent=1, ensure_ascii=False)


def _write(path: Path, text: str) -> None:
    if path == PRINTED:
        print(text)
        return
    with naming(path):
        write_atomically(path, f"{text}\n")


if __name__ == "__main__":
    sys.exit(main())
