"""The model of what ranks cost each other."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

import benchmarks.ranks.__main__ as command
from benchmarks.ranks.model import (
    Measured,
    Model,
    Network,
    _line,
    expected_maximum,
    own_deviation,
)
from benchmarks.ranks.rank import of_ranks
from trainers.runfile.registry import load_registries

ROOT = Path(__file__).parents[3]

MODEL = Model(
    cores=2,
    collection_s=0.1,
    learning_s=0.4,
    sums=32,
    gradient_bytes=2e6,
    latency_s=1e-4,
    bytes_per_s=4e9,
    deviation=0.05,
    gathers_s=(0.004, 0.001),
    tries=10,
)


def measured(ranks: int) -> Measured:
    """What a machine would show that is just as the model says."""
    turns = max(1.0, ranks / MODEL.cores)
    alone = ranks == 1
    return Measured(
        apart_s=0.5 * turns,
        together_s=MODEL.update_s(ranks, MODEL.cores),
        collection_s=0.1,
        learning_s=0.4,
        sums_s=0.0 if alone else 32 * 6e-4,
        gathers_s=0.0 if alone else turns * (0.004 + 0.001 * ranks),
        waiting_s=0.0 if alone else 0.4 * 0.05 * expected_maximum(ranks),
        sums=0 if alone else 32,
        gradient_bytes=2e6,
        sum_s={} if alone else {4: 1e-4 + 1e-9, 400: 1e-4 + 1e-7, 4_000_000: 1.1e-3},
        checkpoint_s=0.0,
        checkpoint_bytes=0,
        tries=10,
    )


def test_the_expected_maximum_of_normal_numbers() -> None:
    """Exact for two and for three (David and Nagaraja, Order Statistics, 3.2)."""
    assert expected_maximum(1) == pytest.approx(0.0, abs=1e-3)
    assert expected_maximum(2) == pytest.approx(1.0 / math.sqrt(math.pi), rel=1e-3)
    assert expected_maximum(3) == pytest.approx(1.5 / math.sqrt(math.pi), rel=1e-3)


def test_an_update_by_hand() -> None:
    assert MODEL.update_s(1, 2) == pytest.approx(0.5)
    waiting_s, sums_s = 0.4 * 0.05 / math.sqrt(math.pi), 32 * (1e-4 + 2e6 / 4e9)
    two_s = 0.5 + waiting_s + 0.006 + sums_s
    assert MODEL.update_s(2, 2) == pytest.approx(two_s, rel=1e-4)
    # Two that take turns on a core do the same with half the cores, but for telling gradients.
    assert MODEL.update_s(2, 1) == pytest.approx(2 * (two_s - sums_s) + sums_s, rel=1e-4)
    assert MODEL.efficiency(2) == pytest.approx(0.5 / two_s, rel=1e-4)


def test_a_network_sends_nearly_all_bytes_twice() -> None:
    network = Network("", latency_s=1e-5, bytes_per_s=1e9)
    assert network.sum_s(2, 1e6) == pytest.approx(2e-5 + 1e-3)
    assert network.sum_s(64, 1e6) == pytest.approx(12e-5 + 2e-3 * 63 / 64)
    # Who shares no memory waits for who has most of a minibatch, too.
    assert own_deviation(2, 10) == pytest.approx(math.sqrt(0.5 / 25.6))
    # A stream has an image for each action, and so ten times as many to even out.
    assert own_deviation(2, 1) == pytest.approx(math.sqrt(0.5 / 256))
    few = replace(MODEL, deviation=0.0, gathers_s=(0.0, 0.0), sums=0)
    waiting_s = 0.4 * own_deviation(64, 10) * expected_maximum(64)
    assert few.update_s(64, 64, network) == pytest.approx(0.5 + waiting_s)


@pytest.mark.parametrize("counts", [(1, 2), (1, 2, 4, 8)])
def test_a_fit_finds_the_model_that_was_measured(counts: tuple[int, ...]) -> None:
    found = Model.fit({ranks: measured(ranks) for ranks in counts}, cores=2)
    for ranks in counts:
        assert found.update_s(ranks, 2) == pytest.approx(MODEL.update_s(ranks, 2), rel=1e-4)
    assert found.deviation == pytest.approx(MODEL.deviation)
    assert found.bytes_per_s == pytest.approx(MODEL.bytes_per_s, rel=1e-3)


@pytest.mark.parametrize(
    ("seconds", "line"),
    [
        ([4.0, 6.0, 10.0], (2.0, 1.0)),
        ([3.0, 2.0, 1.0], (2.0, 0.0)),
        ([1.0, 3.0, 7.0], (0.0, 5 / 6)),
    ],
)
def test_a_line_that_neither_falls_nor_begins_below_zero_fits_best(
    seconds: list[float], line: tuple[float, float]
) -> None:
    assert _line([2, 4, 8], seconds) == pytest.approx(line, abs=0.02)


@pytest.mark.parametrize("name", ["config/gymnasium/pendulum_ppo", "benchmarks/ranks/stream"])
def test_run_files_of_any_environment_can_be_measured(name: str) -> None:
    run = of_ranks(ROOT / f"{name}.yaml", load_registries(), 2)
    assert getattr(run.environment.settings, "workers", 1) == 1


def test_what_was_measured_is_the_median_of_all_rounds(tmp_path: Path) -> None:
    names = ("apart", "together", "collection", "learning", "sums", "gathers", "waiting")
    paths = [tmp_path / f"{number}.json" for number in range(2)]
    for path, values in zip(paths, [(1.0, 9.0), (2.0,)], strict=True):
        turns = [{**{f"{name}_s": value for name in names}, "sums": 3} for value in values]
        told = {"sum_s": {"4": values[0]}, "gradient_bytes": 8}
        rest = {"checkpoint_s": 0.5, "checkpoint_bytes": 100, "tries": 10}
        path.write_text(json.dumps({"turns": turns, **told, **rest}))
    found = Measured.read(paths)
    assert (found.together_s, found.sums, found.sum_s) == (2.0, 3, {4: 1.5})


def test_the_page_has_what_was_measured_and_what_is_predicted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "scale.md"
    page.write_text("before\n<!-- ranks -->\nold\n<!-- end of ranks -->\nafter\n")
    monkeypatch.setattr(command, "usable_cores", lambda: 2)
    monkeypatch.setattr(command, "measure", lambda *_: {k: measured(k) for k in (1, 2, 4)})
    assert command.main(["--counts", "1", "2", "4", "--page", str(page)]) == 0
    lines = page.read_text().splitlines()
    assert (lines[0], lines[-1], "old" in lines) == ("before", "after", False)
    rows = {cells[1].strip(): cells[2:-1] for line in lines if len(cells := line.split("|")) > 3}
    rows = {name: [cell.strip() for cell in cells] for name, cells in rows.items()}
    two_ms, four_ms = (1e3 * MODEL.update_s(ranks, 2) for ranks in (2, 4))
    assert rows["all of it"] == ["500", f"{two_ms:.0f}", f"{four_ms:.0f}"]
    assert rows["as the model has it"] == rows["all of it"]
    # Four ranks take turns on two cores.
    efficiencies = [f"{500 / two_ms:.0%}", f"{1000 / four_ms:.0%}"]
    assert rows["efficiency"] == ["100%", *efficiencies]
    assert rows["a sum"] == ["", "0.60", "0.60"]
    assert rows["64"][0] == f"{MODEL.efficiency(64):.0%}"
    shared, slow, fast = (float(cell.rstrip("%")) for cell in rows["1,024"])
    assert shared > fast > slow


def test_one_rank_and_several_are_needed(capsys: pytest.CaptureFixture[str]) -> None:
    for counts in (["1"], ["2", "4"]):
        with pytest.raises(SystemExit):
            command.main(["--counts", *counts])
        assert "--counts: one rank, and several" in capsys.readouterr().err
