"""What a run is made of, and how to go on with it, in lines for people."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping
from pathlib import Path

from torch import nn

from envs.environment import Environment
from trainers.common.options import program

MAX_STEPS = "trainer.max_steps"


def aligned(entries: Mapping[str, str]) -> list[str]:
    """A line for each, with what follows the names in a column of its own."""
    width = max(map(len, entries), default=0)
    return [f"  {name:<{width}}  {text}" for name, text in entries.items()]


def spaces(env: Environment) -> list[str]:
    """What is observed, and what is done."""
    hidden = dict.fromkeys(env.privileged, "  (privileged: for critics)")
    observed = env.single_observation_space.items()
    return [
        "observations",
        *aligned({name: f"{space}{hidden.get(name, '')}" for name, space in observed}),
        "actions",
        f"  {env.single_action_space}",
    ]


def networks(policy: nn.Module) -> list[str]:
    """Layers that are trained, with their parameters; targets that follow others are not."""
    layers = {name: module for name, module in policy.named_modules() if _own_parameters(module)}
    entries = {k: f"{_own_parameters(layer):>11,}  {_shown(layer)}" for k, layer in layers.items()}
    return [f"networks: {parameter_count(policy):,} parameters", *aligned(entries)]


def memory(needs: Mapping[str, float], machine_bytes: int) -> list[str]:
    """Memory that is known to be needed, in bytes by what it is for, beside the machine's."""
    return [
        f"memory: {_bytes(sum(needs.values()))} at least, of {_bytes(machine_bytes)}",
        *aligned({name: f"{_bytes(count):>8}" for name, count in needs.items()}),
    ]


def parameter_count(policy: nn.Module) -> int:
    """Parameters that are trained."""
    return sum(map(_own_parameters, policy.modules()))


def policy_commands(run: Path, *, trust: bool) -> dict[str, str]:
    """Commands that a run's policy is used with, as they can be pasted.

    Args:
        run: its folder.
        trust: its environment imports what has to be allowed.
    """
    trusting = ["--trust"] if trust else []
    return {
        "evaluate": _pasted("evaluate", run, *trusting),
        "export": _pasted("export", run, Path("policies", run.name)),
    }


def resume_command(options: argparse.Namespace, max_steps: int | None = None) -> str:
    """Command that goes on with a run, as it can be pasted.

    Args:
        options: those that it was begun with, as `trainers.learn.parse` returns them.
        max_steps: steps of the whole run, if not those of before.
    """
    overrides = list(options.overrides)
    if max_steps is not None:
        overrides = [word for word in overrides if not word.startswith(f"{MAX_STEPS}=")]
        overrides.append(f"{MAX_STEPS}={max_steps}")
    flags = {
        "--run-id": options.run_id,
        "--seed": options.seed,
        "--num-envs": options.num_envs,
        "--device": options.device,
        "--results-dir": None if options.results_dir == Path("results") else options.results_dir,
    }
    given = [word for flag, value in flags.items() if value is not None for word in (flag, value)]
    return _pasted("learn", options.config, *overrides, *given, "--resume")


def _pasted(command: str, *words: object) -> str:
    return f"{program(command)} {shlex.join(map(str, words))}"


def _own_parameters(module: nn.Module) -> int:
    own = module.parameters(recurse=False)
    return sum(parameter.numel() for parameter in own if parameter.requires_grad)


def _shown(module: nn.Module) -> str:
    """A layer as torch shows it; of a module with layers in it, its name."""
    return type(module).__name__ if any(module.children()) else str(module)


def _bytes(count: float) -> str:
    return f"{count / 1e9:,.1f} GB" if count >= 1e9 else f"{count / 1e6:,.1f} MB"
