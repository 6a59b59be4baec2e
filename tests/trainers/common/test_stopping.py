"""Calls that are given up for a stop, and those that are not."""

from __future__ import annotations

import contextlib
import signal
import time

import pytest

from trainers.common.stopping import StopRequested, give_up, may_be_given_up


def test_only_a_marked_call_is_given_up() -> None:
    give_up()
    with pytest.raises(StopRequested), may_be_given_up():
        give_up()
    with may_be_given_up():
        pass
    give_up()


def sleep_through_exceptions(until: float) -> None:
    with may_be_given_up():
        while time.monotonic() < until:
            with contextlib.suppress(Exception):
                time.sleep(10.0)


def test_an_alarm_reaches_a_call_that_lets_no_exception_out() -> None:
    before = signal.signal(signal.SIGALRM, give_up)
    signal.setitimer(signal.ITIMER_REAL, 0.05)
    begin = time.monotonic()
    try:
        with pytest.raises(StopRequested):
            sleep_through_exceptions(until=begin + 10.0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() < begin + 5.0
