"""Standard streams that can't be written any more."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TextIO

import pytest

from trainers.common.output import falling_silent


def closed_pipe() -> TextIO:
    """A pipe that nobody reads."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


def test_a_closed_pipe_falls_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    with closed_pipe() as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        with pytest.raises(BrokenPipeError):
            print("one", flush=True)
        with falling_silent():
            print("two", flush=True)
        print("after", flush=True)  # nor is anything left that fails when Python ends


def test_a_full_disk_falls_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    with Path("/dev/full").open("w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        with falling_silent():
            print("x" * 10**5)
        print("after", flush=True)


def test_both_streams_are_as_they_were(capsys: pytest.CaptureFixture[str]) -> None:
    before = sys.stdout, sys.stderr
    with falling_silent():
        print("out")
        print("err", file=sys.stderr)
        assert sys.stdout.encoding == before[0].encoding
    assert (sys.stdout, sys.stderr) == before
    assert capsys.readouterr() == ("out\n", "err\n")


def test_there_may_be_no_stream_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    with falling_silent():
        print("nowhere")
