"""A sweep's study: Optuna's storage, sampler and pruner."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Mapping
from functools import partial
from json import JSONDecodeError
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.exceptions import StorageInternalError
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import BaseSampler, RandomSampler, TPESampler
from optuna.storages import BaseStorage, RDBStorage
from optuna.trial import FrozenTrial
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from trainers.common.errors import UserError, first_lines
from trainers.runfile.changes import differences
from trainers.runfile.yaml_document import dotted
from trainers.sweep.journal import open_journal
from trainers.sweep.plan import Range, Sweep, Value

STORAGE_ERRORS = (StorageInternalError, SQLAlchemyError, JSONDecodeError)
"""What is raised where a storage that could be reached can no longer be."""
DEFINITION = "sweep"
DATABASE_TRIES, DATABASE_PAUSE_S = 4, 0.5
STARTUP_TRIALS = 5
"""Before the median of others counts."""


def open_study(sweep: Sweep, storage: str) -> optuna.Study:
    """The study of a sweep, which is made where there is none.

    Args:
        sweep: what is tried.
        storage: a database's URL, or a journal file.

    Raises:
        UserError: the storage can't be reached, or has a sweep of that name that is another one.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(
            storage=_storage(storage),
            study_name=sweep.name,
            direction="maximize",
            sampler=_sampler(sweep),
            pruner=_pruner(sweep),
            load_if_exists=True,
        )
        if DEFINITION not in study.user_attrs:
            study.set_user_attr(DEFINITION, sweep.definition)
        begun = study.user_attrs[DEFINITION]
    # Drivers of databases and damaged files fail in ways of their own.
    except Exception as error:
        raise storage_failure(storage, error) from error
    for path, _, _ in differences(begun, sweep.definition):
        raise UserError(
            f"{sweep.path}: {shown_storage(storage)} has the trials of another sweep of the name "
            f"{sweep.name!r}: {dotted(path)} differs; rename the sweep file, or name another "
            "--storage"
        )
    return study


def storage_failure(storage: str, error: Exception) -> UserError:
    """The user's message about a storage that can't be reached."""
    said = first_lines(error, 1) or type(error).__name__
    return UserError(f"--storage {shown_storage(storage)}: can't be used: {said}")


def shown_storage(storage: str) -> str:
    """A storage without its password."""
    if "://" not in storage:
        return storage
    try:
        return make_url(storage).render_as_string(hide_password=True)
    except ArgumentError:
        return "(no URL of a database)"


def _storage(storage: str) -> BaseStorage:
    return _database(storage) if "://" in storage else open_journal(Path(storage))


def _database(url: str) -> RDBStorage:
    """A database's studies, also where another process makes its tables at the same time."""
    for _ in range(DATABASE_TRIES - 1):
        try:
            return RDBStorage(url)
        except SQLAlchemyError as error:
            if "already exists" not in str(error):
                raise
            time.sleep(DATABASE_PAUSE_S)
    return RDBStorage(url)


def distributions(sweep: Sweep) -> dict[str, BaseDistribution]:
    """Optuna's words for a sweep's space."""
    space = sweep.settings.space
    return {key: _distribution(axis, key in sweep.whole) for key, axis in space.items()}


def _distribution(axis: Range, whole: bool) -> BaseDistribution:
    if axis.choice is not None:
        return CategoricalDistribution(axis.choice)
    low, high = axis.ends
    if whole:
        return IntDistribution(int(low), int(high), log=axis.log)
    return FloatDistribution(low, high, log=axis.log)


def _sampler(sweep: Sweep) -> BaseSampler:
    settings = sweep.settings
    match settings.sampler:
        case "grid":
            return GridSampler(sweep.cells)
        case "random":
            return NumberedSampler(settings.seed, RandomSampler)
    # Processes side by side keep away from what others are trying, by `constant_liar`.
    made = partial(TPESampler, multivariate=True, constant_liar=True)
    return NumberedSampler(settings.seed, made)


def _pruner(sweep: Sweep) -> BasePruner:
    evaluations = max(1, sweep.max_steps // sweep.evaluation.interval)
    match sweep.settings.pruner:
        case "none":
            return NopPruner()
        case "hyperband":
            return HyperbandPruner(min_resource=1, max_resource=evaluations)
    # What learns slowly at first has a third of the run for it.
    return MedianPruner(n_startup_trials=STARTUP_TRIALS, n_warmup_steps=evaluations // 3)


class NumberedSampler(BaseSampler):
    """Draws a trial's values by the sweep's seed and the trial's number.

    Each process of a sweep has a sampler. With the sweep's seed in each they would draw the same
    trials, and what an interrupted sweep draws would not be what it had drawn without.
    """

    def __init__(self, seed: int, make: Callable[..., BaseSampler]):
        self._seed, self._make = seed, make

    def _of(self, trial: FrozenTrial, name: str = "") -> BaseSampler:
        seed = zlib.crc32(f"{self._seed} {trial.number} {name}".encode())
        return self._make(seed=seed)

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """See `BaseSampler`."""
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        search_space: dict[str, BaseDistribution],
    ) -> dict[str, Any]:
        """See `BaseSampler`."""
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """See `BaseSampler`."""
        sampler = self._of(trial, param_name)
        return sampler.sample_independent(study, trial, param_name, param_distribution)


class GridSampler(BaseSampler):
    """Gives each trial the grid's cell of its number, whatever process it is in.

    Optuna's own draws a cell that is free, and two processes may draw the same one.
    """

    def __init__(self, cells: list[dict[str, Value]]):
        self._cells = cells

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """See `BaseSampler`."""
        return {}

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: Mapping[str, BaseDistribution]
    ) -> dict[str, Any]:
        """See `BaseSampler`."""
        return {}

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Value:
        """See `BaseSampler`."""
        # Processes that ask at the same time may have more trials than there are cells.
        return self._cells[trial.number % len(self._cells)][param_name]
