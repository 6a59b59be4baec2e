"""The environments that ventosa brings along."""

from envs.grasp.vector_env import GraspVectorEnv
from envs.gym.vector_env import GymEnvironment
from trainers.hookspecs import hookimpl


@hookimpl
def ventosa_environments() -> dict[str, type]:
    """Built-in environments by name."""
    return {"grasp": GraspVectorEnv, "gymnasium": GymEnvironment}
