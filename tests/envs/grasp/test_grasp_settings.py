from __future__ import annotations

import pytest
from pydantic import ValidationError

from envs.grasp.settings import GraspSettings


@pytest.mark.parametrize("value", [0.0, -0.005, 9e-7, float("nan")])
def test_a_resolution_that_no_motion_would_ever_end_at_is_refused(value: float) -> None:
    with pytest.raises(ValidationError, match=r"contact_resolution_m.*\n.*1e-06 m or more"):
        GraspSettings(contact_resolution_m=value)


def test_a_micrometre_is_fine_enough() -> None:
    assert GraspSettings(contact_resolution_m=1e-6).contact_resolution_m == 1e-6


def test_motions_are_those_two() -> None:
    assert GraspSettings().motion == "standoff"
    with pytest.raises(ValidationError, match="'standoff' or 'direct'"):
        GraspSettings.model_validate({"motion": "straight"})
