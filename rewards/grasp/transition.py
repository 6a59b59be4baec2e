"""The snapshot that rewards are computed from: one step of N environments."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class GraspTransition:
    """A snapshot of N environments after one action, before any of them is reset.

    Points and vectors are in the world frame (metres, Z up) unless said otherwise.

    Attributes:
        previous_tooltip_m: (N, 3) centre of the cup's face before the action.
        tooltip_m: (N, 3) the same point after the action.
        tool_axis: (N, 3) unit vector z_tool, pointing out of the cup.
        duration_s: (N,) time which the motion took.
        target_point_m: (N, 3) grasp point on the target block's face.
        target_normal: (N, 3) unit outward normal of that face.
        offset_m: (N, 3) tooltip in the block frame: lateral x, vertical y, gap z along the
            outward normal.
        yaw_error_rad: (N,) angle about the vertical between the tool and the face.
        touched: (N,) the cup touched the target block.
        collided: (N,) an undesired contact happened.
        position_right: (N,) the tooltip is inside the goal region.
        rotation_right: (N,) the position is right and the yaw error is within its limit.
        touched_before: (N,) the cup touched the target at an earlier step of this episode.
        position_right_before: (N,) the position was right at an earlier step of this episode.
        rotation_right_before: (N,) the rotation was right at an earlier step of this episode.
    """

    previous_tooltip_m: Floats
    tooltip_m: Floats
    tool_axis: Floats
    duration_s: Floats
    target_point_m: Floats
    target_normal: Floats
    offset_m: Floats
    yaw_error_rad: Floats
    touched: Bools
    collided: Bools
    position_right: Bools
    rotation_right: Bools
    touched_before: Bools
    position_right_before: Bools
    rotation_right_before: Bools
