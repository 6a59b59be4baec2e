"""The history of actions, against a list."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from envs.gym.action_history import LEAST_CAPACITY, ActionHistory

OPERATIONS = st.lists(st.one_of(st.just("append"), st.just("load"), st.integers(0, 3)), max_size=20)


@given(OPERATIONS)
def test_it_holds_what_a_list_would_and_changes_nothing_it_handed_out(
    operations: list[str | int],
) -> None:
    """Each append is of forty steps, so that the array fills up; a number is the share kept."""
    history, expected, number = ActionHistory((2, 1), np.int64), [], 0
    handed_out: list[tuple[np.ndarray, np.ndarray]] = []
    for operation in operations:
        if operation == "append":
            for _ in range(40):
                number += 1
                history.append(np.full((2, 1), number))
                expected.append(number)
        elif operation == "load":
            history.load(history.actions)
        else:
            kept = len(expected) * int(operation) // 3
            history.keep(kept)
            expected = expected[len(expected) - kept :]
        assert history.actions.shape == (len(expected), 2, 1)
        assert history.actions[:, 1, 0].tolist() == expected
        handed_out.append((history.actions, history.actions.copy()))
    for given_then, copied_then in handed_out:
        np.testing.assert_array_equal(given_then, copied_then)


def test_it_grows_with_what_is_kept_and_not_with_what_passed_through() -> None:
    history = ActionHistory((1,), np.float32)
    for _ in range(1000):
        history.append(np.zeros(1))
        history.keep(min(len(history.actions), 5))
    assert history.actions.base is not None
    assert len(history.actions.base) == LEAST_CAPACITY


def test_it_keeps_copies() -> None:
    history, actions = ActionHistory((1,), np.float32), np.ones(1, np.float32)
    history.append(actions)
    history.load(loaded := history.actions.copy())
    actions[:] = loaded[:] = 2.0
    assert history.actions.tolist() == [[1.0]]
