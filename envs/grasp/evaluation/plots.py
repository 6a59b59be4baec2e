"""Figures of an evaluation, as PNG: what the policy saw and commanded, and its errors."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from encoders.spaces import NOTHING_SEEN
from envs.grasp.evaluation.outcome import Outcome
from envs.grasp.evaluation.overlay import cup_lines, goal_pose
from envs.grasp.evaluation.pose_errors import PoseErrors, Sample, outcome_label
from envs.grasp.sensors.camera import CameraPoses, project

Floats = NDArray[np.float64]

COLUMNS = 6
TRUE_COLOR, COMMAND_COLOR = "white", "magenta"
NOTHING_SEEN_COLOR = "gray"
GOOD_COLOR, BAD_COLOR = "tab:green", "tab:red"
OUTCOME_COLORS = {
    "": "tab:blue",
    Outcome.SUCCESS: GOOD_COLOR,
    Outcome.COLLISION: BAD_COLOR,
    Outcome.MISSED: "tab:blue",
    Outcome.NO_SEAL: "tab:orange",
    Outcome.DROPPED: "tab:purple",
}
BINS = 40
# Histograms leave out what lies beyond, so that a few wild errors do not squeeze the others.
SHOWN_PERCENTILE = 98.0
FARTHEST_PERCENTILE = 97.0
DPI = 110


def contact_sheet(samples: Sequence[Sample], cup_radius_m: float) -> bytes:
    """Camera pictures, with the cup drawn at the goal and where the policy sent it.

    Args:
        samples: the episodes, one or more. The goal is the middle of an episode's own region.
        cup_radius_m: of the cup's rim.
    """
    rows = math.ceil(len(samples) / COLUMNS)
    figure = Figure(figsize=(2.0 * COLUMNS, 2.25 * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, COLUMNS, squeeze=False)
    for axes in grid.flat:
        axes.axis("off")
    for axes, sample in zip(grid.flat, samples, strict=False):
        _show(axes, sample.image)
        goal_m, goal_yaw_rad = goal_pose(sample.scene, sample.errors.region)
        for tooltip_m, yaw_rad, color in (
            (goal_m, goal_yaw_rad, TRUE_COLOR),
            (sample.tooltip_m, sample.yaw_rad, COMMAND_COLOR),
        ):
            _draw_lines(axes, sample.view, cup_lines(tooltip_m, yaw_rad, cup_radius_m), color)
        good = sample.errors.outcome[0] in ("", "success")
        axes.set_title(sample.caption, fontsize=8, color="black" if good else BAD_COLOR)
    figure.suptitle(
        "The cup at the goal (white) and where the policy sends it (magenta); "
        "the line is the tool's axis",
        fontsize=10,
    )
    return _png(figure)


def error_histograms(errors: PoseErrors) -> bytes:
    """Signed errors of the commands, in the block frame, with the goal region shaded.

    Where the episodes' regions differ, the shaded one has their mean limits.
    """
    region = errors.region
    half_gap_m = (region.gap_limit_m - region.gap_min_m) / 2.0
    lateral, vertical, gap = errors.error_m.T * 1000.0
    panels = (
        ("sideways", lateral, region.lateral_limit_m * 1000.0, "mm"),
        ("up", vertical, region.vertical_limit_m * 1000.0, "mm"),
        ("gap", gap, half_gap_m * 1000.0, "mm"),
        ("yaw", errors.yaw_error_deg, region.yaw_limit_deg, "deg"),
    )
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    for axes, (name, off, limits, unit) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        limit = float(limits.mean())
        reach = max(float(np.percentile(np.abs(off), SHOWN_PERCENTILE)), 1.5 * limit)
        axes.axvspan(-limit, limit, color=GOOD_COLOR, alpha=0.2, linewidth=0)
        axes.hist(off, BINS, range=(-reach, reach), color="tab:blue")
        inside = np.mean(np.abs(off) <= limits)
        width = f"±{limit:.3g} {unit}" if np.ptp(limits) == 0.0 else "their limits"
        axes.set_title(
            f"{name}: {np.median(np.abs(off)):.1f} {unit} off in the median, "
            f"{inside:.0%} within {width}",
            fontsize=9,
        )
        axes.set(xlabel=f"{name} error ({unit})", ylabel="episodes", xlim=(-reach, reach))
    figure.suptitle(f"First actions: {len(errors.error_m)} episodes", fontsize=10)
    return _png(figure)


def workspace(errors: PoseErrors) -> bytes:
    """Errors over the positions on the support, and over the yaws."""
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    above, turned = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
    distance_mm = errors.distance_m * 1000.0
    dots = above.scatter(
        errors.target_m[:, 1],
        errors.target_m[:, 0],
        c=distance_mm,
        s=14,
        cmap="viridis",
        vmin=0.0,
        vmax=float(np.percentile(distance_mm, SHOWN_PERCENTILE)),
    )
    above.invert_xaxis()  # as the robot sees it: forward is up, and its left is on the left
    above.set_aspect("equal")
    above.set(xlabel="target y (m)", ylabel="target x (m)")
    above.set_title("position error over the support, from above", fontsize=9)
    figure.colorbar(dots, ax=above, location="bottom", label="position error (mm)")
    for outcome, color in OUTCOME_COLORS.items():
        rows = errors.outcome == outcome
        if rows.any():
            yaw, yaw_error = errors.target_yaw_deg[rows], errors.yaw_error_deg[rows]
            turned.scatter(yaw, yaw_error, s=10, color=color, label=outcome_label(outcome))
    turned.axhline(0.0, color="gray", linewidth=0.8)
    if errors.outcome[0]:
        turned.legend(fontsize=8)
    reach = max(float(np.percentile(np.abs(errors.yaw_error_deg), SHOWN_PERCENTILE)), 1.0)
    turned.set(xlabel="target yaw (deg)", ylabel="yaw error (deg)", ylim=(-reach, reach))
    turned.set_title("yaw error over the target's yaw", fontsize=9)
    return _png(figure)


def _show(axes: Axes, image: NDArray[Any]) -> None:
    """Shows an image (H, W, C), its pixels' corners at whole numbers.

    Of depth, near is red, and what was not seen is gray.
    """
    height, width, channels = image.shape
    place: dict[str, Any] = {"extent": (0, width, height, 0), "interpolation": "nearest"}
    if channels == 3:
        axes.imshow(image, **place)
    else:
        depth = np.ma.masked_equal(image[..., 0], NOTHING_SEEN)
        seen = depth.compressed() if depth.count() else np.ones(1)
        colors = colormaps["turbo_r"].with_extremes(bad=NOTHING_SEEN_COLOR)
        high = np.percentile(seen, FARTHEST_PERCENTILE)
        axes.imshow(depth, cmap=colors, vmin=seen.min(), vmax=high, **place)
    axes.set(xlim=(0, width), ylim=(height, 0))


def _draw_lines(axes: Axes, view: CameraPoses, lines: Sequence[Floats], color: str) -> None:
    """Draws lines (k, 3) of the world into the image of a view."""
    for points in lines:
        u, v, _ = project(view, points[None])[0].T
        axes.plot(u, v, color="black", linewidth=2.6)
        axes.plot(u, v, color=color, linewidth=1.6)


def _png(figure: Figure) -> bytes:
    FigureCanvasAgg(figure)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI)
    return file.getvalue()
