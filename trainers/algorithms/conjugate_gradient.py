"""Solving linear systems whose matrix is known by its products alone."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


@torch.no_grad()
def conjugate_gradient(
    matvec: Callable[[Tensor], Tensor], b: Tensor, max_iterations: int, tolerance: float
) -> Tensor:
    """Solve A x = b by conjugate gradients (Hestenes and Stiefel 1952), starting from x = 0.

    Each iteration costs one product, and n of them are enough but for rounding. Stopped early, x is
    the best in the directions searched so far, so that b^T x never falls.

    Args:
        matvec: The product A v of a symmetric positive definite (n, n) matrix with a vector (n,).
        b: The right-hand side, (n,).
        max_iterations: The most products to spend.
        tolerance: It stops once ||b - A x|| <= tolerance * ||b||; at the precision of the numbers
            in any case.

    Returns:
        x, (n,); 0 where b is 0, or too small to be squared. Not finite where a product is not.
    """
    x = torch.zeros_like(b)
    residual, direction = b.clone(), b.clone()
    square = residual.dot(residual)
    # The updated residual goes on falling where rounding keeps x from getting better, and at last
    # its square underflows.
    number = torch.finfo(b.dtype)
    enough = max(tolerance, number.eps) ** 2 * square + number.tiny
    for _ in range(max_iterations):
        if square <= enough:
            break
        product = matvec(direction)
        step = square / direction.dot(product)
        x += step * direction
        residual -= step * product
        previous, square = square, residual.dot(residual)
        direction = residual + square / previous * direction
    return x
