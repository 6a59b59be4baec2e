"""Axes, cells and labels of a sweep's figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trainers.sweep.plan import Range
from trainers.sweep.plots import Scale, Scored, cell_means, draw_heat_maps, draw_parallel, labels

BATCH = Scale("batch", Range(choice=(64, 128, 256)))
RATE = Scale("rate", Range(log_uniform=(1e-4, 1e1)))
EPOCHS = Scale("epochs", Range(uniform=(0, 10)))


def test_positions_by_hand() -> None:
    assert [BATCH.position(value) for value in (64, 128, 256)] == pytest.approx(
        [1 / 6, 1 / 2, 5 / 6]
    )
    assert [RATE.position(value) for value in (1e-4, 1e-3, 10.0)] == pytest.approx([0.0, 0.2, 1.0])
    assert [EPOCHS.position(value) for value in (0, 3, 10)] == pytest.approx([0.0, 0.3, 1.0])


def test_cells_by_hand() -> None:
    assert [BATCH.cell(value) for value in (64, 128, 256)] == [0, 1, 2]
    assert [RATE.cell(value) for value in (1e-4, 5e-4, 2e-3, 10.0)] == [0, 0, 1, 4]
    assert [EPOCHS.cell(value) for value in (0, 1.9, 2, 10)] == [0, 0, 1, 4]


def test_ticks_are_choices_or_edges() -> None:
    assert [text for _, text in BATCH.ticks] == ["64", "128", "256"]
    assert [text for _, text in RATE.ticks] == ["0.0001", "0.001", "0.01", "0.1", "1", "10"]
    assert [place for place, _ in EPOCHS.ticks] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])


def test_means_of_cells_by_hand() -> None:
    places = [(64, 1.0, 2.0), (64, 1.5, 4.0), (256, 9.0, -1.0)]
    expected = np.full((5, 3), np.nan)
    expected[0, 0], expected[4, 2] = 3.0, -1.0
    np.testing.assert_array_equal(cell_means(BATCH, EPOCHS, places), expected)


def test_labels_are_as_short_as_they_can_be() -> None:
    keys = ["trainer.hyperparameters.beta", "seed", "rewards.0.weight", "rewards.1.weight"]
    assert list(labels(keys).values()) == ["beta", "seed", "0.weight", "1.weight"]
    assert labels(["a.seed", "seed"]) == {"a.seed": "a.seed", "seed": "seed"}


@pytest.mark.filterwarnings("error")
def test_one_trial_is_enough_to_draw(tmp_path: Path) -> None:
    space = {"rate": Range(choice=(1e-3, 1e-2)), "seed": Range(uniform=(0, 1))}
    only = Scored({"rate": 1e-3, "seed": 0.5}, 217.0)
    for draw in (draw_heat_maps, draw_parallel):
        file = tmp_path / "drawn.png"
        draw(space, [only], [file])
        assert file.read_bytes().startswith(b"\x89PNG")
        file.unlink()
