"""The report on runs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trainers.comparison import report
from trainers.comparison.results import REWARD, SPEED, RunResult

PNG = b"\x89PNG"


def run(seed: int, *rewards: float, **status: Any) -> RunResult:
    steps = 100 * np.arange(1, len(rewards) + 1)
    curves = {
        REWARD: (steps, np.array(rewards)),
        SPEED: (steps, np.full(len(steps), 100.0 / 3600.0)),
    }
    known = {"state": "finished", "step": 100 * len(rewards)} | status
    return RunResult(Path(f"run-{seed}"), {"seed": seed}, known, curves)


def test_a_row_by_hand() -> None:
    runs = [
        run(0, 1.0, 5.0, 3.0, lesson=2, lessons=19, success=0.25),
        run(1, 2.0, 4.0, lesson=4, lessons=19, success=0.5),
        run(2, 0.0, 9.0, 9.0, lesson=3, lessons=19, success=0.75),
    ]
    assert report.row("mine", runs) == [
        "mine",
        "3",
        "300",
        "4 (3 to 9)",
        "5 (4 to 9)",
        "50 % (25 to 75)",
        "3 of 19",
        "3.00",
        "finished",
    ]


def test_large_numbers_are_written_out() -> None:
    assert report.spread([-1234.5, -1000.25, 999.6]) == "-1,000 (-1,234 to 1,000)"
    assert report.spread([12.345]) == "12.3"


def test_what_broke_is_in_the_row_with_its_reason() -> None:
    broken = run(0, state="failed", reason="NaN in the loss")
    cells = report.row("mine", [broken, run(1, 2.0)])
    assert cells[3] == "2"  # of the run that has any
    assert cells[-1] == "failed: NaN in the loss, finished"
    cells = report.row("none", [RunResult(Path(), {}, {"state": "never begun"})])
    assert cells == ["none", "1", "0", "", "", "", "", "0.00", "never begun"]


def test_a_run_whose_curves_were_cut_short_is_told_of() -> None:
    whole, cut = run(0, 1.0, 2.0, 3.0), run(0, 1.0, 2.0, 3.0, step=1000, success=0.5)
    none = RunResult(Path(), {}, {"state": "finished", "step": 1000, "success": 0.25})
    assert report.row("mine", [whole])[-1] == "finished"
    assert report.row("mine", [cut])[-1] == "finished (its curves end at step 300)"
    # What the status has is told all the same.
    assert report.row("mine", [cut, none])[5] == "37.5 % (25 to 50)"
    assert report.row("mine", [none])[-1] == "finished (its curves end at step 0)"


def test_curves_are_compared_where_any_of_them_is() -> None:
    one = np.array([100, 200, 300]), np.array([0.0, 1.0, 2.0])
    other = np.array([150, 250]), np.array([5.0, 7.0])
    steps, curves = report.common_curves([one, other, (np.empty(0, int), np.empty(0))])
    assert (steps[0], steps[50], steps[-1]) == (100.0, 200.0, 300.0)
    np.testing.assert_allclose(curves[:, 0], [0.0, np.nan])
    np.testing.assert_allclose(curves[:, 50], [1.0, 6.0])
    np.testing.assert_allclose(curves[:, -1], [2.0, np.nan])
    steps, _ = report.common_curves([(one[0], one[1]), (one[0] + 1000, one[1])])
    assert not ((steps > 300) & (steps < 1100)).any()  # where there is none
    assert not len(report.common_curves([])[0])


@pytest.mark.parametrize("count", [1, 5])
def test_the_page_and_its_figure(tmp_path: Path, count: int) -> None:
    evaluation = {"step": 100, "success": 0.5, "error_m": {"median": 0.002, "p95": 0.01}}
    experiments = {
        f"e{k}": [run(s, 1.0, 2.0, evaluation=evaluation) for s in (0, 1)] for k in range(count)
    }
    experiments["nothing yet"] = [RunResult(Path(), {})]
    page = report.write_report(experiments, tmp_path / "new" / "report")
    text = page.read_text()
    assert "| e0 | 2 | 200 | 2 (2 to 2) |" in text
    assert "| experiment | success | error_m median / p95 |" in text
    assert text.count("| 0.5 (0.5 to 0.5) | 0.002 / 0.01 |") == count
    assert "| nothing yet |  |  |" in text
    assert (page.parent / "rewards.png").read_bytes().startswith(PNG)
    assert "<svg" in (page.parent / "rewards.svg").read_text()
