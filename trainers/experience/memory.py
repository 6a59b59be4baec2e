"""Room for what is collected between two updates."""

from __future__ import annotations

from envs.environment import Environment
from envs.memory import shortage, space_bytes
from trainers.common.errors import UserError

BYTES_PER_STEP = 4096
"""Of a step of all environments: the objects that its tensors are."""


def check_room(env: Environment, steps: int, setting: str) -> None:
    """Refuses to collect more than there is memory for.

    Args:
        env: the environments.
        steps: of each of them.
        setting: what says how many, for the message.

    Raises:
        UserError: with how much it would take.
    """
    per_step = env.num_envs * space_bytes(env.single_observation_space) + BYTES_PER_STEP
    if lack := shortage(steps * per_step, "collected between updates"):
        raise UserError(
            f"{setting}: to collect {steps * env.num_envs:,} transitions before an update {lack}: "
            "lower it"
        )
