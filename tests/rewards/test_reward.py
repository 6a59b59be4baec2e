"""The contract of a reward: what it is computed from, and how terms are weighed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from rewards.reward import RewardError, RewardTerm, fits, fitting, weigh


@dataclass(frozen=True)
class Walk:
    metres: np.ndarray


@dataclass(frozen=True)
class Run(Walk):
    pass


@dataclass(frozen=True)
class Swim:
    metres: np.ndarray


class Far:
    snapshot: ClassVar[type] = Walk

    def __call__(self, snapshot: Walk) -> np.ndarray:
        return snapshot.metres


class Undeclared:
    def __call__(self, snapshot: Any) -> np.ndarray:
        return np.ones(len(snapshot.metres))


@pytest.mark.parametrize(
    ("reward", "snapshot", "expected"),
    [
        (Far, Walk, True),
        (Far(), Walk, True),
        (Far, Run, True),  # a Run is a Walk
        (Far, Swim, False),
        (Undeclared, Walk, True),
        (Undeclared(), Swim, True),
    ],
)
def test_a_reward_fits_what_it_declares_and_without_a_declaration_anything(
    reward: Any, snapshot: type, expected: bool
) -> None:
    assert fits(reward, snapshot) is expected


def test_a_reward_for_another_snapshot_is_refused_with_both_names() -> None:
    terms = [RewardTerm("steady", 1.0, Undeclared()), RewardTerm("far", 1.0, Far())]
    assert fitting(terms, Run) == tuple(terms)
    with pytest.raises(
        ValueError,
        match=r"^the reward 'far' is computed from a Walk, and this environment hands out a Swim: "
        r"leave it out, or take a reward for \S*test_reward\.Swim$",
    ):
        fitting(terms, Swim)


def test_terms_are_weighed_by_name() -> None:
    terms = [RewardTerm("far", -0.5, Far()), RewardTerm("steady", 2.0, Undeclared())]
    weighed = weigh(terms, Walk(np.array([4.0, 6.0], np.float32)), 2)
    assert {name: values.tolist() for name, values in weighed.items()} == {
        "far": [-2.0, -3.0],
        "steady": [2.0, 2.0],
    }
    assert weighed["far"].dtype == np.float64


@pytest.mark.parametrize("shape", [(), (3,), (2, 1)])
def test_anything_but_a_number_for_each_environment_is_refused(shape: tuple[int, ...]) -> None:
    term = RewardTerm("odd", 1.0, lambda snapshot: np.zeros(shape))
    with pytest.raises(RewardError, match=r"'odd' returned .* for 2 environments: .* \(2,\)$"):
        weigh([term], None, 2)


@pytest.mark.parametrize("returned", [["much", "little"], [[1.0], [1.0, 2.0]], [None, object()]])
def test_what_is_no_number_is_refused(returned: Any) -> None:
    term = RewardTerm("odd", 1.0, lambda snapshot: returned)
    with pytest.raises(RewardError, match=r"'odd' returned no numbers: .* \(2,\)$"):
        weigh([term], None, 2)
