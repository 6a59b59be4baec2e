"""The rooms of the house: who may import whom, and no circles."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("trainers", "envs", "encoders", "rewards", "curricula", "benchmarks")
LEAVES = {"trainers.hookspecs", "trainers.common.cores"}
"""May be imported by everybody, and import nothing of the project."""
ROOMS = {
    "trainers.common": set(),
    "trainers.networks": {"trainers.common"},
    "trainers.distributed": {"trainers.common"},
    "trainers.experience": {"trainers.distributed", "trainers.networks", "trainers.common"},
    "trainers.algorithms": {
        "trainers.distributed",
        "trainers.experience",
        "trainers.networks",
        "trainers.common",
    },
    "trainers.loggers": {"trainers.common"},
    "trainers.runfile": {"trainers.loggers", "trainers.common"},
    "trainers.saving": {"trainers.runfile", "trainers.loggers", "trainers.common"},
    "trainers.inference": {
        "trainers.networks",
        "trainers.saving",
        "trainers.runfile",
        "trainers.common",
    },
    "trainers.reporting": {
        "trainers.experience",
        "trainers.networks",
        "trainers.loggers",
        "trainers.common",
    },
    "trainers.comparison": {
        "trainers.reporting",
        "trainers.saving",
        "trainers.runfile",
        "trainers.common",
    },
}
"""Rooms of `trainers`, and those below each; its own files are the spine, above all of them."""
BELOW = {
    "encoders": set(),
    "curricula": set(),
    "rewards": set(),
    "envs": {"encoders", "curricula", "rewards"},
    "trainers": {"encoders", "curricula", "rewards", "envs"},
    "benchmarks": {"encoders", "curricula", "rewards", "envs", "trainers"},
}
"""Packages, and those below each."""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules() -> dict[str, Path]:
    return {module_name(p): p for package in PACKAGES for p in (ROOT / package).rglob("*.py")}


def imports_of(path: Path, known: dict[str, Path]) -> set[str]:
    """The project's modules that a module imports, wherever in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            below = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= (below & known.keys()) or {node.module}
    return found & known.keys()


GRAPH = {name: imports_of(path, modules()) for name, path in modules().items()}


def room_of(module: str) -> str:
    """The room of a module of `trainers`; that of its own files is `trainers`."""
    return next((room for room in ROOMS if module.startswith(f"{room}.")), "trainers")


@pytest.mark.parametrize("leaf", LEAVES)
def test_leaves_import_nothing_of_the_project(leaf: str) -> None:
    assert not GRAPH[leaf]


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_downwards(package: str) -> None:
    upwards = [
        f"{module} imports {other}"
        for module, others in GRAPH.items()
        for other in others - LEAVES
        if module.split(".")[0] == package and other.split(".")[0] not in BELOW[package] | {package}
    ]
    assert not upwards


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_import_downwards(room: str) -> None:
    upwards = [
        f"{module} imports {other}"
        for module, others in GRAPH.items()
        for other in others - LEAVES
        if room_of(module) == room
        and module.startswith(room)
        and other.startswith("trainers.")
        and room_of(other) not in ROOMS[room] | {room}
    ]
    assert not upwards


def test_there_is_no_circle() -> None:
    TopologicalSorter(GRAPH).prepare()


def test_no_folder_has_more_files_than_one_finds_one_in() -> None:
    folders: dict[Path, int] = {}
    for path in modules().values():
        folders[path.parent] = folders.get(path.parent, 0) + (path.name != "__init__.py")
    assert {str(folder): n for folder, n in folders.items() if n > 15} == {}
