"""Tables in pages that people write."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    return ["| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows]]


def write_between(path: Path, name: str, lines: Sequence[str]) -> None:
    """Writes lines between `<!-- name -->` and `<!-- end of name -->`, in place of what is there.

    Raises:
        ValueError: the page does not have both.
    """
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    before, found_begin, rest = path.read_text().partition(begin)
    _, found_end, after = rest.partition(end)
    if not (found_begin and found_end):
        raise ValueError(f"{path}: there is no place for a table: no {begin.strip()} and {end}")
    path.write_text(before + begin + "\n".join(lines) + "\n" + end + after)
