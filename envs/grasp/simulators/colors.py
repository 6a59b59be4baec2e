"""Colors of what stands before the robot, the same in every simulator: red, green, blue, alpha."""

from envs.grasp.scene.surroundings import BACKDROP, CABLE, FLOOR, FRAME, THINGS

SUPPORT_RGBA = (0.55, 0.55, 0.58, 1.0)
# By the block's number, over and over.
BLOCK_RGBA = ((0.86, 0.24, 0.20, 1.0), (0.20, 0.50, 0.85, 1.0), (0.95, 0.75, 0.20, 1.0))

_PARTS_RGBA = (
    (FRAME, (0.35, 0.35, 0.38, 1.0)),
    (THINGS, (0.30, 0.62, 0.36, 1.0)),
    (CABLE, (0.12, 0.12, 0.12, 1.0)),
    (BACKDROP, (0.82, 0.80, 0.74, 1.0)),
    (FLOOR, (0.62, 0.58, 0.52, 1.0)),
)
# Of each box that stands around.
AROUND_RGBA = [rgba for part, rgba in _PARTS_RGBA for _ in range(part.start, part.stop)]
