"""Whose an exception is: an installed plugin's, or ventosa's."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from envs.environment import EnvironmentFailure
from trainers.common.origin import PluginFailure, blaming_plugins
from trainers.networks.actions import to_environment

SOURCE = """
import json
import sys

def divides():
    return 1 / 0

def calls_a_library():
    return json.loads("{")

def leaves():
    sys.exit(3)

def calls_back(function):
    return function()

def fails(error):
    raise error
"""


@pytest.fixture
def plugin(install_plugin: Callable[[str, str], Path]) -> ModuleType:
    install_plugin("whose_fault", SOURCE)
    return importlib.import_module("whose_fault")


def test_a_plugin_is_named_with_its_distribution_and_its_own_lines(plugin: ModuleType) -> None:
    with pytest.raises(PluginFailure) as failed, blaming_plugins():
        plugin.calls_back(plugin.divides)
    assert str(failed.value) == (
        "plugin 'own' (whose-fault 1.2) failed: ZeroDivisionError: division by zero"
    )
    lines = [line.strip() for line in failed.value.lines.splitlines()]
    assert [line for line in lines if line.startswith("return")] == [
        "return function()",
        "return 1 / 0",
    ]
    files = [line for line in lines if line.startswith("File")]
    assert len(files) == 2
    assert all("whose_fault.py" in line for line in files)
    assert isinstance(failed.value.__cause__, ZeroDivisionError)


def test_what_a_library_raises_is_of_the_plugin_that_called_it(plugin: ModuleType) -> None:
    with pytest.raises(PluginFailure, match="JSONDecodeError") as failed, blaming_plugins():
        plugin.calls_a_library()
    assert "json/" not in failed.value.lines


def test_sys_exit_in_a_plugin_is_a_failure_of_it(plugin: ModuleType) -> None:
    with pytest.raises(PluginFailure, match=r"1\.2\) failed: SystemExit: 3$"), blaming_plugins():
        plugin.leaves()


def test_a_bug_of_ours_stays_one_where_a_plugin_called(plugin: ModuleType) -> None:
    with pytest.raises(AttributeError), blaming_plugins():
        plugin.calls_back(lambda: to_environment(np.zeros(1), None))  # type: ignore[arg-type]


@pytest.mark.parametrize("error", [EnvironmentFailure("loose"), KeyboardInterrupt()])
def test_what_is_told_or_the_users_passes(plugin: ModuleType, error: BaseException) -> None:
    with pytest.raises(type(error)), blaming_plugins():
        plugin.fails(error)


def test_without_a_plugin_nobody_is_blamed() -> None:
    with pytest.raises(SystemExit), blaming_plugins():
        raise SystemExit(2)
