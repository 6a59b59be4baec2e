"""What commands have in common: exit codes, and how what goes wrong is told."""

from __future__ import annotations

import functools
import importlib.util
import sys
from collections.abc import Callable
from typing import ParamSpec

from trainers.common.errors import UserError
from trainers.common.origin import PluginFailure, blaming_plugins, is_told
from trainers.common.output import falling_silent

DONE, FAILED, MISTAKE, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143
"""Exit codes."""
P = ParamSpec("P")


def tells_failures(main: Callable[P, int]) -> Callable[P, int]:
    """A command that tells mistakes and failures in a line, with their exit codes.

    What is neither is a bug of ventosa's, and keeps its traceback.
    """

    @functools.wraps(main)
    def command(*arguments: P.args, **options: P.kwargs) -> int:
        with falling_silent():
            try:
                with blaming_plugins():
                    return main(*arguments, **options)
            except KeyboardInterrupt:
                return INTERRUPTED
            except Exception as error:
                if not is_told(error):
                    raise
                print(f"error: {told(error)}", file=sys.stderr)
                if isinstance(error, PluginFailure):
                    print(error.lines, end="", file=sys.stderr)
                return MISTAKE if isinstance(error, UserError) else FAILED

    return command


def require_extra(extra: str, *packages: str) -> None:
    """Refuses to begin without packages of one of ventosa's extras.

    Raises:
        UserError: names one that is missing, and the command that installs it.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise UserError(f"{package} is not installed: pip install 'ventosa[{extra}]'")


def told(error: BaseException) -> str:
    """An exception in a line, with the notes that were added to it."""
    message = str(error) if is_told(error) else f"{type(error).__name__}: {error}"
    return "; ".join([message, *getattr(error, "__notes__", ())])
