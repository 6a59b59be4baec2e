"""YAML to plain data that remembers where every value was written, and back.

Scalars follow YAML 1.2's core schema instead of PyYAML's 1.1: `1e-3` is a number, `010` is ten,
`1:30` is text, and only `true` and `false` are booleans. `yes`, `no`, `on` and `off` are text: they
are often meant so (a part named `no`), and where a boolean is needed they are refused, not
misread.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from trainers.common.errors import UserError

KeyPath = tuple[str | int, ...]
"""Keys and list indices that lead to a value, from the top of the run file."""

LARGEST_EXACT_INTEGER = 2**53
"""Up to here every whole number has a float of its own."""

MOST_VALUES = 100_000
"""Of a run file, aliases and merges written out: they can grow to billions from a few lines."""
DEEPEST = 100
"""Mappings and lists within each other: whatever walks through them may do so by recursion."""
LARGEST_INTEGER = 2**63 - 1
MOST_DIGITS = 64
"""Of a whole number, however many zeros it begins with. Python itself refuses thousands."""

COMMAND_LINE = "command line"
"""Beginning of the place of what was written there."""

TAG = "tag:yaml.org,2002:"
CORE_SCHEMA = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+0123456789."),
    ),
    ("merge", r"<<", ["<"]),
)
"""Tag, pattern, and the characters it can begin with."""


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 (PyYAML's own declaration)


class _Dumper(yaml.SafeDumper):
    """Quotes text that YAML 1.1 or 1.2 would take for something else."""

    def represent_str(self, data: str) -> yaml.ScalarNode:
        # Left to itself, PyYAML writes these line breaks as they are, and reads them as a space.
        breaks = any(character in data for character in "\x85\u2028\u2029")
        return self.represent_scalar(f"{TAG}str", data, style='"' if breaks else None)


_Dumper.add_representer(str, _Dumper.represent_str)

for _tag, _pattern, _first in CORE_SCHEMA:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(TAG + _tag, re.compile(f"^(?:{_pattern})$"), _first)


@dataclass(frozen=True)
class Problem:
    """One thing the user has to put right."""

    where: str
    """File and line, or the override on the command line."""
    path: KeyPath
    message: str

    def __str__(self) -> str:
        return ": ".join(filter(None, (self.where, dotted(self.path), self.message)))


class SettingsError(UserError):
    """The run file or an override is wrong; the message says all that was found, a line each."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = tuple(problems)


@dataclass
class Document:
    """Plain data, and where each part of it was written."""

    data: Any
    origin: str
    places: dict[KeyPath, str] = field(default_factory=dict)

    def where(self, path: KeyPath) -> str:
        """Say where `path` was written, or the nearest thing around it."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.places:
                return self.places[path[:length]]
        return self.origin

    def override(self, text: str) -> None:
        """Set one value, from `KEY=VALUE` as the command line has it.

        KEY is a dotted path in which a number is an index into a list; sections that are missing
        are made. VALUE is YAML.

        Raises:
            SettingsError: there is no `=`, VALUE is no YAML, or KEY leads through a value that has
                no keys or to an item that a list does not have.
        """
        place = f"{COMMAND_LINE} '{text}'"
        key, equals, value = text.partition("=")
        if not equals or not all(key.split(".")):
            message = "not KEY=VALUE; write for example trainer.max_steps=1000"
            raise SettingsError([Problem(place, (), message)])
        self.set(key, parse(value, place).data, place)

    def set(self, key: str, value: Any, place: str) -> None:
        """Set one value.

        Args:
            key: a dotted path, see `override`.
            value: plain data.
            place: where it was written.

        Raises:
            SettingsError: KEY leads through a value that has no keys or to an item that a list
                does not have.
        """
        target = self.data
        path: KeyPath = ()
        *sections, last = key.split(".")
        for step in sections:
            index = self._index(target, path, step, place)
            path = (*path, index)
            if isinstance(target, dict) and target.get(index) is None:
                target[index] = {}
                self.places[path] = place
            target = target[index]
        index = self._index(target, path, last, place)
        path = (*path, index)
        target[index] = value
        # What was written about the old value's parts is out of date.
        self.places = {
            known: line for known, line in self.places.items() if known[: len(path)] != path
        }
        self.places[path] = place

    @staticmethod
    def _index(target: Any, path: KeyPath, step: str, place: str) -> str | int:
        """Turn a step of an override's key into a key or an index of `target`."""
        if isinstance(target, dict):
            return step
        if not isinstance(target, list):
            message = f"is {shown(target)}, which has no key '{step}'"
        elif not (step.isascii() and step.isdigit()):
            message = f"is a list: '{step}' must be a number, as in {dotted((*path, 0))}"
        elif int(step) >= len(target):
            message = f"has {len(target)} items, counted from 0: there is no {step}"
        else:
            return int(step)
        raise SettingsError([Problem(place, path, message)])


