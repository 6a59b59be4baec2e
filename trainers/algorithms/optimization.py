"""Steps of gradient descent that stop a run before it breaks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from trainers.common.errors import NonFiniteError


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
        parameters: what may change; frozen ones among them stay as they are.
        max_gradient_norm: the gradient is clipped to this norm.
        step: of the run, for the message.

    Raises:
        NonFiniteError: the loss or its gradient is not finite; the parameters are as before.
    """
    learned = [parameter for parameter in parameters if parameter.requires_grad]
    gradients = torch.autograd.grad(loss, learned, allow_unused=True)
    for parameter, gradient in zip(learned, gradients, strict=True):
        parameter.grad = gradient
    norm = nn.utils.get_total_norm([part for part in gradients if part is not None])
    if check_finite(loss, norm, step) > max_gradient_norm:
        nn.utils.clip_grads_with_norm_(learned, max_gradient_norm, norm)
    optimizer.step()


def load_optimizer(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Takes an optimizer back to a state.

    Raises:
        ValueError: it is that of other parameters, or of another optimizer: torch itself would
            notice at the next step only.
    """
    settings = [group.keys() for group in optimizer.param_groups]
    optimizer.load_state_dict(state)
    for known, group in zip(settings, optimizer.param_groups, strict=True):
        if missing := known - group.keys():
            raise ValueError(f"the optimizer's state has no {', '.join(sorted(missing))}")
    for parameter, moments in optimizer.state.items():
        found = {name: (tuple(each.shape), each.dtype) for name, each in moments.items()}
        own = tuple(parameter.shape), parameter.dtype
        if found != {"step": ((), torch.float32), "exp_avg": own, "exp_avg_sq": own}:
            raise ValueError(f"the optimizer's state of a parameter {own} has {found}")


def check_finite(loss: Tensor, gradient_norm: Tensor, step: int) -> float:
    """The gradient's norm as a number.

    Raises:
        NonFiniteError: the loss or the norm is not finite; the message names the run's step.
    """
    # Both at once: on an accelerator each number read waits for all that is under way.
    value, norm = torch.stack((loss.detach(), gradient_norm)).tolist()
    if not math.isfinite(value + norm):
        raise NonFiniteError(f"step {step}: the loss is {value}, its gradient's norm {norm}")
    return float(norm)
