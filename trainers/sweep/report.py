"""A sweep's report: a page with its trials, what matters among the settings, and figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import optuna
from optuna.trial import FrozenTrial, TrialState

from trainers.common.files import alone_in, write_atomically
from trainers.comparison.tables import markdown
from trainers.runfile.registry import Registries
from trainers.runfile.settings import dump_yaml
from trainers.sweep.plan import Sweep
from trainers.sweep.plots import Scored, draw_heat_maps, draw_parallel, labels
from trainers.sweep.trials import REASON, SCORE, STEPS

BEST = "best.yaml"
ENDED = {
    TrialState.COMPLETE: "finished",
    TrialState.PRUNED: "pruned",
    TrialState.FAIL: "broken",
    TrialState.RUNNING: "interrupted, or running",
    TrialState.WAITING: "waiting",
}


def write_report(sweep: Sweep, study: optuna.Study, folder: Path, registries: Registries) -> Path:
    """Writes `report.md` with its figures, and the best trial's run file; returns the page.

    Args:
        sweep: what was tried.
        study: the trials.
        folder: exists; files of those names are replaced.
        registries: for the run file.

    Raises:
        OSError: the folder can't be written.
    """
    page = folder / "report.md"
    with alone_in(folder):  # processes of one sweep end at about the same time
        if scored := finished(study):
            values = study.best_trial.params
            write_atomically(folder / BEST, dump_yaml(sweep.run_of(values, registries)))
            _draw(sweep, scored, folder)
        write_atomically(page, "\n".join(lines(sweep, study)) + "\n")
    return page


def finished(study: optuna.Study) -> list[FrozenTrial]:
    """Trials that came to their end, which are those that have a score."""
    return list(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))


def lines(sweep: Sweep, study: optuna.Study) -> Iterator[str]:
    """The page."""
    yield f"# Sweep {sweep.name}"
    yield ""
    if finished(study):
        yield from _best(sweep, study)
    yield "## Trials"
    yield ""
    trials = sorted(study.get_trials(deepcopy=False), key=_rank)
    yield from markdown(head(sweep), [row(sweep, trial) for trial in trials])


def head(sweep: Sweep) -> list[str]:
    """The table's head."""
    return ["trial", *labels(list(sweep.settings.space)).values(), "score", "steps", "ended"]


def row(sweep: Sweep, trial: FrozenTrial) -> list[str]:
    """A trial's cells, as `head` names them."""
    values = [trial.params.get(key) for key in sweep.settings.space]
    score = f"{trial.value:.4g}" if trial.state is TrialState.COMPLETE else ""
    reason = trial.user_attrs.get(REASON, "")
    return [
        str(trial.number),
        *(f"{value:.4g}" if isinstance(value, float) else str(value) for value in values),
        score,
        f"{trial.user_attrs.get(STEPS, 0):,}",
        ": ".join(filter(None, (ENDED[trial.state], reason.replace("|", "\\|")))),
    ]


def _rank(trial: FrozenTrial) -> tuple[bool, float, int]:
    """The best first; then what has no score, in the order of its beginning."""
    if trial.state is TrialState.COMPLETE:
        return False, -float(trial.value), trial.number
    return True, 0.0, trial.number


def _best(sweep: Sweep, study: optuna.Study) -> Iterator[str]:
    best = study.best_trial
    score = best.user_attrs[SCORE]
    yield (
        f"Best: trial {best.number}, {score} {best.value:.4g}. Its run file is [{BEST}]({BEST}). "
        f"The score of a trial is the {score} of its last held-out evaluation."
    )
    yield ""
    shares = importances(study)
    if shares:
        yield "## What matters"
        yield ""
        names = labels(list(sweep.settings.space))
        yield from markdown(
            ["setting", "importance"],
            [[names[key], f"{100.0 * share:.0f} %"] for key, share in shares.items()],
        )
        yield ""
        yield f"What the best tenth of {len(finished(study))} finished trials has in common, by"
        yield "PED-ANOVA (Watanabe et al. 2023); few trials tell little."
        yield ""
    if len(sweep.settings.space) > 1:
        yield "![Mean score over pairs of settings](heat_maps.png)"
        yield ""
    yield "![Trials across the settings](parallel.png)"
    yield ""


def importances(study: optuna.Study) -> dict[str, float]:
    """Shares of the settings, the highest first; empty where too few trials tell of them."""
    if len({trial.value for trial in finished(study)}) < 2:
        return {}
    shares: dict[str, float] = optuna.importance.get_param_importances(study)
    return shares


def _draw(sweep: Sweep, trials: Sequence[FrozenTrial], folder: Path) -> None:
    scores = [Scored(trial.params, float(trial.value)) for trial in trials]
    space = sweep.settings.space
    if len(space) > 1:
        draw_heat_maps(space, scores, [folder / "heat_maps.png", folder / "heat_maps.svg"])
    draw_parallel(space, scores, [folder / "parallel.png", folder / "parallel.svg"])
