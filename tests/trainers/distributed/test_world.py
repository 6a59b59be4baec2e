"""What processes tell each other: means, rows, failures and wishes to stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from trainers.common.averager import Averager
from trainers.common.errors import UserError
from trainers.common.stopping import StopRequested
from trainers.distributed.world import ALONE, World

MakeRanks = Callable[[int], list[Any]]
SideBySide = Callable[..., list[Any]]


def raised(call: Callable[[World], Any]) -> Callable[[World], str]:
    """A function that says what a call raises, by its kind and its message."""

    def calling(world: World) -> str:
        try:
            call(world)
        except (StopRequested, Exception) as error:
            return f"{type(error).__name__}: {error}"
        return "nothing"

    return calling


def test_means_are_those_of_all_transitions(ranks: MakeRanks, side_by_side: SideBySide) -> None:
    values = torch.arange(12.0).reshape(6, 2)
    parts = {0: values[:1], 1: values[1:], 2: values[:1]}  # the last has none, and weighs nothing

    def mean(world: World) -> list[Tensor]:
        own = parts[world.rank]
        weight = (1 / 6, 5 / 6, 0.0)[world.rank]
        return list(world.mean([own.mean(0), own.square().mean()], weight))

    for means in side_by_side(mean, ranks(3)):
        torch.testing.assert_close(means, [values.mean(0), values.square().mean()])


def test_one_that_wants_to_stop_stops_all_at_the_next_mean(
    ranks: MakeRanks, side_by_side: SideBySide
) -> None:
    def ask(world: World) -> Any:
        return world.mean([torch.zeros(3)], 0.5, stop=world.rank == 1)

    assert side_by_side(raised(ask), ranks(2)) == ["StopRequested: "] * 2
    with pytest.raises(StopRequested):
        ALONE.mean([], 1.0, stop=True)


def test_rows_are_in_the_order_that_one_process_has_them_in(
    ranks: MakeRanks, side_by_side: SideBySide
) -> None:
    whole = torch.arange(24).reshape(3, 4, 2)  # 3 steps of 4 environments

    def rows(world: World) -> Tensor:
        return world.all_rows(whole[:, 2 * world.rank :][:, :2].flatten(0, 1), 2)

    for every in side_by_side(rows, ranks(2)):
        assert torch.equal(every, whole.flatten(0, 1))
    assert torch.equal(ALONE.all_rows(whole, 4), whole)


def test_groups_are_numbered_as_they_come_first(ranks: MakeRanks, side_by_side: SideBySide) -> None:
    own = [torch.tensor([0, 1, 0, 2]), torch.tensor([0, 1, 2, 1])]  # 2 steps of 2 environments
    for groups in side_by_side(lambda world: world.all_groups(own[world.rank], 2), ranks(2)):
        assert groups.tolist() == [0, 1, 2, 3, 0, 4, 5, 3]


def test_averages_are_over_all_that_was_added(ranks: MakeRanks, side_by_side: SideBySide) -> None:
    def means(world: World) -> dict[str, float]:
        averager = Averager()
        averager.add({"a": 1.0}, 3)
        if world.rank == 1:
            averager.add({"a": 5.0, "b": 2.0})
        result = world.means(averager)
        assert averager.means() == {}
        return result

    assert side_by_side(means, ranks(2)) == [{"a": (6 * 1.0 + 5.0) / 7, "b": 2.0}] * 2


def end(how: dict[int, BaseException]) -> Callable[[World], None]:
    """Something done together, where some ranks end by an error."""

    def work(world: World) -> None:
        with world.together():
            if world.rank in how:
                raise how[world.rank]

    return work


@pytest.mark.parametrize(
    ("how", "ends"),
    [
        ({}, ["nothing"] * 3),
        ({2: StopRequested()}, ["StopRequested: "] * 3),
        (
            {1: ValueError("no"), 2: StopRequested()},
            [
                "RankFailure: rank 1: ValueError: no",
                "ValueError: no",
                "RankFailure: rank 1: ValueError: no",
            ],
        ),
        (  # A mistake that all made is told by the first.
            {rank: UserError("no such file") for rank in range(3)},
            ["UserError: no such file", *["RankFailure: rank 0: no such file"] * 2],
        ),
    ],
)
def test_what_ends_one_ends_all(
    how: dict[int, BaseException], ends: list[str], ranks: MakeRanks, side_by_side: SideBySide
) -> None:
    assert side_by_side(raised(end(how)), ranks(3)) == ends


def test_only_what_all_know_of_is_a_reason_to_save_together(
    ranks: MakeRanks, side_by_side: SideBySide
) -> None:
    def know(world: World) -> tuple[bool, bool]:
        own = ValueError("mine")
        try:
            end({0: own})(world)
        except Exception as error:
            return world.all_know(error), world.all_know(ValueError("another"))
        return False, False

    assert side_by_side(know, ranks(2)) == [(True, False)] * 2
    assert ALONE.all_know(ValueError())


def test_those_that_were_given_something_else_are_named(
    ranks: MakeRanks, side_by_side: SideBySide
) -> None:
    def check(world: World) -> None:
        world.check_same("the run file toy.yaml", "abca"[world.rank])

    told = (
        "UserError: the run file toy.yaml: that of rank 1, rank 2 is another than that of rank 0: "
        "start all of them with the same"
    )
    assert side_by_side(raised(check), ranks(4)) == [told] * 4
