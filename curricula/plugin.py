"""The curricula that ventosa brings along."""

from curricula.lessons import Lessons
from trainers.hookspecs import hookimpl


@hookimpl
def ventosa_curricula() -> dict[str, type]:
    """Built-in curricula by name."""
    return {"lessons": Lessons}
