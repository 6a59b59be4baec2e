"""The rewards that ventosa brings along."""

from rewards.grasp.events import Collision, Position, Rotation, Sparse, Touch
from rewards.grasp.shaping import Approach, Facing, Precision
from rewards.gym.environment import EnvironmentReward
from trainers.hookspecs import hookimpl


@hookimpl
def ventosa_rewards() -> dict[str, type]:
    """Built-in rewards by name."""
    return {
        "touch": Touch,
        "collision": Collision,
        "position": Position,
        "rotation": Rotation,
        "approach": Approach,
        "facing": Facing,
        "precision": Precision,
        "sparse": Sparse,
        "environment": EnvironmentReward,
    }
