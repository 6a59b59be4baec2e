"""The command, on tiny sizes; how fast anything is, is not looked at."""

from __future__ import annotations

import re
import sys
import time
from functools import partial

import pytest

from benchmarks.speed import __main__ as speed
from benchmarks.speed import parts, processes, ranks, training
from benchmarks.speed.figures import FRAME_GRAB, MODES, OURS, Case
from benchmarks.speed.simulation import frames, steps

TINY = ["--sizes", "32", "--repeats", "2", "--seconds", "0.001", "--num-envs", "16"]


def test_simulators() -> None:
    found = frames("rgb", 32, 2, 2, 0.001) | frames("depth", 32, 2, 2, 0.001)
    assert list(found) == [Case("color frames", 32, "", 2), Case("depth frames", 32, "", 2)]
    for by_contender in found.values():
        assert list(by_contender) == ["fast", "pybullet"]
        assert all(len(s.values) == 2 and s.spread[1] > 0.0 for s in by_contender.values())


def test_environments_pybullet_beside_the_first_number() -> None:
    found = steps("stream", 32, [2, 4], 1, 0.001)
    contenders = {case.num_envs: list(by) for case, by in found.items()}
    assert contenders == {2: ["fast", "pybullet"], 4: ["fast"]}


def test_the_environments_part_tells_how_cost_grows(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(parts, "MODES", {FRAME_GRAB: True})
    assert speed.main([*TINY, "--parts", "environment"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"environment steps │ frame grab │ 32x32 +│ +4 │.+│.+│.+│", shown)
    assert re.search(r"environment steps │ frame grab │ 32x32 +│ +64 │", shown)
    assert re.search(r"grows as N\^-?\d\.\d\d \(32x32, frame grab\)", shown)


def test_training_beside_its_peer() -> None:
    pytest.importorskip("stable_baselines3")
    makers = training.contenders(peer=True)
    found, parameters = training.training("stream", 32, 16, 2, 0.001, makers)
    whats = ["collection steps", "update steps", "training steps"]
    assert [case.what for case in found] == whats
    assert all(list(by) == ["ventosa", "stable-baselines3"] for by in found.values())
    # The whole loop is slower than either of its parts.
    collection, update, whole = (by["ventosa"].values for by in found.values())
    assert all(both < min(each) for *each, both in zip(collection, update, whole, strict=True))
    # Convolutions 4x2x2 + 4 and 8x4x1x1 + 8 leave 8x4x4 of 32x32; two layers, two heads, a std.
    encoder, trunk = 4 * 4 + 4 + 8 * 4 + 8, 128 * 256 + 256 + 256 * 256 + 256
    assert parameters == encoder + trunk + 256 * 4 + 4 + 256 + 1 + 4


def test_training_of_ranks() -> None:
    makers = training.contenders(peer=False, ours=partial(ranks.OfRanks, 2))
    found, parameters = training.training("frame grab", 32, 16, 2, 0.001, makers)
    collection, update, whole = (by["ventosa"].values for by in found.values())
    assert all(both < min(each) for *each, both in zip(collection, update, whole, strict=True))
    assert parameters > 100_000


def test_ranks_that_end_are_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranks, "torchrun", lambda *_: [sys.executable, "-c", "raise SystemExit(1)"])
    with pytest.raises(RuntimeError, match="ranks have ended"):
        ranks.OfRanks(2, training.load(32, FRAME_GRAB, 16))


def test_without_the_extra_the_rest_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(parts, "MODES", {FRAME_GRAB: True})
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    assert speed.main([*TINY, "--parts", "training"]) == 0
    shown = capsys.readouterr().out
    assert "pip install 'ventosa[bench]'" in shown
    assert "training steps" in shown
    assert "stable-baselines3 │" not in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeats", "0"], "--repeats must be at least 1"),
        (["--num-envs", "15"], "--num-envs must be at least 16"),
        (["--sizes", "64"], "invalid choice"),
    ],
)
def test_mistakes_are_named(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        speed.parse(arguments)
    assert caught.value.code == 2
    assert message in capsys.readouterr().err


def test_the_parts_are_those_of_the_command_line() -> None:
    assert tuple(parts.PARTS) == speed.PARTS


@pytest.mark.parametrize("mode", MODES)
def test_the_run_has_what_is_measured(mode: str) -> None:
    run = training.load(80, mode, 64)
    environment, hyper = run.environment.settings, run.trainer.settings.hyperparameters
    assert (environment.num_envs, environment.frame_grab) == (64, mode == FRAME_GRAB)
    assert (environment.cameras["depth"].width, environment.cameras["depth"].height) == (80, 80)
    assert hyper.buffer_size == 32 * 64
    assert hyper.buffer_size % hyper.batch_size == 0


def test_networks_of_different_sizes_are_no_comparison() -> None:
    class Sized:
        def __init__(self, parameters: int):
            self.parameters = parameters

        def learn(self) -> None: ...

        def close(self) -> None: ...

    with pytest.raises(RuntimeError, match=r"parameters: \{'a': 5, 'b': 6\}"):
        training.training(
            FRAME_GRAB, 32, 16, 1, 0.0, {"a": lambda run: Sized(5), "b": lambda run: Sized(6)}
        )


def test_memory_is_that_of_a_process_of_its_own() -> None:
    # torch alone has more than 100 MiB.
    assert 100 < processes.peak_mib(OURS, 32, "stream", 16) < 10_000


def test_a_process_that_fails_says_why() -> None:
    with pytest.raises(RuntimeError, match=r"encoders\.depth"):
        processes.peak_mib(OURS, 33, "stream", 16)


def test_the_main_job_is_started_up_to_its_first_step() -> None:
    before_s = time.monotonic()
    assert before_s < processes.first_step_time_s() <= time.monotonic()