def read(path: Path) -> Document:
    """Read a run file.

    Raises:
        SettingsError: it cannot be read, is no UTF-8 or no YAML, is empty, has duplicate keys, or
            is not a mapping at the top.
    """
    origin = str(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise SettingsError([Problem(origin, (), "there is no such file")]) from None
    except IsADirectoryError:
        raise SettingsError([Problem(origin, (), "is a directory; name a YAML file")]) from None
    except OSError as error:
        raise SettingsError([Problem(origin, (), f"cannot be read: {error.strerror}")]) from None
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        message = f"is not UTF-8: byte 0x{error.object[error.start]:02x}; save the file as UTF-8"
        raise SettingsError([Problem(f"{origin}:{line}", (), message)]) from None
    document = parse(text, origin, lines=True)
    if document.data is None:
        message = "is empty; it needs at least the sections environment and trainer"
        raise SettingsError([Problem(origin, (), message)])
    if not isinstance(document.data, dict):
        message = f"must be a mapping (key: value) at the top, not {shown(document.data)}"
        raise SettingsError([Problem(document.where(()), (), message)])
    return document


def parse(text: str, origin: str, lines: bool = False) -> Document:
    """Parse YAML text.

    Args:
        text: one YAML document.
        origin: what to call the text in messages.
        lines: name lines of `origin`.

    Raises:
        SettingsError: the text is no YAML, has duplicate keys, or is larger or deeper than any run
            file, its aliases written out.
    """
    reader = _Reader(text, origin, lines)
    try:
        data = reader.document()
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n")
        message = f"the character U+{int(error.character):04X} is not allowed in YAML"
        raise SettingsError([Problem(reader.place(line), (), message)]) from None
    except yaml.MarkedYAMLError as error:
        raise SettingsError([reader.syntax_problem(error)]) from None
    except RecursionError:
        message = "is nested too deeply; does an alias contain itself?"
        raise SettingsError([Problem(origin, (), message)]) from None
    if reader.problems:
        raise SettingsError(reader.problems)
    return Document(data, origin, reader.places if lines else {})


class _Reader:
    """Turns YAML nodes into plain data, noting the line of every key and item."""

    def __init__(self, text: str, origin: str, lines: bool) -> None:
        self.text = text
        self.origin = origin
        self.lines = lines
        self.places: dict[KeyPath, str] = {}
        self.problems: list[Problem] = []
        self.flat: set[int] = set()

    def document(self) -> Any:
        self.loader = _Loader(self.text)
        try:
            root = self.loader.get_single_node()
            if root is None:
                return None
            self.check_extent(root)
            return self.plain(root, (), root)
        finally:
            self.loader.dispose()

    def check_extent(self, root: yaml.Node) -> None:
        """Refuse what would grow without bound if its aliases were written out; none is here."""
        values, levels = _extent(root, {})
        if values > MOST_VALUES:
            message = f"has over {MOST_VALUES} values, aliases written out: too many for a run file"
        elif levels > DEEPEST:
            message = f"is nested over {DEEPEST} deep, aliases written out: too deep for a run file"
        else:
            return
        raise SettingsError([Problem(self.origin, (), message)])

    def place(self, line: int) -> str:
        """Name a line, counted from 0."""
        return f"{self.origin}:{line + 1}" if self.lines else self.origin

    def syntax_problem(self, error: yaml.MarkedYAMLError) -> Problem:
        mark = error.problem_mark or error.context_mark
        said = ", ".join(filter(None, (error.context, error.problem)))
        if mark is None:
            return Problem(self.origin, (), f"not YAML: {said}")
        return Problem(self.place(mark.line), (), f"not YAML: column {mark.column + 1}: {said}")

    def plain(self, node: yaml.Node, path: KeyPath, marked: yaml.Node) -> Any:
        """Convert a node; `marked` is the node whose line stands for it: the key of a value."""
        self.places[path] = self.place(marked.start_mark.line)
        if isinstance(node, yaml.MappingNode) and node.tag == f"{TAG}map":
            return {
                key.value: self.plain(value, (*path, key.value), key)
                for key, value in self.pairs(node, path)
            }
        if isinstance(node, yaml.SequenceNode) and node.tag == f"{TAG}seq":
            return [self.plain(item, (*path, index), item) for index, item in enumerate(node.value)]
        try:
            return scalar(node)
        except ValueError as error:
            self.problem(node, path, str(error))
            return None

    def pairs(self, node: yaml.MappingNode, path: KeyPath) -> list[tuple[yaml.Node, yaml.Node]]:
        """Keys, which are checked, and values, with merge keys (`<<`) resolved."""
        # An anchored mapping is met again at every alias; once resolved, merged keys that it
        # overrides look like duplicates.
        if id(node) not in self.flat:
            self.flat.add(id(node))
            self.check_keys(node, path)
            self.loader.flatten_mapping(node)
        return [(key, value) for key, value in node.value if key.tag == f"{TAG}str"]

    def check_keys(self, node: yaml.MappingNode, path: KeyPath) -> None:
        first: dict[str, int] = {}
        for key, _ in node.value:
            if key.tag == f"{TAG}merge":
                continue
            if key.tag != f"{TAG}str":
                written = key.value[:60] if isinstance(key, yaml.ScalarNode) else "this"
                self.problem(key, path, f"a key must be text, not {written}; quote it")
            elif not _has_bytes(key.value):
                self.problem(key, path, HALF_A_CHARACTER)
            elif key.value in first:
                earlier = self.place(first[key.value])
                message = f"duplicate key, first at {earlier}; remove one"
                self.problem(key, (*path, key.value), message)
            else:
                first[key.value] = key.start_mark.line

    def problem(self, node: yaml.Node, path: KeyPath, message: str) -> None:
        self.problems.append(Problem(self.place(node.start_mark.line), path, message))


def _extent(node: yaml.Node, known: dict[int, tuple[int, int]]) -> tuple[int, int]:
    """Values and levels of a node with its aliases written out; each node is looked at once.

    Raises:
        RecursionError: an alias contains itself.
    """
    if isinstance(node, yaml.ScalarNode):
        return 1, 0
    if id(node) not in known:
        is_mapping = isinstance(node, yaml.MappingNode)
        parts = itertools.chain(*node.value) if is_mapping else node.value
        values, levels = zip((1, 0), *(_extent(part, known) for part in parts), strict=True)
        known[id(node)] = sum(values), 1 + max(levels)
    return known[id(node)]


HALF_A_CHARACTER = "has half a character (a surrogate) in it, which no file can hold"


def scalar(node: yaml.Node) -> str | int | float | bool | None:
    """Convert a scalar by its tag; ValueError, with what is wrong, where that can't be."""
    kind, text = node.tag.removeprefix(TAG), node.value
    pattern = _PATTERNS.get(kind, ".*")
    fits = isinstance(node, yaml.ScalarNode) and re.fullmatch(pattern, text, re.DOTALL)
    match kind if fits else None:
        case "str":
            if not _has_bytes(text):
                raise ValueError(HALF_A_CHARACTER)
            return str(text)
        case "null":
            return None
        case "bool":
            return bool(text.lower() == "true")
        case "int":
            return _whole_number(text)
        case "float":
            # Python writes infinity and NaN without YAML's dot.
            number = float(re.sub(r"\.(inf|nan)", r"\1", text.lower()))
            exact = number.is_integer() and abs(number) < LARGEST_EXACT_INTEGER
            # 5e6 is a whole number, as in `max_steps: 5e6`; 5.0 is not.
            return int(number) if exact and "e" in text.lower() else number
    raise ValueError(f"a value of the type '{kind}' has no place in a run file")


_PATTERNS = {kind: pattern for kind, pattern, _ in CORE_SCHEMA}


def _whole_number(text: str) -> int:
    base = {"0o": 8, "0x": 16}.get(text[:2], 10)
    number = int(text, base) if len(text) <= MOST_DIGITS else math.inf
    if abs(number) > LARGEST_INTEGER:
        raise ValueError(f"should be within +-{LARGEST_INTEGER}, not {shown(text)}")
    return int(number)


def _has_bytes(text: str) -> bool:
    """Whether text can be written; half of a pair of surrogates, by an escape, can not."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def dump(data: Any) -> str:
    """Write plain data as YAML that `parse` reads back equal."""
    options: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "width": 100}
    return str(yaml.dump(data, Dumper=_Dumper, default_flow_style=None, **options))


def dotted(path: KeyPath) -> str:
    """Write a path as the command line takes it: `rewards.0.weight`."""
    return ".".join(map(str, path))


def shown(value: Any, limit: int = 60) -> str:
    """Write a value for a message, short."""
    if isinstance(value, dict):
        text = "{" + ", ".join(f"{key}: {shown(item)}" for key, item in value.items()) + "}"
    elif isinstance(value, list):
        text = "[" + ", ".join(map(shown, value)) + "]"
    elif value is None or isinstance(value, bool):
        text = {None: "null", True: "true", False: "false"}[value]
    else:
        text = repr(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."
