"""The command line: `python -m trainers.plugins` lists every component with its settings."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence

from trainers.common.command import DONE, tells_failures
from trainers.common.options import command_parser


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Lists the components with their settings; returns the exit code."""
    parser = command_parser("plugins", description=main.__doc__)
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)
    # Imported late, so that `--help` answers at once.
    from rich.console import Console  # noqa: PLC0415

    from trainers.runfile.listing import (  # noqa: PLC0415
        component_rows,
        print_plain,
        print_tables,
    )
    from trainers.runfile.registry import load_registries  # noqa: PLC0415

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
