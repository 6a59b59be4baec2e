"""Memory: what arrays take, and what the machine has."""

from __future__ import annotations

import resource
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from encoders.spaces import DepthImage
from envs import memory
from envs.memory import adding_up, machine_bytes, shortage, space_bytes


@pytest.fixture(autouse=True)
def container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A container that says nothing of memory yet, on a machine of 32 GiB without other limits."""
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(memory, "CONTAINER_LIMITS", (limit, tmp_path / "none"))
    monkeypatch.setattr("os.sysconf", {"SC_PHYS_PAGES": 2**23, "SC_PAGE_SIZE": 2**12}.get)
    unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda _: unlimited)
    return limit


@pytest.mark.parametrize(
    ("said", "bytes_"), [(None, 2**35), ("max\n", 2**35), ("4096\n", 4096), (str(2**60), 2**35)]
)
def test_a_containers_limit_counts(container: Path, said: str | None, bytes_: int) -> None:
    if said is not None:
        container.write_text(said)
    assert machine_bytes() == bytes_


def test_the_process_own_limit_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (10**9, resource.RLIM_INFINITY))
    assert machine_bytes() == 10**9


def test_processes_of_one_machine_need_it_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert shortage(2**33, "all") is None
    assert shortage(2**33 + 1, "all") == "needs 34.4 GB, and the machine has 34.4 GB"


def test_a_shortage_has_both_numbers() -> None:
    assert shortage(2**35, "all") is None
    assert shortage(2**35 + 1, "all") == "needs 34.4 GB, and the machine has 34.4 GB"
    assert shortage(8e12, "all") == "needs 8,000.0 GB, and the machine has 34.4 GB"


def test_bytes_of_a_space() -> None:
    pictures = {"depth": DepthImage(4, 3), "color": Box(0, 255, (4, 3, 3), np.uint8)}
    space = gymnasium.spaces.Dict(
        {**pictures, "state": Box(-1, 1, (5,), np.float32), "one": Discrete(7)}
    )
    assert space_bytes(space) == 4 * 3 * 2 + 4 * 3 * 3 + 5 * 4 + 8


def test_what_is_asked_about_is_added_up_by_what_it_is_for() -> None:
    with adding_up() as needs:
        shortage(10, "images")
        shortage(5, "networks")
        shortage(7, "images")
    shortage(1, "networks")
    assert needs == {"images": 17, "networks": 5}
