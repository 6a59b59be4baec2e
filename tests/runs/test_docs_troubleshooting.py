"""The page on troubleshooting quotes the program: each message is what the source can say."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).parents[2]
PACKAGES = ("trainers", "envs", "encoders", "rewards", "curricula")
PAGE = (REPOSITORY / "docs/troubleshooting.md").read_text()
QUOTED = [
    line.strip()
    for block in re.findall(r"^```\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
]
LEAST_LITERAL = 12
"""Characters of a message that are not filled in; what has fewer would fit anything."""


def templates(source: str) -> Iterator[str]:
    """Patterns of the lines of a module's texts."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.JoinedStr():
                parts = [part if isinstance(part, ast.Constant) else None for part in node.values]
                text = "".join(str(part.value) if part else "%s" for part in parts)
            case ast.Constant(value=str(text)):
                pass
            case _:
                continue
        for line in text.split("\n"):
            literal = re.split("%[sr]", line.strip())
            if sum(map(len, literal)) >= LEAST_LITERAL:
                pattern = ".+?".join(map(re.escape, literal))
                # Of what file it is said is cut off; what is filled in last goes on to the next.
                yield re.sub(r"\.\+\?$", "[^;]*", re.sub(r"^\.\+\?(:\\ )?", "", pattern))


@pytest.fixture(scope="module")
def patterns() -> list[re.Pattern[str]]:
    files = [path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py")]
    return [re.compile(each) for path in files for each in templates(path.read_text())]


def explained(line: str, patterns: list[re.Pattern[str]]) -> float:
    """The share of a line that texts of the source give, what they have filled in included."""
    covered = np.zeros(len(line), bool)
    for pattern in patterns:
        for match in pattern.finditer(line):
            covered[match.start() : match.end()] = True
    return float(covered.mean())


@pytest.mark.parametrize("line", QUOTED)
def test_a_message_is_what_the_program_says(line: str, patterns: list[re.Pattern[str]]) -> None:
    message = re.sub(r"^(error: )?([\w.-]+/[\w./-]+(:\d+)?: )?", "", line)  # said of what file
    assert explained(message, patterns) > 0.5


def test_ten_causes_of_a_stop_and_more_are_there() -> None:
    stops = PAGE[PAGE.index("## Why did my run stop?") : PAGE.index("## Why does it not begin?")]
    assert len(re.findall(r"^```\n", stops, re.MULTILINE)) // 2 >= 15


def test_a_message_that_nobody_says_is_noticed(patterns: list[re.Pattern[str]]) -> None:
    for line in ("step 7: the loss is too large; try again", "rewards: there are none here"):
        assert explained(line, patterns) < 0.4
