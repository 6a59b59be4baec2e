"""The command, on tiny sizes; how fast anything is, is not looked at."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from benchmarks.speed import __main__ as throughput
from benchmarks.speed import training
from benchmarks.speed.figures import OURS
from benchmarks.speed.processes import first_step_time_s, footprints
from benchmarks.speed.setup import Setup

TINY = ["--sizes", "32", "--repeats", "2", "--seconds", "0.001", "--num-worlds", "2"]
TINY += ["--num-envs", "2", "4", "--train-envs", "16"]


def run(tmp_path: Path, *arguments: str) -> dict[str, Any]:
    report = tmp_path / "folder" / "report.json"
    assert throughput.main([*TINY, "--json", str(report), *arguments]) == 0
    return dict(json.loads(report.read_text()))


def cases(report: dict[str, Any]) -> set[tuple[str, str, str, int]]:
    return {(f["what"], f["mode"], f["contender"], f["num_envs"]) for f in report["figures"]}


def test_simulators_and_environments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    report = run(tmp_path, "--parts", "simulator", "environment")
    both = ("fast", "pybullet")
    frames = {(f"{kind} frames", "", name, 2) for kind in ("depth", "color") for name in both}
    steps = {
        ("environment steps", mode, name, n)
        for mode in ("frame grab", "stream")
        for name, n in (("fast", 2), ("fast", 4), ("pybullet", 2))
    }
    assert cases(report) == frames | steps
    assert all(len(f["samples"]) == 2 and f["range"][0] > 0.0 for f in report["figures"])
    assert [(g["size"], g["mode"]) for g in report["growth"]] == [
        (32, "frame grab"),
        (32, "stream"),
    ]
    shown = capsys.readouterr().out
    assert "times as fast" in shown
    assert "N^" in shown


def test_training_beside_its_peer(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("matplotlib")
    picture = tmp_path / "new" / "speed.png"
    report = run(tmp_path, "--parts", "training", "--picture", str(picture))
    assert cases(report) == {
        (what, mode, name, 16)
        for what in ("collection steps", "update steps", "training steps")
        for mode in ("frame grab", "stream")
        for name in ("ventosa", "stable-baselines3")
    }
    assert picture.stat().st_size > 10_000
    # Convolutions 4x2x2 + 4 and 8x4x1x1 + 8 leave 8x4x4 of 32x32; two layers, two heads, a std.
    encoder, trunk = 4 * 4 + 4 + 8 * 4 + 8, 128 * 256 + 256 + 256 * 256 + 256
    assert report["parameters"] == {"32": encoder + trunk + 256 * 4 + 4 + 256 + 1 + 4}


def test_without_the_extra_the_rest_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(throughput, "installed", lambda module: False)
    report = run(tmp_path, "--parts", "training")
    assert {f["contender"] for f in report["figures"]} == {OURS}
    assert "pip install -c constraints.txt -e '.[bench]'" in capsys.readouterr().out.replace(
        "\n", " "
    )


def test_a_picture_without_matplotlib_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(throughput, "installed", lambda module: module != "matplotlib")
    assert throughput.main([*TINY, "--picture", str(tmp_path / "speed.png")]) == 2
    assert "pip install -c constraints.txt -e '.[bench]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeats", "0"], "--repeats must be at least 1"),
        (["--num-envs", "64", "0"], "--num-envs must be at least 1"),
        (["--sizes", "64"], "invalid choice"),
        (["--train-envs", "8"], "--train-envs must be at least 16"),
    ],
)
def test_mistakes_are_named(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        throughput.parse(arguments)
    assert caught.value.code == 2
    assert message in capsys.readouterr().err


def test_quick_gives_way_to_what_is_said() -> None:
    options = throughput.parse(["--quick", "--sizes", "128"])
    assert (options.sizes, options.repeats, options.seconds) == ([128], 3, 0.5)
    assert throughput.parse([]).sizes == (32, 80, 128, 256)


def test_networks_of_different_sizes_are_no_comparison() -> None:
    class Larger:
        def __init__(self, setup: Setup, parameters: int):
            self.parameters = parameters

        def learn(self) -> None: ...

        def close(self) -> None: ...

    makers = {"a": lambda setup: Larger(setup, 5), "b": lambda setup: Larger(setup, 6)}
    with pytest.raises(RuntimeError, match=r"parameters: \{'a': 5, 'b': 6\}"):
        training.measure(Setup(), 1, 0.0, makers)


def test_memory_is_that_of_a_process_of_its_own() -> None:
    (found,) = footprints(Setup(size=32, num_envs=16), [OURS], modes=["stream"])
    assert (found.contender, found.size, found.mode) == (OURS, 32, "stream")
    # torch alone has more than 100 MiB.
    assert 100 < found.peak_mib < 10_000


def test_a_process_that_fails_says_why() -> None:
    with pytest.raises(RuntimeError, match="ValidationError"):
        footprints(Setup(size=33), [OURS], modes=["stream"])


def test_the_main_job_is_started_up_to_its_first_step() -> None:
    before_s = time.monotonic()
    assert before_s < first_step_time_s() <= time.monotonic()
