from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from envs.grasp.scene.blocks import MIN_BAR_M
from envs.grasp.settings import MAX_CONTACT_RESOLUTION_M, GraspSettings


@pytest.mark.parametrize("value", [0.0, -0.005, 9e-7, 0.021, 1.0, float("inf"), float("nan")])
def test_a_resolution_without_end_or_coarser_than_a_block_is_refused(value: float) -> None:
    with pytest.raises(ValidationError, match=r"contact_resolution_m\n.*give 1e-06 to 0.02 m"):
        GraspSettings(contact_resolution_m=value)


def test_the_coarsest_resolution_passes_through_no_block() -> None:
    assert min(MIN_BAR_M, GraspSettings().randomize.block_depth_m[0]) > 2 * MAX_CONTACT_RESOLUTION_M


@pytest.mark.parametrize("value", [0.0, -0.1, 1.01, 100.0, float("inf"), float("nan")])
def test_a_standoff_that_no_arm_has_is_refused(value: float) -> None:
    with pytest.raises(ValidationError, match="standoff_m"):
        GraspSettings(standoff_m=value)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("workspace", "x_m"), [0.9, float("inf")]),
        (("support", "y_m"), [float("-inf"), 0.5]),
        (("randomize", "block_x_m"), [float("nan"), 1.3]),
        (("cameras", "depth", "range_m"), [0.4, float("nan")]),
        (("cameras", "depth", "position_m"), [0.4, float("nan"), 1.0]),
    ],
)
def test_numbers_that_are_not_finite_are_refused(path: tuple[str, ...], value: list[float]) -> None:
    section: dict[str, Any] = {path[-1]: value}
    if "cameras" in path:
        section["type"] = "depth"
    for name in reversed(path[:-1]):
        section = {name: section}
    with pytest.raises(ValidationError, match=r"finite number") as caught:
        GraspSettings.model_validate(section)
    assert ".".join(path) in str(caught.value)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"x_m": (1.0, 1.0)}, r"x_m \[1.0, 1.0\] has no width"),
        ({"yaw_deg": (-40.0, 1e9)}, r"yaw_deg \[-40.0, 1000000000.0\]: keep it within \+-180"),
    ],
)
def test_workspaces_that_no_action_covers_are_refused(
    section: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        GraspSettings.model_validate({"workspace": section})
    assert GraspSettings.model_validate({"workspace": {"yaw_deg": (-180.0, 180.0)}})


def test_a_micrometre_is_fine_enough() -> None:
    assert GraspSettings(contact_resolution_m=1e-6).contact_resolution_m == 1e-6


def test_motions_are_those_two() -> None:
    assert GraspSettings().motion == "standoff"
    with pytest.raises(ValidationError, match="'standoff' or 'direct'"):
        GraspSettings.model_validate({"motion": "straight"})


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"sampling": {"crop": [1, 0, 80, 80]}}, r"crop \[1, 0, 80, 80\] leaves .* 80x80"),
        ({"sampling": {"every": 0}}, "greater than or equal to 1|greater than 0"),
        (
            {"fov_deg": 44.0, "intrinsics": {"fx": 9.0, "fy": 9.0, "cx": 1.0, "cy": 1.0}},
            "intrinsics and fov_deg say the same",
        ),
        ({"intrinsics": {"fx": 9.0, "fy": 0.0, "cx": 1.0, "cy": 1.0}}, "greater than 0"),
    ],
)
def test_cameras_that_can_not_be_are_refused(camera: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        GraspSettings.model_validate({"cameras": {"depth": {"type": "depth"} | camera}})
