"""Figures: what a report says of a metric, and how people read it."""

from __future__ import annotations

import numpy as np
import pytest

from envs.evaluation import Evaluator, Figure, error, rate


def test_rates_are_means_and_errors_are_quantiles() -> None:
    assert rate("hit", "hits").summarize(np.array([True, False, False, True])) == 0.5
    # 101 values 0 to 100: a quantile is its own percentage, wherever the values stand.
    values = np.random.default_rng(0).permutation(101) / 10.0
    told = error("gap_m", "gap", "cm", 100.0).summarize(values)
    assert told == {"median": pytest.approx(5.0), "p95": pytest.approx(9.5)}


def test_people_read_figures_in_their_own_units() -> None:
    assert rate("hit", "hits").shown(0.98549) == "98.5%"
    assert error("gap_m", "gap", "mm", 1000.0).shown(0.0024095) == "2.41 mm"
    assert Figure("speed", "speed").shown(-0.16319) == "-0.163"


def test_a_figure_is_called_as_its_metric_unless_it_has_a_key() -> None:
    plain, keyed = (
        rate("hit", "hits"),
        rate("crash", "crash rate", key="crash_rate", better="lower"),
    )
    assert (plain.name, keyed.name) == ("hit", "crash_rate")
    first = keyed.of_first_action()
    assert (first.name, first.label) == ("first_action_crash_rate", "first action crash rate")
    assert (first.metric, first.better) == ("crash", "lower")


@pytest.mark.parametrize("what", ["physical_check", "pictures"])
def test_an_environment_that_declares_nothing_says_what_it_lacks(what: str) -> None:
    with pytest.raises(ValueError, match=f"no {what.replace('_', ' ')}"):
        getattr(Evaluator(), what)()
    assert Evaluator.figures == ()
    assert not Evaluator.judges_first_action
