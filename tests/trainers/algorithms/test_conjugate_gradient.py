"""Conjugate gradients, against dense solutions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from trainers.algorithms.conjugate_gradient import conjugate_gradient

SEEDS = st.integers(0, 2**32 - 1)
patient = settings(max_examples=50, deadline=None)


class Matrix:
    """A dense matrix that counts its products."""

    def __init__(self, dense: Tensor):
        self.dense = dense
        self.products = 0

    def __call__(self, vector: Tensor) -> Tensor:
        self.products += 1
        return self.dense @ vector


def problem(seed: int, size: int, condition: float) -> tuple[Matrix, Tensor]:
    """A symmetric matrix with eigenvalues from 1/condition to 1, and a right-hand side."""
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(size, size)))
    dense = (basis * np.geomspace(1.0 / condition, 1.0, size)) @ basis.T
    return Matrix(torch.from_numpy((dense + dense.T) / 2)), torch.from_numpy(rng.normal(size=size))


@patient
@given(seed=SEEDS, size=st.integers(1, 40), condition=st.floats(1.0, 1e3))
def test_it_agrees_with_a_dense_solution(seed: int, size: int, condition: float) -> None:
    matrix, b = problem(seed, size, condition)
    x = conjugate_gradient(matrix, b, max_iterations=20 * size, tolerance=1e-10)
    torch.testing.assert_close(x, torch.linalg.solve(matrix.dense, b), rtol=1e-5, atol=1e-6)


@patient
@given(seed=SEEDS, size=st.integers(2, 40))
def test_damping_tames_an_ill_conditioned_matrix(seed: int, size: int) -> None:
    matrix, b = problem(seed, size, condition=1e12)
    damping = 0.1
    x = conjugate_gradient(lambda v: matrix(v) + damping * v, b, 60, 1e-10)
    damped = matrix.dense + damping * torch.eye(size, dtype=b.dtype)
    torch.testing.assert_close(x, torch.linalg.solve(damped, b), rtol=1e-6, atol=1e-7)


@patient
@given(seed=SEEDS, size=st.integers(1, 20), iterations=st.integers(1, 30))
def test_stopped_early_it_is_nearer_with_each_iteration(
    seed: int, size: int, iterations: int
) -> None:
    # In the norm of the matrix, ||x - x*||_A, the error never grows from one iteration to the next.
    matrix, b = problem(seed, size, condition=100.0)
    exact = torch.linalg.solve(matrix.dense, b)

    def error(count: int) -> float:
        off = conjugate_gradient(matrix, b, count, 0.0) - exact
        return float(off @ matrix.dense @ off)

    assert error(iterations) <= error(iterations - 1) * (1 + 1e-9) + 1e-18


@patient
@given(seed=SEEDS, size=st.integers(1, 30), tolerance=st.floats(1e-8, 0.5))
def test_it_stops_at_the_first_residual_within_the_tolerance(
    seed: int, size: int, tolerance: float
) -> None:
    matrix, b = problem(seed, size, condition=50.0)
    x = conjugate_gradient(matrix, b, 1000, tolerance)
    spent = matrix.products
    bound = tolerance * b.norm()
    assert (b - matrix.dense @ x).norm() <= bound * (1 + 1e-6)
    before = conjugate_gradient(matrix, b, spent - 1, tolerance)
    assert (b - matrix.dense @ before).norm() > bound * (1 - 1e-6)


@patient
@given(seed=SEEDS, exponent=st.integers(-8, 8))
def test_the_tolerance_does_not_depend_on_the_units(seed: int, exponent: int) -> None:
    matrix, b = problem(seed, 10, condition=100.0)
    scale = 4.0**exponent
    x = conjugate_gradient(matrix, b, 1000, 1e-3)
    assert torch.equal(conjugate_gradient(matrix, scale * b, 1000, 1e-3), scale * x)


def test_as_many_iterations_as_distinct_eigenvalues_are_enough() -> None:
    matrix = Matrix(torch.diag(torch.tensor([1.0, 1.0, 1.0, 4.0, 4.0, 9.0], dtype=torch.float64)))
    b = torch.tensor([1.0, -2.0, 3.0, 8.0, 4.0, 18.0], dtype=torch.float64)
    x = conjugate_gradient(matrix, b, 100, 1e-9)
    assert matrix.products == 3
    expected = torch.tensor([1.0, -2.0, 3.0, 2.0, 1.0, 2.0], dtype=torch.float64)
    torch.testing.assert_close(x, expected)


def test_one_iteration_is_steepest_descent() -> None:
    # x_1 = b (b^T b) / (b^T A b) = (1, 2) 5 / (2 + 12)
    matrix = Matrix(torch.diag(torch.tensor([2.0, 3.0])))
    x = conjugate_gradient(matrix, torch.tensor([1.0, 2.0]), 1, 0.0)
    assert x.tolist() == pytest.approx([5 / 14, 10 / 14])


@pytest.mark.parametrize("tolerance", [0.0, 1e-10])
def test_nothing_on_the_right_needs_no_product(tolerance: float) -> None:
    matrix = Matrix(torch.eye(3))
    assert conjugate_gradient(matrix, torch.zeros(3), 10, tolerance).tolist() == [0.0, 0.0, 0.0]
    assert matrix.products == 0


@patient
@given(seed=SEEDS, size=st.integers(1, 12))
def test_more_iterations_than_can_help_do_no_harm(seed: int, size: int) -> None:
    matrix, b = problem(seed, size, condition=30.0)
    single = Matrix(matrix.dense.float())
    x = conjugate_gradient(single, b.float(), 500, 0.0)
    torch.testing.assert_close(
        x.double(), torch.linalg.solve(matrix.dense, b), rtol=1e-3, atol=1e-4
    )


def test_the_right_hand_side_is_left_as_it_is() -> None:
    b = torch.tensor([1.0, 2.0])
    conjugate_gradient(Matrix(torch.diag(torch.tensor([2.0, 3.0]))), b, 5, 0.0)
    assert b.tolist() == [1.0, 2.0]


def test_products_that_are_not_finite_show() -> None:
    x = conjugate_gradient(lambda v: v * torch.nan, torch.ones(2), 5, 1e-10)
    assert not torch.isfinite(x).any()
