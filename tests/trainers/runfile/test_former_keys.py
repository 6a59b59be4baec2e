"""What becomes of keys that run files of before have."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, ClassVar

import pytest
from pydantic import BaseModel

from trainers.runfile.former_keys import brought_up_to_date, tell

Section = dict[str, Any]


class Settings(BaseModel):
    renamed_keys: ClassVar[Mapping[str, str]] = {"arm.reach_m": "reach_m", "arm.pace": "arm.speed"}
    dropped_keys: ClassVar[Mapping[str, str]] = {"checks": "they are continuous now"}


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ({"arm": {"reach_m": 0.2, "pace": 3}, "checks": 4}, {"reach_m": 0.2, "arm": {"speed": 3}}),
        ({"arm": {"reach_m": 0.2}, "reach_m": 0.1}, {"arm": {}, "reach_m": 0.1}),
        ({"arm": {"pace": 3, "speed": 4}}, {"arm": {"speed": 4}}),
        ({"checks": None}, {}),
        ({"arm": 5, "other": 1}, {"arm": 5, "other": 1}),
        ({"arm": {"checks": 4}}, {"arm": {"checks": 4}}),
    ],
)
def test_former_keys_give_way_to_present_ones(written: Section, expected: Section) -> None:
    assert brought_up_to_date(written, (), Settings)[0] == expected


def test_each_former_key_is_told_of() -> None:
    written = {"arm": {"pace": 3, "reach_m": 0.2}, "reach_m": 0.1, "checks": 4}
    _, changes = brought_up_to_date(written, ("environment",), Settings)
    assert changes == {
        ("environment", "checks"): "passed over: they are continuous now",
        ("environment", "arm", "pace"): "read as environment.arm.speed, which is its name now",
        ("environment", "arm", "reach_m"): (
            "passed over for the present environment.reach_m, which is its name now"
        ),
    }
    assert written == {"arm": {"pace": 3, "reach_m": 0.2}, "reach_m": 0.1, "checks": 4}


def test_a_model_that_names_no_former_keys_has_none() -> None:
    assert brought_up_to_date({"checks": 4}, (), BaseModel) == ({"checks": 4}, {})


def test_a_message_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "ventosa"):
        for text in ("old.yaml:1: 100 % of it", "old.yaml:1: 100 % of it", "old.yaml:2: more"):
            tell(text)
    assert caplog.messages == ["old.yaml:1: 100 % of it", "old.yaml:2: more"]
