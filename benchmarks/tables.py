"""Tables, on the terminal and in pages that people write."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from trainers.common.errors import UserError

Rows = Sequence[Sequence[str]]


def table(title: str, head: Sequence[str], rows: Rows, caption: str = "", left: int = 1) -> Table:
    """A table for the terminal, numbers to the right of the first `left` columns."""
    made = Table(title=title, caption=caption)
    for number, name in enumerate(head):
        made.add_column(name, justify="left" if number < left else "right")
    for row in rows:
        made.add_row(*row)
    return made


def write_between(path: Path, name: str, lines: Sequence[str]) -> None:
    """Writes lines between `<!-- name -->` and `<!-- end of name -->`, in place of what is there.

    Raises:
        UserError: the page does not have both.
    """
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    text = path.read_text() if path.exists() else ""
    before, found_begin, rest = text.partition(begin)
    _, found_end, after = rest.partition(end)
    if not (found_begin and found_end):
        raise UserError(f"{path}: there is no place for a table: no {begin.strip()} and {end}")
    path.write_text(before + begin + "\n".join(lines) + "\n" + end + after)
