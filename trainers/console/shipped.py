"""Run files and policies that come with ventosa: in a clone, or beside an installed wheel."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import yaml

from trainers.common.errors import Failure
from trainers.common.shadowing import HOME

CONFIG, POLICIES = "config", "policies"
SENTINEL = f"{CONFIG}/run.yaml"
NAMED_FILES = ("extends", "run")
"""Keys by which a run file names its base, and a sweep its run file, as seen from itself."""
MODELINE = "# yaml-language-server: $schema="
"""In a run file's first line, before the schema that editors check it by, as seen from it."""


def shipped_folder() -> Path:
    """The folder that has `config` and `policies`.

    Raises:
        Failure: there is none, as in a wheel that was taken apart.
    """
    if (HOME / SENTINEL).is_file():
        return HOME
    try:
        installed = files("ventosa") or []
    except PackageNotFoundError:
        installed = []
    for file in installed:
        if file.as_posix().endswith(f"share/ventosa/{SENTINEL}"):
            return Path(file.locate()).resolve().parents[1]
    raise Failure("the run files that come with ventosa are not here: install it anew")


def run_files(folder: Path) -> dict[str, Path]:
    """Run files and sweeps by name, such as `quick` and `paper/lstm`."""
    config = folder / CONFIG
    paths = sorted(config.rglob("*.yaml"), key=lambda path: (len(path.parts), path))
    return {path.relative_to(config).with_suffix("").as_posix(): path for path in paths}


def policies(folder: Path) -> dict[str, Path]:
    """Folders of trained policies by name, `policies/` and the folder's."""
    return {f"{POLICIES}/{path.name}": path for path in sorted((folder / POLICIES).iterdir())}


def with_named_files(path: Path) -> Iterator[Path]:
    """A run file, those that it takes to read it, and last the schemas of them all."""
    yield path
    text = path.read_text("utf-8")
    content = yaml.safe_load(text)
    for key in NAMED_FILES:
        if key in content:
            yield from with_named_files((path.parent / content[key]).resolve())
    first = text.partition("\n")[0]
    if first.startswith(MODELINE):
        yield (path.parent / first.removeprefix(MODELINE)).resolve()


def title(path: Path) -> str:
    """The first sentence of a run file's comments, or of a policy's card."""
    if path.is_dir():
        lines = (path / "README.md").read_text("utf-8").splitlines()
        said = [line for line in lines if not line.startswith("#")]
    else:
        lines = path.read_text("utf-8").splitlines()
        said = [line[2:] for line in lines if line.startswith("# ") and "$schema" not in line]
    return " ".join(said).strip().partition(". ")[0].rstrip(".")
