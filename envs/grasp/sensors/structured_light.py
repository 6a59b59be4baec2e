"""A structured-light camera, such as an Orbbec Astra, a Kinect or a PrimeSense: its faults.

A projector beside the camera throws a pattern; the camera finds each window of it again, some
pixels aside: the disparity, d = f b / z. What it measures errs for that reason: see
`StructuredLight`, and `envs.grasp.sensors.windows` for how an image comes about.

Sources: Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and
tracking", 3DIMPVT 2012 (axial and lateral noise); Handa, Whelan, McDonald and Davison, "A benchmark
for RGB-D visual odometry, 3D reconstruction and SLAM", ICRA 2014 (lateral jitter, then disparity in
steps, as simkinect has it); Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data
for indoor mapping applications", Sensors 2012 (disparity in eighths of a pixel).
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field, field_validator

from envs.grasp.ranges import Range

MAX_STRENGTH = 10.0
MIN_BASELINE_M = 0.001
RIGHT_ANGLE_DEG = 90.0


class Gaussian(BaseModel, frozen=True, extra="forbid"):
    """White noise of the camera's `noise_sigma_m`, as the paper has it, and nothing else."""

    type: Literal["gaussian"] = "gaussian"


class StructuredLight(BaseModel, frozen=True, extra="forbid"):
    """Faults of a structured-light camera, in pixels of its sensor whatever the sampling."""

    type: Literal["structured_light"] = "structured_light"
    strength: Range = Field(
        (1.0, 1.0),
        description="Factor on all of the faults below, drawn at every reset; 0: none of them. The "
        "environment parameter sensor_strength takes its place, but for focal lengths and centre.",
    )
    baseline_m: float = Field(
        0.075,
        ge=-1.0,
        le=1.0,
        description="How far to the right of the camera the projector is; less than 0: to the "
        "left.",
    )
    shadow: bool = Field(
        True,
        description="Whether what the projector does not see is missing: a shadow beside near "
        "things.",
    )
    disparity_step_px: float = Field(
        0.125,
        ge=0.0,
        le=4.0,
        description="Steps of the disparity; those of depth are z^2 / (f baseline_m) times it.",
    )
    window_px: float = Field(
        7.0,
        ge=1.0,
        le=64.0,
        description="Side of the window that is matched: over it noise and edges are correlated.",
    )
    jitter_px: float = Field(
        0.7,
        ge=0.0,
        le=8.0,
        description="Sigma of the sideways error, which makes edges ragged (Nguyen et al.: 0.5 to "
        "0.8).",
    )
    min_support: float = Field(
        0.55,
        ge=0.5,
        le=1.0,
        description="Share of a window that must lie on one surface for a match: what is nearer to "
        "an edge is missing, up to one pixel of the image.",
    )
    axial_sigma_m: float = Field(
        0.0012, ge=0.0, le=0.1, description="Sigma of the depth at 0.4 m (Nguyen et al.)."
    )
    axial_growth_per_m: float = Field(
        0.0019,
        ge=0.0,
        le=0.1,
        description="What sigma grows by with the square of the distance beyond 0.4 m (Nguyen et "
        "al.); beyond 60 deg of incidence it grows further.",
    )
    incidence_deg: Range = Field(
        (72.0, 84.0),
        description="Angle between ray and normal at which matches begin to fail, and at which all "
        "do.",
    )
    dark_blocks: float = Field(
        0.1, ge=0.0, le=1.0, description="Probability that a block is dark or shiny."
    )
    dark_patches: int = Field(
        3, ge=0, le=16, description="Dark or shiny places on table and blocks, at most."
    )
    dark_missing: Range = Field(
        (0.2, 0.8), description="Share of the pixels that is missing on what is dark, each drawn."
    )
    blob_px: float = Field(
        16.0, ge=1.0, le=256.0, description="Size of the holes in what is dark or at an incidence."
    )
    speck_fraction: float = Field(
        0.001, ge=0.0, le=1.0, description="Probability that any single pixel is missing."
    )
    depth_scale: float = Field(
        0.01, ge=0.0, le=0.2, description="Half range of the depths' relative error, drawn."
    )
    depth_offset_m: float = Field(
        0.003, ge=0.0, le=0.1, description="Half range of the depths' common error, drawn."
    )
    focal_scale: float = Field(
        0.01, ge=0.0, le=0.2, description="Half range of the focal lengths' relative error, drawn."
    )
    center_fraction: float = Field(
        0.01,
        ge=0.0,
        le=0.2,
        description="Half range of the optical axis's error, as a part of the image's sides, "
        "drawn.",
    )

    @field_validator("baseline_m")
    @classmethod
    def _baseline_is_possible(cls, value: float) -> float:
        if abs(value) < MIN_BASELINE_M:
            raise ValueError(
                f"without a baseline there is no disparity: it is {MIN_BASELINE_M:g} m at least, "
                "or less than 0 for a projector on the left"
            )
        return value

    @field_validator("strength")
    @classmethod
    def _strength_is_possible(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0.0 <= value[0] <= value[1] <= MAX_STRENGTH:
            raise ValueError(f"a strength is within 0 and {MAX_STRENGTH:g}")
        return value

    @field_validator("incidence_deg")
    @classmethod
    def _incidence_is_possible(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0.0 <= value[0] < value[1] <= RIGHT_ANGLE_DEG:
            raise ValueError("angles of incidence rise within 0 and 90 deg")
        return value

    @field_validator("dark_missing")
    @classmethod
    def _share_is_possible(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0.0 <= value[0] <= value[1] <= 1.0:
            raise ValueError("shares are within 0 and 1")
        return value
