"""What a run is made of, and how to go on with it."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from torch import nn

from trainers.learn import parse
from trainers.reporting.overview import memory, networks, policy_commands, resume_command


def test_layers_that_are_trained_are_listed_with_their_parameters() -> None:
    target = nn.Linear(3, 4).requires_grad_(False)
    policy = nn.ModuleDict(
        {"actor": nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1)), "target": target}
    )
    assert [line.split()[:2] for line in networks(policy)] == [
        ["networks:", "21"],
        ["actor.0", "16"],
        ["actor.2", "5"],
    ]


def test_memory_is_added_up() -> None:
    lines = memory({"replay buffer": 2.5e9, "networks": 4e6}, 25_000_000_000)
    assert lines[0] == "memory: 2.5 GB at least, of 25.0 GB"
    assert [line.split() for line in lines[1:]] == [
        ["replay", "buffer", "2.5", "GB"],
        ["networks", "4.0", "MB"],
    ]


@pytest.mark.parametrize(
    ("begun", "max_steps", "pasted"),
    [
        ("run.yaml", None, "run.yaml --resume"),
        ("run.yaml --force --initialize-from old", None, "run.yaml --resume"),
        (
            "'my run.yaml' trainer.max_steps=5 seed=1 --seed 0 --device cpu --results-dir 'a b'",
            10,
            "'my run.yaml' seed=1 trainer.max_steps=10 --seed 0 --device cpu --results-dir 'a b' "
            "--resume",
        ),
        ("run.yaml --run-id x --num-envs 4", None, "run.yaml --run-id x --num-envs 4 --resume"),
    ],
)
def test_a_run_goes_on_as_it_was_begun(begun: str, max_steps: int | None, pasted: str) -> None:
    command = resume_command(parse(shlex.split(begun)), max_steps)
    assert command == f"python -m trainers.learn {pasted}"


def test_a_policy_is_trusted_where_it_has_to_be() -> None:
    run = Path("results/my run")
    assert policy_commands(run, trust=True) == {
        "evaluate": "python -m trainers.evaluate 'results/my run' --trust",
        "export": "python -m trainers.export 'results/my run' 'policies/my run'",
    }
    assert "--trust" not in policy_commands(run, trust=False)["evaluate"]
