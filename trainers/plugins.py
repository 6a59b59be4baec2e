"""The command line: `python -m trainers.plugins` lists every component with its settings."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from rich.console import Console

from trainers.common.command import DONE, tells_failures
from trainers.runfile.listing import component_rows, print_plain, print_tables
from trainers.runfile.registry import load_registries


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """List the components; returns the exit code, 2 when a plugin is broken."""
    parser = argparse.ArgumentParser(prog="python -m trainers.plugins", description=main.__doc__)
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)
    rows = component_rows(load_registries())
    console = Console()
    if options.json:
        print(json.dumps(rows, indent=2, ensure_ascii=False))
    elif console.is_terminal:
        print_tables(rows, console)
    else:
        print_plain(rows)
    return DONE


if __name__ == "__main__":
    sys.exit(main())
