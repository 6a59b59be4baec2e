"""Steps of gradient descent that stop a run before it breaks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from trainers.experience.env_runner import NonFiniteError


def optimizer_step(
    optimizer: torch.optim.Optimizer,
    loss: Tensor,
    parameters: Sequence[nn.Parameter],
    max_gradient_norm: float,
    step: int,
) -> None:
    """Takes one step down the gradient of a loss with respect to some parameters, and no others.

    Args:
        optimizer: of the parameters.
        loss: a number.
        parameters: what may change.
        max_gradient_norm: the gradient is clipped to this norm.
        step: of the run, for the message.

    Raises:
        NonFiniteError: the loss or its gradient is not finite; the parameters are as before.
    """
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    norm = nn.utils.get_total_norm([part for part in gradients if part is not None])
    check_finite(loss, norm, step)
    if norm > max_gradient_norm:
        nn.utils.clip_grads_with_norm_(parameters, max_gradient_norm, norm)
    optimizer.step()


def check_finite(loss: Tensor, gradient_norm: Tensor, step: int) -> None:
    """Raises NonFiniteError, naming the run's step, where a loss or its gradient is not finite."""
    if not math.isfinite((loss + gradient_norm).item()):
        raise NonFiniteError(
            f"step {step}: the loss is {loss.item()}, its gradient's norm {gradient_norm.item()}"
        )
