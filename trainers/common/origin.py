"""Where components come from, and which plugin an exception comes from."""

from __future__ import annotations

import importlib.metadata
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from trainers.common.errors import Failure, UserError
from trainers.common.shadowing import PACKAGES
from trainers.hookspecs import PROJECT_NAME


@dataclass(frozen=True)
class Origin:
    """Origin of a component: the plugin, and the distribution that brought it."""

    plugin: str
    """The module of a built-in plugin, or the name of the entry point."""
    distribution: str
    """`name version` of the installed distribution, or `built-in`."""

    def __str__(self) -> str:
        return f"plugin '{self.plugin}' ({self.distribution})"


class PluginFailure(Failure):
    """A plugin raised an exception while it was at work.

    Attributes:
        lines: those of the traceback that are the plugin's own.
    """

    def __init__(self, origin: Origin, error: BaseException, lines: str):
        reason = f"{type(error).__name__}: {error}".removesuffix(": ")
        super().__init__(f"{origin} failed: {reason}")
        self.lines = lines


@contextmanager
def blaming_plugins() -> Iterator[None]:
    """Turns what an installed plugin raises, `sys.exit` included, into a failure that names it.

    It is the plugin's if its code is nearer than ventosa's to where it was raised, so that a
    mistake of ventosa's keeps its whole traceback, also where a plugin called.

    Raises:
        PluginFailure: for exceptions that are a plugin's and not made to be told.
    """
    try:
        yield
    except (Exception, SystemExit) as error:
        failure = _plugin_failure(error)
        if failure is None or is_told(error):
            raise
        raise failure from error


@contextmanager
def blaming(origin: Origin) -> Iterator[None]:
    """Turns what is raised where an installed plugin alone can be wrong into a failure of its.

    Raises:
        PluginFailure: for exceptions that are not made to be told. Those of built-in plugins stay
            as they are.
    """
    try:
        yield
    except Exception as error:
        points = importlib.metadata.entry_points(group=PROJECT_NAME)
        point = next((point for point in points if origin_of(point) == origin), None)
        if point is None or is_told(error):
            raise
        raise _failure(point, error) from error


def is_told(error: BaseException) -> bool:
    """Whether the message of an exception says it all, so that no traceback need be shown."""
    if isinstance(error, (UserError, Failure)):
        return True
    # Imported late, so that commands answer at once.
    from envs.environment import EnvironmentFailure  # noqa: PLC0415
    from rewards.reward import RewardError  # noqa: PLC0415

    return isinstance(error, (EnvironmentFailure, RewardError))


def origin_of(point: importlib.metadata.EntryPoint) -> Origin:
    """Origin of what an entry point brings."""
    found = point.dist
    return Origin(point.name, f"{found.name} {found.version}" if found else "unknown")


def _plugin_failure(error: BaseException) -> PluginFailure | None:
    points = importlib.metadata.entry_points(group=PROJECT_NAME)
    plugins = {point.module.partition(".")[0]: point for point in points}
    packages = [_package(frame) for frame, _ in traceback.walk_tb(error.__traceback__)]
    nearest = next((p for p in reversed(packages) if p in plugins or p in PACKAGES), None)
    return _failure(plugins[nearest], error) if nearest in plugins else None


def _failure(point: importlib.metadata.EntryPoint, error: BaseException) -> PluginFailure:
    """An exception as the failure of a plugin, with the lines of its package."""
    own = [
        entry
        for (frame, _), entry in zip(
            traceback.walk_tb(error.__traceback__),
            traceback.extract_tb(error.__traceback__),
            strict=True,
        )
        if _package(frame) == point.module.partition(".")[0]
    ]
    return PluginFailure(origin_of(point), error, "".join(traceback.format_list(own)))


def _package(frame: FrameType) -> str:
    """The package of the code that a frame runs."""
    return str(frame.f_globals.get("__name__", "")).partition(".")[0]
