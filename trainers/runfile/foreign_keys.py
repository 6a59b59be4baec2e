"""Keys of other trainers' files, and where a run file has what they say."""

from __future__ import annotations

from typing import Any

from trainers.runfile.yaml_document import Document, Problem

CONVERT = "`python -m trainers.convert FILE` makes a run file of ML-Agents' trainer configuration"
HYPER, NETWORK = "trainer.hyperparameters", "trainer.network_settings"

RL_ZOO = {
    "n_timesteps": "trainer.max_steps",
    "n_envs": "environment.num_envs",
    "policy": f"nothing: networks follow from the observations, see {NETWORK} and encoders",
    "policy_kwargs": f"{NETWORK} and encoders",
    "net_arch": f"{NETWORK}.hidden_units and num_layers",
    "activation_fn": f"{NETWORK}.activation",
    "log_std_init": f"{NETWORK}.initial_std, which it is the logarithm of",
    "normalize": f"{NETWORK}.normalize and, of PPO and TRPO, {HYPER}.normalize_rewards",
    "env_wrapper": "an id of your own that wraps the environment, see docs/gymnasium.md",
    "n_steps": f"{HYPER}.buffer_size of PPO and TRPO, n_steps times environment.num_envs",
    "n_epochs": f"{HYPER}.num_epoch",
    "ent_coef": f"{HYPER}.beta",
    "vf_coef": f"{HYPER}.value_coefficient",
    "clip_range": f"{HYPER}.epsilon",
    "clip_range_vf": f"{HYPER}.value_clipping",
    "gae_lambda": f"{HYPER}.lambd",
    "max_grad_norm": f"{HYPER}.max_gradient_norm",
    "learning_starts": f"{HYPER}.buffer_init_steps",
    "gradient_steps": f"{HYPER}.updates_per_step, gradient_steps through train_freq",
    "train_freq": f"{HYPER}.updates_per_step, gradient_steps through train_freq",
    "noise_type": f"{HYPER}.noise.type",
    "noise_std": f"{HYPER}.noise.sigma",
}
"""Keys of RL-Zoo and Stable-Baselines3 -> what there is in a run file."""

ML_AGENTS = (
    *("behaviors", "default_settings", "env_settings", "engine_settings", "checkpoint_settings"),
    *("torch_settings", "reward_signals", "time_horizon", "threaded", "self_play"),
    *("vis_encode_type", "behavioral_cloning", "init_path", "completion_criteria"),
)
KEYS = {
    **{key: f"RL-Zoo's; in a run file it is {target}" for key, target in RL_ZOO.items()},
    **dict.fromkeys(ML_AGENTS, f"ML-Agents'; {CONVERT}"),
    "curriculum": "a curriculum is a section of its own at the top, whose lessons set the "
    f"parameters; {CONVERT}",
}
"""Keys that a run file does not have, or not in this place -> the way out."""


def way_out(keys: Any) -> str | None:
    """What is there instead of the first of some keys that is another trainer's; None: of none."""
    return next((KEYS[key] for key in keys if key in KEYS), None)


def foreign_file(document: Document) -> Problem | None:
    """What to do with a file that is another trainer's as a whole; None if it is none."""
    data = document.data
    if "behaviors" in data:
        message = (
            "is ML-Agents' trainer configuration, and no run file: `python -m trainers.convert "
            f"{document.origin}` makes one of it"
        )
        return Problem(document.where(("behaviors",)), (), message)
    for key, section in data.items():
        if "trainer" not in data and isinstance(section, dict) and "n_timesteps" in section:
            message = (
                "has RL-Zoo's hyper-parameters, and is no run file: write environment: {type: "
                f"gymnasium, id: {key}}} and a trainer, as docs/coming_from.md says"
            )
            return Problem(document.where((key,)), (), message)
    return None
