"""What this distribution adds to ventosa; the entry point in pyproject.toml names this module."""

from trainers.hookspecs import hookimpl
from ventosa_example.mean_pool import MeanPool
from ventosa_example.near import Near


@hookimpl
def ventosa_encoders() -> dict[str, type]:
    """Return the encoders by name."""
    return {"mean_pool": MeanPool}


@hookimpl
def ventosa_rewards() -> dict[str, type]:
    """Return the rewards by name."""
    return {"near": Near}
