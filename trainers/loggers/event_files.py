"""What a run that was cut off logged after its last checkpoint is taken off its event files."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import BinaryIO, NamedTuple

PATTERN = "events.out.tfevents.*"
_LENGTH, _CHECKSUM = struct.Struct("<Q4x"), 4
"""Of a record: its length and that length's checksum, the data, and the data's checksum."""


class _Record(NamedTuple):
    end: int
    """Offset of the next one."""
    step: int
    tags: tuple[str, ...]


def cut_after(directory: Path, step: int) -> set[str]:
    """Cuts a run's event files before the first point of a later step.

    The run goes on from that step and logs those points again: whatever reads the files, and not
    TensorBoard alone, which is told which points are void, finds each point once. A record that
    was cut short, and what follows it, goes too.

    Args:
        directory: the run's.
        step: that of the checkpoint from which the run goes on; points of that step stay.

    Returns:
        The tags of what stays.

    Raises:
        OSError: a file can't be read or cut.
    """
    tags: set[str] = set()
    for path in directory.glob(PATTERN):
        end = 0
        with path.open("rb") as file:
            for record in takewhile(lambda record: record.step <= step, _records(file)):
                end = record.end
                tags.update(record.tags)
        if end < path.stat().st_size:
            os.truncate(path, end)
    return tags


def _records(file: BinaryIO) -> Iterator[_Record]:
    """The records up to the first that is not whole."""
    # Imported late: it takes a second.
    from google.protobuf.message import DecodeError  # noqa: PLC0415
    from tensorboard.compat.proto.event_pb2 import Event  # noqa: PLC0415

    size = os.fstat(file.fileno()).st_size
    while len(header := file.read(_LENGTH.size)) == _LENGTH.size:
        (length,) = _LENGTH.unpack(header)
        if file.tell() + length + _CHECKSUM > size:
            return
        try:
            event = Event.FromString(file.read(length))
        except DecodeError:
            return
        tags = tuple(value.tag for value in event.summary.value)
        yield _Record(file.seek(_CHECKSUM, os.SEEK_CUR), event.step, tags)
