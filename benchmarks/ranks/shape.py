"""How much each rank does."""

ENVS, BUFFER, BATCH = 64, 2_048, 256
EPISODE_STEPS = 10
"""Of the run file: actions that are tried at an image, unless one succeeds."""
