"""The algorithms and loggers that ventosa brings along."""

from trainers.algorithms.ddpg import DDPG
from trainers.algorithms.ppo import PPO
from trainers.algorithms.trpo import TRPO
from trainers.hookspecs import hookimpl
from trainers.loggers.mlflow import MLflow
from trainers.loggers.tensorboard import TensorBoard
from trainers.loggers.wandb import WeightsAndBiases


@hookimpl
def ventosa_trainers() -> dict[str, type]:
    """Built-in algorithms by name."""
    return {"ddpg": DDPG, "ppo": PPO, "trpo": TRPO}


@hookimpl
def ventosa_loggers() -> dict[str, type]:
    """Built-in loggers by name."""
    return {"mlflow": MLflow, "tensorboard": TensorBoard, "wandb": WeightsAndBiases}
