"""Keys of ML-Agents' trainer configurations, and what becomes of each in a run file.

Names, defaults and meanings are those of mlagents/trainers/settings.py and of
docs/Training-Configuration-File.md in its repository.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from trainers.runfile.yaml_document import KeyPath, dotted


@dataclass(frozen=True)
class Kept:
    """A setting that a run file has, too."""

    target: str
    """Dotted path in the run file."""
    said: str = ""
    """How it is another one there."""
    change: Callable[[Any], Any] | None = None
    """What makes its number, or its true or false, the run file's."""
    absent: Any = None
    """A value, besides null, that is as good as none."""
    otherwise: str = "this trainer has no such setting"
    """Why it is dropped with a trainer that doesn't have it."""


Fate = Kept | str
"""What becomes of a key; text is why it is dropped."""

HYPERPARAMETERS = (
    "batch_size",
    "beta",
    "beta_schedule",
    "buffer_init_steps",
    "buffer_size",
    "epsilon",
    "epsilon_schedule",
    "lambd",
    "learning_rate",
    "learning_rate_schedule",
    "num_epoch",
    "save_replay_buffer",
    "tau",
)

BEHAVIOR: Mapping[str, Fate] = {
    "trainer_type": Kept("trainer.trainer_type"),
    **{
        name: Kept(f"trainer.{name}")
        for name in ("max_steps", "summary_freq", "checkpoint_interval", "keep_checkpoints")
    },
    "time_horizon": Kept(
        "trainer.time_horizon",
        otherwise="each environment is played for buffer_size / environment.num_envs steps before "
        "an update",
    ),
    "threaded": "environments and updates take turns",
    "even_checkpoints": "checkpoint_interval says when",
    "init_path": "an option of the command line: --initialize-from RUN",
    "self_play": "an agent does not play against former ones of its own",
    "behavioral_cloning": "there is no learning from demonstrations",
    **{
        f"hyperparameters.{name}": Kept(f"trainer.hyperparameters.{name}")
        for name in HYPERPARAMETERS
    },
    "hyperparameters.init_entcoef": Kept("trainer.hyperparameters.init_entropy_coefficient"),
    "hyperparameters.steps_per_update": Kept(
        "trainer.hyperparameters.updates_per_step",
        "its reciprocal",
        lambda steps: 1.0 / steps if steps else steps,
    ),
    "hyperparameters.reward_signal_steps_per_update": "there are no other reward signals",
    "hyperparameters.shared_critic": Kept(
        "trainer.network_settings.critic",
        change=lambda shared: "shared" if shared else "separate",
    ),
    **{
        f"network_settings.{name}": Kept(f"trainer.network_settings.{name}")
        for name in ("hidden_units", "num_layers", "normalize", "memory")
    },
    "network_settings.memory.sequence_length": Kept(
        "trainer.network_settings.memory.sequence_length"
    ),
    "network_settings.memory.memory_size": Kept(
        "trainer.network_settings.memory.memory_size",
        "half of it: there the cell state counts, too",
        lambda size: size // 2,
    ),
    "network_settings.vis_encode_type": "`encoders` says it for each observation by its name: "
    "`encoders: {observation: {type: resnet}}`; images have `simple` unless it does",
    "network_settings.goal_conditioning_type": "an observation that is a goal is one as any other",
    "network_settings.deterministic": "policies are judged by their most probable action",
    "reward_signals.extrinsic.gamma": Kept("trainer.hyperparameters.gamma"),
    "reward_signals.extrinsic.strength": Kept(
        "rewards",
        "the weight of the environment's own",
        lambda strength: [{"type": "environment", "weight": strength}],
        absent=1.0,
    ),
    "reward_signals.extrinsic": "it is said of a reward that has no network",
    "reward_signals": "the environment's own reward is what there is, and reward plugins "
    "(docs/plugins.md)",
}
"""Of a behavior; where none is of a key itself, that of what is around it holds."""

TOP: Mapping[str, Fate] = {
    "env_settings.num_envs": Kept(
        "environment.num_envs", "environments here, processes of Unity with several agents there"
    ),
    "env_settings.seed": Kept("seed", absent=-1),
    "env_settings.env_path": "environment.id says which environment",
    "env_settings": "of Unity's processes; environment.vectorization and environment.timeout_s are "
    "what there is",
    "engine_settings": "of Unity's window and clock",
    "checkpoint_settings": "options of the command line: --run-id, --resume, --force, "
    "--initialize-from, --results-dir",
    "torch_settings.device": Kept("device"),
    "debug": "there is no such setting",
}
"""Of the top, but for the behaviors and the environment parameters."""

LESSON: Mapping[str, Fate] = {
    "name": Kept("curriculum.lessons.*.name"),
    "completion_criteria.threshold": Kept("curriculum.lessons.*.threshold"),
    "completion_criteria.measure": Kept("curriculum.measure"),
    "completion_criteria.min_lesson_length": Kept(
        "curriculum.min_lesson_length",
        "and smoothing_episodes: there the mean over so many episodes has to be over the "
        "threshold once, here for so many; without effect on progress",
    ),
    "completion_criteria.behavior": "a run has one",
    "completion_criteria.signal_smoothing": "the mean is not smoothed a second time",
    "completion_criteria.require_reset": "a lesson begins with each environment's next episode",
}
"""Of a lesson but for its value; the last one's criteria are dropped."""

FLOORS = {"epsilon": 0.1, "beta": 1e-5}
"""Where ML-Agents' linear schedules end that don't end at 0 (its ppo/optimizer_torch.py)."""

DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "": {
        "trainer.summary_freq": 50_000,
        "trainer.checkpoint_interval": 500_000,
        "trainer.network_settings.hidden_units": 128,
        "trainer.network_settings.activation": "silu",
    },
    "ppo": {
        "trainer.hyperparameters.batch_size": 1024,
        "trainer.hyperparameters.buffer_size": 10_240,
        "trainer.hyperparameters.beta": 5e-3,
        "trainer.hyperparameters.beta_schedule": "linear",
        "trainer.hyperparameters.epsilon": 0.2,
        "trainer.hyperparameters.epsilon_schedule": "linear",
        "trainer.network_settings.critic": "separate",
    },
    "sac": {
        "trainer.hyperparameters.batch_size": 128,
        "trainer.hyperparameters.buffer_size": 50_000,
        "trainer.hyperparameters.buffer_init_steps": 0,
        "trainer.hyperparameters.learning_rate": 3e-4,
    },
}
"""Of all trainers (`""`) and by trainer: ML-Agents' defaults, and what it does always, where
ventosa's are others; and beta and epsilon, which the ends of their schedules are fractions of."""

UNKNOWN = "no setting of ML-Agents' that is known here"

FORMER_TOP = frozenset({"curriculum", "parameter_randomization"})
FORMER_BEHAVIOR = frozenset({"trainer", "batch_size", "use_recurrent"})
"""Keys that tell a file of ML-Agents before its release 7."""


def fate(table: Mapping[str, Fate], path: KeyPath) -> Fate:
    """Fate of a key, or of the nearest thing around it that the table has."""
    for length in range(len(path), 0, -1):
        if found := table.get(dotted(path[:length])):
            # A part of what is kept, and that the table does not have, is not kept with it.
            return found if length == len(path) or isinstance(found, str) else UNKNOWN
    return UNKNOWN
