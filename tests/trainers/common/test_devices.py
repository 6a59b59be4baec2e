"""Devices, and what is said of those that there are not."""

from __future__ import annotations

import pytest
import torch

from trainers.common.devices import resolve_device
from trainers.common.errors import UserError


@pytest.mark.parametrize(
    "device", ["cuda:77", "gpu", "cuda" if not torch.cuda.is_available() else "x"]
)
def test_a_device_that_is_not_there_is_the_users_mistake(device: str) -> None:
    with pytest.raises(UserError, match=f"^device: '{device}' can't be used: .*; use 'cpu'$"):
        resolve_device(device)


def test_the_cpu_is_a_device() -> None:
    assert resolve_device("cpu") == torch.device("cpu")
