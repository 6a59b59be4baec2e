"""The folder of an evaluation's figures and pictures; what is not its own there is left alone."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from trainers.common.errors import UserError
from trainers.common.files import read_json, temporary, write_atomically

EVALUATION = "evaluation"
REPORT = "evaluation.json"
FILES = "files"


class EvaluationFolder:
    """Files that one evaluation writes, and the next one may replace.

    Which files are its own is written in the report beside them.

    Args:
        folder: where to; it is made where it does not exist.
        names: of the files.

    Raises:
        UserError: something else is in their place, or the folder can't be made.
    """

    def __init__(self, folder: Path, names: Iterable[str]):
        self._folder, self._names = folder, tuple(names)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            own = own_names(folder)
            taken = [name for name in (REPORT, *self._names) if (folder / name).exists()]
            foreign = [name for name in taken if name not in own]
        except OSError as error:
            raise UserError(f"--render: {folder}: can't be used: {error.strerror}") from error
        if foreign:
            raise UserError(
                f"--render: {folder / foreign[0]} is there already, and no evaluation's of before: "
                "choose another folder, --render DIR"
            )

    def write(self, report: dict[str, Any], files: Iterable[tuple[str, bytes]]) -> None:
        """Writes the report, and files by their names.

        Raises:
            UserError: they can't be written.
        """
        listed = json.dumps({**report, FILES: self._names}, indent=2) + "\n"
        try:
            write_atomically(self._folder / REPORT, listed)
            for name, content in files:
                write_atomically(self._folder / name, content)
        except OSError as error:
            raise UserError(f"--render: {error.filename}: {error.strerror}") from error


def own_names(folder: Path) -> set[str]:
    """Names of an evaluation's report and of the files it lists; none if it is no evaluation's.

    With those under which they are written, as an evaluation that was killed leaves them.
    """
    try:
        names = {REPORT, *read_json(folder / REPORT)[FILES]}
    except FileNotFoundError:
        return {temporary(folder / REPORT).name}
    except (ValueError, KeyError, TypeError):
        return set()
    return names | {temporary(folder / name).name for name in names}
