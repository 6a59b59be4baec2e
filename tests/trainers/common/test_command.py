"""How commands tell what goes wrong, and with which exit code they end."""

from __future__ import annotations

import argparse

import pytest

from envs.environment import EnvironmentFailure
from envs.grasp.scene.sampler import SceneError
from rewards.reward import RewardError
from trainers.common.command import tells_failures, told
from trainers.common.errors import NonFiniteError, UserError


@tells_failures
def command(error: BaseException | None = None) -> int:
    if error is not None:
        raise error
    return 7


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UserError("the way out"), 2),
        (EnvironmentFailure("a cable came loose"), 1),
        (SceneError("no room"), 1),
        (RewardError("no numbers"), 1),
        (NonFiniteError("step 4: the reward is nan"), 1),
    ],
)
def test_mistakes_and_failures_are_a_line_with_its_exit_code(
    error: Exception, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    message = str(error)
    error.add_note("the last good checkpoint is here")
    assert command(error) == code
    assert capsys.readouterr().err == f"error: {message}; the last good checkpoint is here\n"


def test_what_ends_well_has_its_own_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert command() == 7
    assert command(KeyboardInterrupt()) == 130
    assert capsys.readouterr().err == ""


def test_a_bug_keeps_its_traceback() -> None:
    with pytest.raises(KeyError):
        command(KeyError("a bug"))


def test_a_mistyped_option_ends_as_argparse_ends_it() -> None:
    @tells_failures
    def main() -> int:
        argparse.ArgumentParser().parse_args(["--bogus"])
        return 0

    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2


def test_what_is_no_message_is_told_with_its_type() -> None:
    error = ZeroDivisionError("division by zero")
    error.add_note("saved")
    assert told(error) == "ZeroDivisionError: division by zero; saved"
