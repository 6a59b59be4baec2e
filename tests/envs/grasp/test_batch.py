from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from envs.grasp.batch import Batch


@dataclass(frozen=True)
class Points(Batch):
    unit: str
    x: np.ndarray
    y: np.ndarray


@pytest.fixture
def points() -> Points:
    return Points("m", np.arange(5.0), np.arange(10).reshape(5, 2))


def test_length_and_arrays_leave_out_what_the_rows_share(points: Points) -> None:
    assert len(points) == 5
    assert set(points.arrays()) == {"x", "y"}


@pytest.mark.parametrize(
    "index", [np.array([3, 1]), np.array([0, 1, 0, 1, 0], bool), slice(1, 3)], ids=str
)
def test_rows_are_taken_from_every_array(points: Points, index: np.ndarray | slice) -> None:
    rows = points[index]
    assert rows.unit == "m"
    np.testing.assert_array_equal(rows.x, np.arange(5.0)[index])
    np.testing.assert_array_equal(rows.y, np.arange(10).reshape(5, 2)[index])


def test_with_rows_copies_and_leaves_the_original_alone(points: Points) -> None:
    other = Points("m", np.array([-1.0, -2.0]), np.array([[7, 8], [9, 10]]))
    changed = points.with_rows(np.array([4, 0]), other)
    np.testing.assert_array_equal(changed.x, [-2, 1, 2, 3, -1])
    np.testing.assert_array_equal(changed.y, [[9, 10], [2, 3], [4, 5], [6, 7], [7, 8]])
    np.testing.assert_array_equal(points.x, np.arange(5.0))
    np.testing.assert_array_equal(points.y, np.arange(10).reshape(5, 2))
    assert not np.shares_memory(changed.x, points.x)


def test_with_arrays_replaces_only_what_is_given(points: Points) -> None:
    changed = points.with_arrays({"x": np.zeros(5)})
    assert not changed.x.any()
    assert changed.y is points.y
    assert changed.unit == "m"
