"""Devices that networks live on."""

from __future__ import annotations

import torch

from trainers.common.errors import UserError


def resolve_device(name: str) -> torch.device:
    """The torch device of a name, checked to be there.

    Raises:
        UserError: no such device.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"device: {name!r} can't be used: {reason}; use 'cpu'") from error
    return device
