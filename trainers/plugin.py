"""The algorithms that ventosa brings along."""

from trainers.algorithms.ddpg import DDPG
from trainers.algorithms.ppo import PPO
from trainers.algorithms.trpo import TRPO
from trainers.hookspecs import hookimpl


@hookimpl
def ventosa_trainers() -> dict[str, type]:
    """Built-in algorithms by name."""
    return {"ddpg": DDPG, "ppo": PPO, "trpo": TRPO}
