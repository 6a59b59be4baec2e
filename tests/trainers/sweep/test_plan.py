"""Sweep files, and what is found wrong with them before the first trial."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trainers.runfile.registry import Registries
from trainers.runfile.settings import resolved
from trainers.runfile.yaml_document import SettingsError
from trainers.sweep.plan import load_sweep

BATCH = "trainer.hyperparameters.batch_size"
RATE = "trainer.hyperparameters.learning_rate"
CONFIG = Path(__file__).parents[3] / "config"
SHIPPED = sorted(CONFIG.glob("sweeps/*.yaml"))


def test_a_range_is_of_whole_numbers_where_the_setting_is(
    sweep_file: Callable[..., Path], known: Registries
) -> None:
    space = {
        RATE: {"uniform": [1, 2]},  # a float, however its ends are written
        "trainer.hyperparameters.num_epoch": {"uniform": [1, 9]},
        "trainer.hyperparameters.target_kl": {"log_uniform": [0.01, 1]},
        "seed": {"choice": [0, 1]},
    }
    sweep = load_sweep(sweep_file(space=space), known)
    assert sweep.whole == {"trainer.hyperparameters.num_epoch"}


def test_a_trial_is_the_base_with_what_is_fixed_and_what_is_tried(
    sweep_file: Callable[..., Path], known: Registries
) -> None:
    fixed = {"trainer.max_steps": 256, "evaluation": {"interval": 64}, "device": "cpu"}
    sweep = load_sweep(sweep_file(fixed=fixed), known)
    data = resolved(sweep.run_of({RATE: 1e-05, BATCH: 16}, known))
    assert data["trainer"]["hyperparameters"]["learning_rate"] == 1e-05
    assert data["trainer"]["hyperparameters"]["batch_size"] == 16
    assert data["trainer"]["hyperparameters"]["buffer_size"] == 64
    assert data["trainer"]["max_steps"] == sweep.max_steps == 256
    assert data["evaluation"]["interval"] == sweep.evaluation.interval == 64


def test_a_grid_has_each_combination_and_no_trial_more(
    sweep_file: Callable[..., Path], known: Registries
) -> None:
    space = {RATE: {"choice": [1e-3, 1e-2]}, "seed": {"choice": [0, 1, 2]}}
    grid = load_sweep(sweep_file(space=space, sampler="grid"), known)
    assert grid.cells == [{RATE: rate, "seed": s} for rate in (1e-3, 1e-2) for s in (0, 1, 2)]
    assert (grid.count(None), grid.count(4), grid.count(100)) == (6, 4, 6)
    drawn = load_sweep(sweep_file(trials=7), known)
    assert (drawn.count(None), drawn.count(4), drawn.count(100)) == (7, 4, 100)


@pytest.mark.parametrize(
    ("settings", "line", "message"),
    [
        (
            {"space": {"trainer.hyperparameters.learning_rat": {"uniform": [0.1, 1.0]}}},
            3,
            "space.trainer.hyperparameters.learning_rat: unknown key; did you mean 'learning_rate'",
        ),
        ({"space": {RATE: {"uniform": [0.0, 1.0]}}}, 3, f"space.{RATE}: should be greater than 0"),
        ({"space": {BATCH: {"choice": [32, 0]}}}, 3, "should be greater than or equal to 1, not 0"),
        ({"space": {BATCH: {"uniform": [1, 2.5]}}}, 3, "should be a whole number, not 2.5"),
        (
            {"space": {"seed.more": {"choice": [1]}}},
            3,
            "with 1, seed: should be a whole number, not {more: 1}",
        ),
        ({"space": {RATE: {"log_uniform": [0, 1]}}}, 3, "both ends should be over 0"),
        ({"space": {RATE: {"uniform": [1, 1]}}}, 3, "should be the lowest, and then the highest"),
        ({"space": {RATE: {"uniform": [1]}}}, 3, "the list has 1 items, which is too few"),
        ({"space": {RATE: {"choice": [1, 1]}}}, 3, "choice: a value is there twice"),
        ({"space": {RATE: {}}}, 3, "needs uniform, log_uniform or choice"),
        ({"space": {RATE: {"choice": [1], "uniform": [1, 2]}}}, 3, "and one of them alone"),
        ({"space": {RATE: {"normal": [1, 2]}}}, 3, "normal: unknown key"),
        ({"space": {}}, 2, "space: "),
        ({"sampler": "grid"}, 3, f"space.{RATE}: should be a choice: a grid has no other"),
        ({"sampler": "grits"}, 5, "sampler: should be 'tpe', 'random' or 'grid', not 'grits'"),
        ({"run": "none.yaml"}, 1, "run: there is no file "),
        ({"fixed": {"trainer.max_step": 5}}, 6, "trainer.max_step: unknown key"),
        ({"fixed": {"evaluation": None}}, None, "evaluation: missing: trials are judged by it"),
    ],
)
def test_mistakes_are_told_with_their_lines(
    settings: dict[str, Any],
    line: int | None,
    message: str,
    sweep_file: Callable[..., Path],
    known: Registries,
) -> None:
    path = sweep_file(**settings)
    with pytest.raises(SettingsError) as caught:
        load_sweep(path, known)
    (said,) = str(caught.value).splitlines()
    assert message in said
    if line is not None:
        assert re.match(rf"{re.escape(str(path))}:{line}: ", said), said


def test_what_settings_refuse_together_names_the_value(
    sweep_file: Callable[..., Path], known: Registries
) -> None:
    path = sweep_file(space={BATCH: {"choice": [32, 128]}})
    said = f"{path}:3: space.{BATCH}: with 128, trainer.hyperparameters: batch_size 128 is over "
    with pytest.raises(SettingsError, match=re.escape(said)):
        load_sweep(path, known)


BUFFER = "trainer.hyperparameters.buffer_size"


def test_a_grid_is_refused_with_the_cells_that_settings_refuse(
    sweep_file: Callable[..., Path], known: Registries
) -> None:
    space = {BUFFER: {"choice": [64, 256]}, BATCH: {"choice": [32, 128]}}
    path = sweep_file(sampler="grid", space=space)
    with pytest.raises(SettingsError) as caught:
        load_sweep(path, known)
    (said,) = str(caught.value).splitlines()
    assert f"space: {BUFFER} 64, {BATCH} 128: trainer.hyperparameters: batch_size 128" in said
    # Drawn at random such a trial may come, and breaks alone.
    assert load_sweep(sweep_file(sampler="random", space=space), known).cells


def test_a_value_that_goes_with_others_than_the_base_has_is_right(
    sweep_file: Callable[..., Path], known: Registries
) -> None:
    """The base's batches are larger than these buffers."""
    space = {BUFFER: {"choice": [8, 16]}, BATCH: {"choice": [4, 8]}}
    for sampler in ("grid", "tpe"):
        assert len(load_sweep(sweep_file(sampler=sampler, space=space), known).cells) == 4
    with pytest.raises(SettingsError, match=re.escape(f"space.{BUFFER}: with 2, trainer")):
        load_sweep(sweep_file(space={BUFFER: {"choice": [2, 8]}, BATCH: {"choice": [4]}}), known)


def test_a_setting_of_before_is_no_key(sweep_file: Callable[..., Path], known: Registries) -> None:
    path = sweep_file(
        run=str(CONFIG / "quick.yaml"),
        fixed={"evaluation": {"interval": 10_000}},
        space={"environment.motion_checks": {"choice": [5]}},
    )
    with pytest.raises(SettingsError, match=r":3: space\.environment\.motion_checks: has another"):
        load_sweep(path, known)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_sweeps_are_right(path: Path, known: Registries) -> None:
    assert load_sweep(path, known).count(None) > 0


def test_there_are_sweeps_that_are_shipped() -> None:
    assert SHIPPED
