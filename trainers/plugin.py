"""The algorithms that ventosa brings along."""

from trainers.ddpg import DDPG
from trainers.hookspecs import hookimpl
from trainers.ppo import PPO
from trainers.trpo import TRPO


@hookimpl
def ventosa_trainers() -> dict[str, type]:
    """Return the built-in algorithms by name."""
    return {"ddpg": DDPG, "ppo": PPO, "trpo": TRPO}
