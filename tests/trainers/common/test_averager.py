from __future__ import annotations

from trainers.common.averager import Averager


def test_means_are_weighed_by_their_samples_and_begin_anew() -> None:
    averager = Averager()
    averager.add({"a": 1.0, "b": 5.0}, count=3)
    averager.add({"a": 5.0})
    averager.add({"c": 9.0}, count=0)
    assert averager.means() == {"a": 2.0, "b": 5.0}
    assert averager.pop_means() == {"a": 2.0, "b": 5.0}
    assert averager.means() == {}


def test_another_goes_on_from_a_state_that_later_additions_leave_alone() -> None:
    averager, other = Averager(), Averager()
    averager.add({"a": 1.0}, count=3)
    state = averager.state_dict()
    averager.add({"a": 100.0})
    other.load_state_dict(state)
    other.add({"a": 5.0})
    assert other.means() == {"a": 2.0}
    assert state == {"sums": {"a": 3.0}, "counts": {"a": 3}}
