"""Compiled loops: kept where they can be, compiled anew where they can't."""

from __future__ import annotations

import errno
import importlib.util
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from numba.core import caching

from envs.grasp import compiled as compiled_module

SOURCE = """
from envs.grasp.compiled import compiled

@compiled(error_model="numpy")
def twice(number):
    return number + number
"""


@pytest.fixture(autouse=True)
def _nothing_told_yet() -> None:
    compiled_module._tell_of_no_cache.cache_clear()


@pytest.fixture
def load(tmp_path: Path) -> Callable[[], Any]:
    """The function as a new process finds it."""
    path = tmp_path / "doubling.py"
    path.write_text(SOURCE)

    def load() -> Any:
        spec = importlib.util.spec_from_file_location("doubling", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.twice

    return load


def kept(directory: Path, suffix: str) -> Path:
    (path,) = (directory / "__pycache__").glob(f"doubling.twice-*.{suffix}")
    return path


def test_what_was_compiled_is_kept(load: Callable[[], Any]) -> None:
    first, second = load(), load()
    assert (first(3), second(4)) == (6, 8)
    assert sum(first.stats.cache_misses.values()) == 1
    assert sum(second.stats.cache_hits.values()) == 1


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("left", [0, 20])
def test_what_is_damaged_is_renewed(
    load: Callable[[], Any],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    suffix: str,
    left: int,
) -> None:
    load()(3)
    path = kept(tmp_path, suffix)
    path.write_bytes(path.read_bytes()[:left])
    with caplog.at_level(logging.WARNING):
        assert load()(5) == 10
    (line,) = caplog.messages
    assert "twice" in line
    assert "damaged, and is renewed" in line
    renewed = load()
    assert renewed(6) == 12
    assert sum(renewed.stats.cache_hits.values()) == 1
    assert len(caplog.messages) == 1


def test_without_a_place_it_is_said_once(
    load: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def read_only(self: Any) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(caching._CacheLocator, "ensure_cache_path", read_only)
    first, second = load(), load()
    assert (first(3), second(4.0)) == (6, 8.0)
    (line,) = caplog.messages
    assert line.startswith("compiled loops can't be kept: neither the installation nor the user's")
    assert "NUMBA_CACHE_DIR" in line


def test_a_full_disk_is_said_once(
    load: Callable[[], Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def full(self: Any, path: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(caching.IndexDataCacheFile, "_open_for_write", full)
    function = load()
    assert (function(3), function(4.0)) == (6, 8.0)
    (line,) = caplog.messages
    assert line.startswith(
        "compiled loops can't be kept: numba's cache can't be written: No space left on device;"
    )
