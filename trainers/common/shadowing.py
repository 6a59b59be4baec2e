"""Packages of other people that have a name of ours, and would be imported in its place."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

PACKAGES = ("trainers", "envs", "encoders", "rewards", "curricula")
"""Of ventosa."""
HOME = Path(__file__).resolve().parents[2]
"""The folder that they are in."""
MISTAKE = 2
"""Exit code; see `trainers.common.command`, which takes longer to import."""


def refuse_other_packages() -> None:
    """Begins nothing where another package would be imported in the place of one of ours.

    Raises:
        SystemExit: a command is beginning; the message is told.
        ImportError: somebody else imports ventosa.
    """
    message = shadowed()
    if message is None:
        return
    # Python says "-m" for as long as it looks for the module.
    if sys.argv[0] == "-m" or Path(sys.argv[0]).stem == "ventosa":
        print(f"error: {message}", file=sys.stderr)
        sys.exit(MISTAKE)
    raise ImportError(message)


def shadowed() -> str | None:
    """What is in the place of one of our packages, and the way out; None: nothing is."""
    for package in PACKAGES:
        found = _location(package)
        if found not in (None, HOME / package):
            return f"{found} would be imported in the place of {HOME / package}: {_way_out(found)}"
    return None


def _location(package: str) -> Path | None:
    spec = importlib.util.find_spec(package)
    if spec is None:
        return None
    folders = list(spec.submodule_search_locations or ())  # a folder needs no __init__.py
    return Path(folders[0] if folders else spec.origin or "").resolve()


def _way_out(found: Path) -> str:
    if found.parent == Path.cwd():
        return (
            "the current folder is searched first; say `ventosa COMMAND` instead of "
            "`python -m trainers.COMMAND`, go to another folder, or rename it"
        )
    # Imported late: it takes longer than all that comes before.
    from importlib.metadata import packages_distributions  # noqa: PLC0415

    owners = set(packages_distributions().get(found.stem, ())) - {"ventosa"}
    return (
        f"{' and '.join(sorted(owners)) or 'something else'} has a package of that name; use a "
        "virtual environment without it"
    )
