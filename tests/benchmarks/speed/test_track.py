"""A history of speed: what is a line of it, and what has fallen."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from benchmarks.speed import track
from benchmarks.speed.figures import FAST, OURS, PEER, PYBULLET, Case, Samples
from trainers.common.errors import UserError

MACHINE = {"cores": 2, "processor": "EPYC", "python": "3.11.9", "packages": {"torch": "2.13.0"}}
FRAMES, LOOP = "depth frames", "training steps"


def line(frames: float = 90.0, loop: float = 5.0, speed: float = 1e5, **others: Any) -> track.Line:
    """A line with ratios of the simulators and of the loop, and the speed of `fast`."""
    plain = {
        "date": "2026-11-26T12:00:00+00:00",
        "revision": "0123456789abcdef",
        "dirty": False,
        "machine": MACHINE,
        "ratios": {FRAMES: [frames, 1.0, 200.0], LOOP: [loop, 1.0, 9.0]},
        "per_second": {
            FRAMES: {FAST: [speed, 1.0, 1e6], PYBULLET: [1e3, 1e3, 1e3]},
            LOOP: {OURS: [6000.0, 1.0, 1e4], PEER: [1e3, 1e3, 1e3]},
        },
    }
    return track.Line.model_validate(plain | others)


def written(path: Path, *lines: track.Line) -> Path:
    path.write_text("".join(f"{one.model_dump_json()}\n" for one in lines))
    return path


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> track.Line:
    """What is measured and where, without measuring; the ratios are 2 in every round."""
    monkeypatch.setattr(track, "revision", lambda path: ("abc", True))
    machine = track.Machine.model_validate(MACHINE)
    monkeypatch.setattr(track, "this_machine", lambda: machine)
    figures = {
        Case(FRAMES, 80, "", 256): {
            FAST: Samples((4.0, 2.0, 8.0)),
            PYBULLET: Samples((2.0, 1.0, 4.0)),
        },
        Case(LOOP, 80, "frame grab", 256): {OURS: Samples((6.0,)), PEER: Samples((3.0,))},
    }
    monkeypatch.setattr(track, "measure", lambda: figures)
    return track.line_of(figures, "abc", dirty=True)


def test_a_line_has_medians_and_ranges_of_ratios_and_speeds(measured: track.Line) -> None:
    assert (measured.revision, measured.dirty) == ("abc", True)
    assert measured.ratios == {FRAMES: (2.0, 2.0, 2.0), LOOP: (2.0, 2.0, 2.0)}
    assert measured.per_second[FRAMES] == {FAST: (4.0, 2.0, 8.0), PYBULLET: (2.0, 1.0, 4.0)}


def test_a_line_is_added_and_what_was_there_is_kept(tmp_path: Path, measured: track.Line) -> None:
    path = tmp_path / "new" / "history.jsonl"
    assert track.track(path) == 0
    first = path.read_text()
    assert track.track(path) == 0
    assert path.read_text().startswith(first)
    assert [one.ratios for one in track.read(path)] == [measured.ratios] * 2
    assert all(set(json.loads(text)) == set(track.Line.model_fields) for text in first.splitlines())


@pytest.mark.parametrize(
    ("earlier", "code", "said"),
    [
        ({"frames": 2.2, "loop": 2.0, "speed": 4.0}, 0, "nothing fell by more than 10%"),
        (
            {"frames": 2.5, "loop": 2.0, "speed": 4.0},
            1,
            "depth frames, times the peer's: 2.5 -> 2 (-20%)",
        ),
        ({"frames": 1.0, "loop": 1.0, "speed": 8.0}, 0, "depth frames a second: 8 -> 4 (-50%)"),
    ],
)
def test_falls_are_said_and_only_ratios_fail(
    earlier: dict[str, float],
    code: int,
    said: str,
    tmp_path: Path,
    measured: track.Line,
    capsys: pytest.CaptureFixture[str],
) -> None:
    speeds = {LOOP: {OURS: [6.0, 6.0, 6.0]}, FRAMES: {FAST: [earlier["speed"]] * 3}}
    path = written(tmp_path / "history.jsonl", line(**earlier, per_second=speeds))
    assert track.track(path) == code
    shown = capsys.readouterr().out
    assert "since 0123456789ab of 2026-11-26" in shown
    assert said in shown


def test_only_the_last_line_of_a_like_machine_counts(
    tmp_path: Path, measured: track.Line, capsys: pytest.CaptureFixture[str]
) -> None:
    larger = MACHINE | {"cores": 64}
    newer = MACHINE | {"python": "3.12.1"}  # still the same machine
    path = written(
        tmp_path / "history.jsonl",
        line(frames=900.0, revision="first"),
        line(frames=2.0, loop=2.0, revision="second", machine=newer),
        line(frames=900.0, revision="third", machine=larger),
    )
    assert track.track(path) == 0
    assert "since second of" in capsys.readouterr().out
    written(path, line(machine=larger))
    assert track.track(path) == 0
    assert "nothing to compare with" in capsys.readouterr().out


def test_a_tenth_less_is_tolerated_and_new_figures_are_not_compared() -> None:
    before = {"a": (100.0, 1.0, 1.0), "b": (100.0, 1.0, 1.0), "gone": (1.0, 1.0, 1.0)}
    now = {"a": (90.0, 1.0, 1.0), "b": (89.9, 1.0, 1.0), "new": (1.0, 1.0, 1.0)}
    assert track.fallen(before, now) == {"b": "100 -> 89.9 (-10%)"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "Expecting property name"),
        ("", "Expecting value"),
        ("[]", "should be a mapping"),
        (line().model_dump_json().replace('"dirty"', '"durty"'), "durty"),
        (line().model_dump_json().replace("90.0", "-90.0"), "ratios"),
        (line().model_dump_json().replace("90.0", '"90"'), "ratios"),
    ],
)
def test_a_malformed_line_is_refused_with_file_and_line(
    text: str, message: str, tmp_path: Path, measured: track.Line
) -> None:
    path = written(tmp_path / "history.jsonl", line())
    before = path.read_text() + text + "\n"
    path.write_text(before)
    with pytest.raises(UserError, match=rf"history\.jsonl:2: .*{message}"):
        track.track(path)
    assert path.read_text() == before


def test_what_is_no_file_is_refused(tmp_path: Path, measured: track.Line) -> None:
    with pytest.raises(UserError, match="can't be read as a history"):
        track.track(tmp_path)


def test_the_revision_and_whether_files_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track, "ROOT", tmp_path)
    history = tmp_path / "history.jsonl"
    with pytest.raises(UserError, match="--track notes the git commit"):
        track.revision(history)

    def git(*arguments: str) -> str:
        settings = ["-c", "user.name=a", "-c", "user.email=a@b"]
        command = ["git", *settings, *arguments]
        return subprocess.run(
            command, cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout

    git("init")
    (tmp_path / "code.py").write_text("1")
    git("add", ".")
    git("commit", "-m", "first")
    history.write_text("{}")
    assert track.revision(history) == (git("rev-parse", "HEAD").strip(), False)
    (tmp_path / "code.py").write_text("2")
    assert track.revision(history)[1]
