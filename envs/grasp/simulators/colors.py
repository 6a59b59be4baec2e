"""Colors of what stands before the robot, the same in every simulator: red, green, blue, alpha."""

SUPPORT_RGBA = (0.55, 0.55, 0.58, 1.0)
# By the block's number, over and over.
BLOCK_RGBA = ((0.86, 0.24, 0.20, 1.0), (0.20, 0.50, 0.85, 1.0), (0.95, 0.75, 0.20, 1.0))
