"""Steps of gradient descent."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from trainers.common.errors import NonFiniteError

GENERATOR_BYTES = {16, 5056}
"""Sizes of a generator's state on a GPU and on the CPU."""

Mean = Callable[[Sequence[Tensor]], Sequence[Tensor]]
"""From what one process has to what all processes of a run have on average."""


def unchanged(own: Sequence[Tensor]) -> Sequence[Tensor]:
    """What one process has, where there are no others. See `Mean`."""
    return own


def adam(
    groups: Iterable[Iterable[nn.Parameter]], device: torch.device, eps: float = 1e-8
) -> torch.optim.Adam:
    """Adam with one learning rate per group of parameters, which `set_learning_rates` sets.

    On an accelerator the rates are tensors, and all of a step can be captured in a graph.
    """
    captured = device.type == "cuda"
    return torch.optim.Adam(
        [
            {"params": list(group), "lr": torch.zeros((), device=device) if captured else 0.0}
            for group in groups
        ],
        eps=eps,
        fused=True,
        capturable=captured,
    )


def set_learning_rates(optimizer: torch.optim.Optimizer, rates: Sequence[float]) -> None:
    """Sets the learning rates of an optimizer's groups."""
    for group, rate in zip(optimizer.param_groups, rates, strict=True):
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


def optimizer_step(
    optimizer: torch.optim.Optimizer,
    loss: Tensor,
    parameters: Sequence[nn.Parameter],
    max_gradient_norm: float,
    mean: Mean = unchanged,
    *,
    alone: bool = True,
) -> Tensor:
    """Takes one step down the gradient of a loss with respect to some parameters, and no others.

    Where the loss or its gradient is not finite, the parameters stay as they are. Nothing is read
    back from the device to find out: that is for `check_finite`, when the caller reads anyway.

    Args:
        optimizer: of the parameters, fused.
        loss: a number.
        parameters: what may change; frozen ones among them stay as they are.
        max_gradient_norm: the gradient is clipped to this norm.
        mean: over all processes of a run, of the loss and the gradients.
        alone: whether there are no others. Parameters that the loss does not depend on are left
            alone then, and else have a gradient of 0.

    Returns:
        The loss and its gradient's norm before it was clipped, (2,), without a gradient.
    """
    learned = [parameter for parameter in parameters if parameter.requires_grad]
    # An unused parameter of one process may be used in another, and all send as much.
    own = torch.autograd.grad(loss, learned, allow_unused=True, materialize_grads=not alone)
    loss, *gradients = mean([loss, *(part for part in own if part is not None)])
    left = iter(gradients)
    for parameter, part in zip(learned, own, strict=True):
        parameter.grad = None if part is None else _laid_out_as(parameter, next(left))
    norm = nn.utils.get_total_norm(gradients)
    if math.isfinite(max_gradient_norm):
        nn.utils.clip_grads_with_norm_(learned, max_gradient_norm, norm)
    loss_and_norm = torch.stack((loss.detach(), norm))
    # What torch's gradient scaler sets, too: a fused optimizer takes no step where it is 1.
    optimizer.found_inf = 1.0 - loss_and_norm.isfinite().all().float()  # type: ignore[attr-defined]
    optimizer.step()
    return loss_and_norm


def _laid_out_as(parameter: nn.Parameter, gradient: Tensor) -> Tensor:
    """A gradient with its parameter's order in memory.

    That of a convolution's weights comes as its images lie, channels last; and a fused optimizer
    goes through the memory of both side by side, whatever their strides are.
    """
    if gradient.stride() == parameter.stride():
        return gradient
    return torch.empty_like(parameter, requires_grad=False).copy_(gradient)


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """An optimizer's state, of the same kinds on every device."""
    state = optimizer.state_dict()
    for group in state["param_groups"]:
        group["lr"] = float(group["lr"])
    return state


def load_generator(generator: torch.Generator, state: Tensor) -> None:
    """Takes a generator back to a state; one of another kind of device is a seed instead.

    Raises:
        RuntimeError: it is neither.
    """
    sizes = {len(state), len(generator.get_state())}
    if sizes == GENERATOR_BYTES:
        digest = hashlib.sha256(state.cpu().numpy().tobytes()).digest()
        generator.manual_seed(int.from_bytes(digest[:7], "big"))
    else:
        generator.set_state(state)


def load_optimizer(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Takes an optimizer back to a state; its settings, learning rates included, stay its own.

    Raises:
        ValueError: it is that of other parameters, or of another optimizer: torch itself would
            notice at the next step only.
    """
    settings = [
        {name: value for name, value in group.items() if name != "params"}
        for group in optimizer.param_groups
    ]
    for moments in state["state"].values():  # of which torch makes tensors itself
        if strange := [name for name, each in moments.items() if not isinstance(each, Tensor)]:
            raise ValueError(f"the optimizer's state has {', '.join(strange)} that are no tensors")
    optimizer.load_state_dict(state)
    for known, group in zip(settings, optimizer.param_groups, strict=True):
        if missing := known.keys() - group.keys():
            raise ValueError(f"the optimizer's state has no {', '.join(sorted(missing))}")
        group.update(known)
    for parameter, moments in optimizer.state.items():
        found = {name: (tuple(each.shape), each.dtype) for name, each in moments.items()}
        own = tuple(parameter.shape), parameter.dtype
        if found != {"step": ((), torch.float32), "exp_avg": own, "exp_avg_sq": own}:
            raise ValueError(f"the optimizer's state of a parameter {own} has {found}")


def check_finite(loss_and_norm: Sequence[float], step: int) -> None:
    """Refuses a loss or a norm of its gradient that is NaN or infinite.

    Raises:
        NonFiniteError: one is; the message names the run's step.
    """
    loss, norm = loss_and_norm
    if not math.isfinite(loss + norm):
        raise NonFiniteError(f"step {step}: the loss is {loss}, its gradient's norm {norm}")
