"""Figures of an evaluation, as PNG: what the policy saw and where it aimed, and its errors."""

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
from envs.grasp.evaluation.pick import Outcome
from envs.grasp.evaluation.pose_errors import PoseErrors, Sample, outcome_label
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import heading
from envs.grasp.sensors.camera import project
from envs.grasp.settings import Goal

Floats = NDArray[np.float64]

COLUMNS = 6
STEM_M = 0.08
RIM_POINTS = 48
TRUE_COLOR, AIM_COLOR = "white", "magenta"
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


def contact_sheet(shots: Sequence[Sample], goal_m: Floats) -> bytes:
    """Camera pictures, with the cup drawn at the goal and where the policy sent it.

    Args:
        shots: the episodes, one or more.
        goal_m: (3,) middle of the goal region, in the block frame.
    """
    rows = math.ceil(len(shots) / COLUMNS)
    figure = Figure(figsize=(2.0 * COLUMNS, 2.25 * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, COLUMNS, squeeze=False)
    for axes in grid.flat:
        axes.axis("off")
    for axes, shot in zip(grid.flat, shots, strict=False):
        _show(axes, shot.image)
        true_yaw_rad = float(shot.scene.target_yaw_rad[0])
        goal = shot.scene.target_m[0] + _in_world(goal_m, true_yaw_rad)
        _draw_cup(axes, shot, goal, true_yaw_rad, TRUE_COLOR)
        _draw_cup(axes, shot, shot.tooltip_m, shot.yaw_rad, AIM_COLOR)
        good = shot.judged.outcome[0] in ("", "success")
        axes.set_title(shot.caption, fontsize=8, color="black" if good else BAD_COLOR)
    figure.suptitle(
        "The cup at the goal (white) and where the policy sends it (magenta); "
        "the line is the tool's axis",
        fontsize=10,
    )
    return _png(figure)


def error_histograms(judged: PoseErrors, goal: Goal) -> bytes:
    """Signed errors of the commands, in the block frame, with the goal region shaded."""
    half_gap_mm = (goal.gap_limit_m - goal.gap_min_m) / 2 * 1000.0
    lateral, vertical, gap = judged.error_m.T * 1000.0
    panels = (
        ("sideways", lateral, goal.lateral_limit_m * 1000.0, "mm"),
        ("up", vertical, goal.vertical_limit_m * 1000.0, "mm"),
        ("gap", gap, half_gap_mm, "mm"),
        ("yaw", judged.yaw_error_deg, goal.yaw_limit_deg, "deg"),
    )
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    for axes, (name, errors, limit, unit) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        reach = max(float(np.percentile(np.abs(errors), SHOWN_PERCENTILE)), 1.5 * limit)
        axes.axvspan(-limit, limit, color=GOOD_COLOR, alpha=0.2, linewidth=0)
        axes.hist(errors, BINS, range=(-reach, reach), color="tab:blue")
        inside = np.mean(np.abs(errors) <= limit)
        axes.set_title(
            f"{name}: {np.median(np.abs(errors)):.1f} {unit} off in the median, "
            f"{inside:.0%} within ±{limit:.3g} {unit}",
            fontsize=9,
        )
        axes.set(xlabel=f"{name} error ({unit})", ylabel="episodes", xlim=(-reach, reach))
    figure.suptitle(f"First actions: {len(judged.error_m)} episodes", fontsize=10)
    return _png(figure)


def workspace(judged: PoseErrors) -> bytes:
    """Errors over the positions on the support, and over the yaws."""
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    above, turned = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
    distance_mm = judged.distance_m * 1000.0
    dots = above.scatter(
        judged.target_m[:, 1],
        judged.target_m[:, 0],
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
        rows = judged.outcome == outcome
        if rows.any():
            yaw, error = judged.target_yaw_deg[rows], judged.yaw_error_deg[rows]
            turned.scatter(yaw, error, s=10, color=color, label=outcome_label(outcome))
    turned.axhline(0.0, color="gray", linewidth=0.8)
    if judged.outcome[0]:
        turned.legend(fontsize=8)
    reach = max(float(np.percentile(np.abs(judged.yaw_error_deg), SHOWN_PERCENTILE)), 1.0)
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


def _draw_cup(axes: Axes, shot: Sample, tooltip_m: Floats, yaw_rad: float, color: str) -> None:
    """Draws the cup's rim, and its axis back towards the robot."""
    angle = np.linspace(0.0, 2.0 * math.pi, RIM_POINTS)[:, None]
    ahead, up = heading(np.array(yaw_rad)), np.array([0.0, 0.0, 1.0])
    radius_m = load_robot().cup_radius_m
    rim = tooltip_m + radius_m * (np.cos(angle) * np.cross(up, ahead) + np.sin(angle) * up)
    stem = np.stack([tooltip_m, tooltip_m - STEM_M * ahead])
    for points in (rim, stem):
        u, v, _ = project(shot.view, points[None])[0].T
        axes.plot(u, v, color="black", linewidth=2.6)
        axes.plot(u, v, color=color, linewidth=1.6)


def _in_world(offset_m: Floats, yaw_rad: float) -> Floats:
    """An offset (3,) of the block frame, lateral, vertical and gap, in the world frame."""
    sine, cosine = math.sin(yaw_rad), math.cos(yaw_rad)
    lateral, vertical, gap = offset_m
    return np.array([sine * lateral - cosine * gap, -cosine * lateral - sine * gap, vertical])


def _png(figure: Figure) -> bytes:
    FigureCanvasAgg(figure)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI)
    return file.getvalue()
