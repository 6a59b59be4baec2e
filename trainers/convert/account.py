"""What became of the keys of a configuration, as comments of a run file."""

from __future__ import annotations

import textwrap

from trainers.runfile.yaml_document import KeyPath, dotted

WIDTH = 100


class Account:
    """A row for every key.

    Args:
        behavior: path of the section whose keys are named as seen from there.
    """

    def __init__(self, behavior: KeyPath) -> None:
        self._behavior = behavior
        self._dropped: list[str] = []
        self._kept: list[str] = []
        self._added: list[str] = []

    def drop(self, path: KeyPath, why: str) -> None:
        """Says why a key is left out."""
        self._dropped.append(f"{self._key(path)}: {why}")

    def keep(self, path: KeyPath, target: str, said: str = "") -> None:
        """Says where a key is now, and how its value is another one there."""
        self._kept.append(f"{self._key(path)}: {target}" + (f" ({said})" if said else ""))

    def add(self, target: str, said: str) -> None:
        """Says what a key of the run file has that was not written in the configuration."""
        self._added.append(f"{target}: {said}")

    def comments(self, *title: str) -> str:
        """A title's lines and all of it, dropped keys first, as YAML has comments."""
        tables = (
            ("Dropped, and why:", self._dropped),
            ("Kept, and where:", self._kept),
            ("Added, as ML-Agents has it so unless it is told otherwise:", self._added),
        )
        lines = _comment("", *title)
        for heading, rows in tables:
            if rows:
                # The lessons of a curriculum share their rows.
                lines += ["#", *_comment("", heading), *_comment("  ", *dict.fromkeys(rows))]
        return "".join(f"{line}\n" for line in lines)

    def _key(self, path: KeyPath) -> str:
        if path[: len(self._behavior)] == self._behavior:
            path = path[len(self._behavior) :]
        return dotted(tuple("*" if isinstance(step, int) else step for step in path))


def _comment(indent: str, *texts: str) -> list[str]:
    lines: list[str] = []
    for text in texts:
        # Names are the user's: what YAML takes for the end of a line would end the comment.
        one_line = "".join(char if char.isprintable() else " " for char in text)
        lines += textwrap.wrap(
            one_line,
            WIDTH,
            initial_indent=f"# {indent}",
            subsequent_indent=f"# {indent}    ",
            break_long_words=False,
            break_on_hyphens=False,
        )
    return lines
