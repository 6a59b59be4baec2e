"""Whose code runs: a policy's run file is a stranger's, and has nothing imported unasked."""

from __future__ import annotations

import importlib
import importlib.metadata
import sys

from trainers.common.errors import UserError
from trainers.hookspecs import PROJECT_NAME
from trainers.runfile.settings import RunSettings


def check_imports(run: RunSettings, origin: str, *, trust: bool = False) -> None:
    """Sees to it that building a policy's environment imports nothing that nobody asked for.

    Modules that have been imported may be named, and those of installed plugins' packages.

    Args:
        run: what came with the policy.
        origin: what to call it in messages.
        trust: import the other ones, too, here and now.

    Raises:
        UserError: there are others, or one can't be imported.
    """
    for module in run.environment.cls.imports(run.environment.settings):
        if module in sys.modules or _is_of_a_plugin(module):
            continue
        if not trust:
            raise UserError(
                f"{origin}: its environment imports the module {module!r}, and whatever code is "
                "there runs: if you trust it, say --trust, or in Python import it before"
            )
        try:
            importlib.import_module(module)
        except Exception as error:  # a module can fail in any way while it is imported
            raise UserError(
                f"{origin}: the module {module!r}, which its environment needs, can't be imported: "
                f"{type(error).__name__}: {error}"
            ) from error


def needs_trust(run: RunSettings) -> bool:
    """Whether a command has to be told to trust what the run's environment imports."""
    modules = run.environment.cls.imports(run.environment.settings)
    return not all(map(_is_of_a_plugin, modules))


def _is_of_a_plugin(module: str) -> bool:
    """Whether a module is in the package of an installed plugin."""
    points = importlib.metadata.entry_points(group=PROJECT_NAME)
    return module.partition(".")[0] in {point.module.partition(".")[0] for point in points}
