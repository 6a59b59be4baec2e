"""ML-Agents' trainer configurations as run files: values by hand, and every key accounted for."""

from __future__ import annotations

import contextlib
import copy
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from trainers.common.errors import UserError
from trainers.common.origin import Origin
from trainers.convert.__main__ import main
from trainers.convert.conversion import PLACEHOLDER, convert
from trainers.convert.source import leaves
from trainers.runfile.registry import Entry, Registries, Registry
from trainers.runfile.settings import load_run

BALL: dict[str, Any] = {
    "trainer_type": "ppo",
    "hyperparameters": {
        "batch_size": 64,
        "buffer_size": 6000,
        "learning_rate": 3e-4,
        "learning_rate_schedule": "constant",
        "beta": 2e-3,
        "epsilon": 0.4,
        "lambd": 0.9,
        "num_epoch": 5,
    },
    "network_settings": {
        "normalize": True,
        "hidden_units": 32,
        "num_layers": 1,
        "vis_encode_type": "resnet",
        "memory": {"sequence_length": 16, "memory_size": 128},
    },
    "reward_signals": {
        "extrinsic": {"gamma": 0.9, "strength": 2.0},
        "rnd": {"gamma": 0.99, "strength": 0.01, "network_settings": {"hidden_units": 64}},
    },
    "self_play": {"window": 10, "initial_elo": 1200.0},
    "behavioral_cloning": None,
    "keep_checkpoints": 7,
    "max_steps": "5.0e5",
    "time_horizon": 1000,
    "threaded": True,
    "mystery": 3,
}
WALL = {"sampler_type": "uniform", "sampler_parameters": {"max_value": 4.0, "seed": 5}}


def lesson(value: Any, threshold: float | None = None, **criteria: Any) -> dict[str, Any]:
    ends = {"behavior": "Ball", "threshold": threshold, **criteria}
    given = {"name": f"lesson of {threshold}", "value": value}
    return given if threshold is None else {**given, "completion_criteria": ends}


FILE: dict[str, Any] = {
    "default_settings": {"max_steps": 1, "summary_freq": 300, "threaded": False},
    "behaviors": {"Ball": BALL},
    "env_settings": {"num_envs": 3, "seed": 12, "env_path": "Ball.exe", "base_port": 5005},
    "engine_settings": {"time_scale": 20.0},
    "checkpoint_settings": {"run_id": "ball", "force": True},
    "torch_settings": {"device": None},
    "debug": False,
    "environment_parameters": {
        "mass": {"sampler_type": "gaussian", "sampler_parameters": {"st_dev": 0.5}},
        "tint": {"sampler_type": "constant", "sampler_parameters": {"value": 0.25}},
        "count": 100,
        "wall": {
            "curriculum": [
                lesson(WALL, 0.2, min_lesson_length=50, signal_smoothing=True),
                lesson(3, 0.5, min_lesson_length=80, require_reset=True),
                lesson(9.5),
            ]
        },
        "alone": {"curriculum": [lesson(7)]},
        "other": {"curriculum": [lesson(1, 0.3), lesson(2)]},
    },
}


@pytest.fixture
def write(tmp_path: Path) -> Iterator[Any]:
    def file(data: Any) -> Path:
        path = tmp_path / "Ball.yaml"
        text = data if isinstance(data, str) else yaml.safe_dump(data, sort_keys=False)
        # As ML-Agents' own files have it: a number that PyYAML itself would quote.
        path.write_text(text.replace("'5.0e5'", "5.0e5"))
        return path

    return file


def behavior(**changes: Any) -> dict[str, Any]:
    return {"behaviors": {"Ball": {**copy.deepcopy(BALL), **changes}}}


def converted(path: Path, registries: Registries, name: str | None = None) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(convert(path, name, "Ball-v0", registries))
    return data


def test_a_whole_file_by_hand(write: Any, registries: Registries) -> None:
    run = converted(write(FILE), registries)
    assert list(run) == [
        "environment",
        "rewards",
        "curriculum",
        "environment_parameters",
        "trainer",
        "seed",
    ]
    assert run["environment"] == {"type": "gymnasium", "id": "Ball-v0", "num_envs": 3}
    assert run["rewards"] == [{"type": "environment", "weight": 2.0}]
    assert run["seed"] == 12
    assert run["trainer"] == {
        "trainer_type": "ppo",
        "max_steps": 500_000,
        "summary_freq": 300,
        "keep_checkpoints": 7,
        "checkpoint_interval": 500_000,
        "hyperparameters": {
            "batch_size": 64,
            "buffer_size": 6000,
            "learning_rate": 3e-4,
            "learning_rate_schedule": "constant",
            "gamma": 0.9,
            "lambd": 0.9,
            "num_epoch": 5,
            "beta": 2e-3,
            "epsilon": 0.4,
            "beta_schedule": {"type": "linear", "final_fraction": pytest.approx(0.005)},
            "epsilon_schedule": {"type": "linear", "final_fraction": 0.25},
        },
        "network_settings": {
            "normalize": True,
            "hidden_units": 32,
            "num_layers": 1,
            "memory": {"sequence_length": 16, "memory_size": 64},
            "activation": "silu",
            "critic": "separate",
        },
    }


def test_environment_parameters_by_hand(write: Any, registries: Registries) -> None:
    run = converted(write(FILE), registries)
    assert run["environment_parameters"] == {
        "mass": {"sampler_type": "gaussian", "sampler_parameters": {"mean": 1.0, "st_dev": 0.5}},
        "tint": 0.25,
        "count": 100,
        "alone": 7,
    }
    low_wall = {
        "sampler_type": "uniform",
        "sampler_parameters": {"min_value": 0.0, "max_value": 4.0},
    }
    assert run["curriculum"] == {
        "type": "lessons",
        "measure": "reward",
        "smoothing_episodes": 80,
        "min_lesson_length": 80,
        "lessons": [
            {"name": "lesson of 0.2", "threshold": 0.2, "parameters": {"wall": low_wall}},
            {"name": "lesson of 0.5", "threshold": 0.5, "parameters": {"wall": 3}},
            {"name": "lesson of None", "parameters": {"wall": 9.5}},
        ],
    }


def test_what_ml_agents_leaves_out_is_as_it_has_it(write: Any, registries: Registries) -> None:
    """Defaults of its docs/Training-Configuration-File.md, as far as a run has them."""
    path = write(convert(write({"behaviors": {"Ball": None}}), None, "Ball-v0", registries))
    settings: Any = load_run(path, [], registries).trainer.settings
    hyper, network = settings.hyperparameters, settings.network_settings
    assert (settings.max_steps, settings.summary_freq) == (500_000, 50_000)
    assert (settings.keep_checkpoints, settings.checkpoint_interval) == (5, 500_000)
    assert (hyper.batch_size, hyper.buffer_size, hyper.num_epoch) == (1024, 10_240, 3)
    assert (hyper.learning_rate, hyper.beta, hyper.epsilon) == (3e-4, 5e-3, 0.2)
    assert (hyper.gamma, hyper.lambd) == (0.99, 0.95)
    schedules = (hyper.learning_rate_schedule, hyper.beta_schedule, hyper.epsilon_schedule)
    ends = [
        schedule.value(value, 1.0)
        for schedule, value in zip(schedules, (3e-4, 5e-3, 0.2), strict=True)
    ]
    assert ends == pytest.approx([0.0, 1e-5, 0.1])
    assert (network.hidden_units, network.num_layers, network.normalize) == (128, 2, False)
    assert (network.critic, network.memory) == ("separate", None)


@pytest.mark.parametrize("name", ["Ball", "Cube"])
def test_every_key_is_accounted_for(write: Any, registries: Registries, name: str) -> None:
    path = write({**FILE, "behaviors": {"Ball": BALL, "Cube": {"trainer_type": "ppo"}}})
    text = convert(path, name, None, registries)
    rows = re.findall(r"^#   ([\w.*]+): ?", text, re.MULTILINE)
    for steps, _ in leaves(yaml.safe_load(path.read_text())):
        own = steps[2:] if steps[:2] == ("behaviors", name) else steps
        key = ["*" if isinstance(step, int) else str(step) for step in own]
        around = {".".join(key[:length]) for length in range(1, len(key) + 1)}
        assert around & set(rows), key


def test_the_account_names_the_reason_and_the_place(write: Any, registries: Registries) -> None:
    text = " ".join(convert(write(FILE), None, None, registries).replace("#", "").split())
    for row in (
        "default_settings.max_steps: behaviors.Ball has it",
        "default_settings.summary_freq: trainer.summary_freq",
        "network_settings.memory.memory_size: trainer.network_settings.memory.memory_size (half",
        "reward_signals.extrinsic.strength: rewards (the weight",
        "reward_signals.rnd.strength: the environment's own reward",
        "self_play.window: an agent does not play",
        "mystery: no setting of ML-Agents'",
        "environment_parameters.wall.curriculum.*.value.sampler_parameters.seed: the run's own",
        "environment_parameters.wall.curriculum.*.value: curriculum.lessons.*.parameters",
        "environment_parameters.other: its lessons end otherwise than those of 'wall'",
        "torch_settings.device: null changes nothing",
        "Fill in environment.id",
    ):
        assert row in text
    assert f"id: {PLACEHOLDER}" in text


def test_curricula_that_end_together_are_one(write: Any, registries: Registries) -> None:
    progress = {"measure": "progress"}
    both = {
        name: {"curriculum": [lesson(first, 0.5, **progress), lesson(last)]}
        for name, (first, last) in {"wall": (1, 2), "roof": (8, 9)}.items()
    }
    strangers = {"floor": {"curriculum": [lesson(1, 0.5, behavior="Cube", **progress), lesson(2)]}}
    run = converted(write({**FILE, "environment_parameters": both | strangers}), registries)
    assert [each["parameters"] for each in run["curriculum"]["lessons"]] == [
        {"wall": 1, "roof": 8},
        {"wall": 2, "roof": 9},
    ]
    assert run["curriculum"]["measure"] == "progress"
    assert "environment_parameters" not in run


def test_an_account_stays_a_comment_whatever_the_names_are(
    write: Any, registries: Registries
) -> None:
    name = "a\nb: 1\x85seed: 7\u2028device: cuda"
    path = write(yaml.safe_dump({"behaviors": {name: {"odd\nseed: 3\n": 1}}}))
    run = converted(path, registries)
    assert list(run) == ["environment", "trainer"]


def test_settings_of_sac(write: Any, registries: Registries) -> None:
    ddpg: Any = registries.trainers.entries["ddpg"]
    entries = {**registries.trainers.entries, "sac": Entry(ddpg.cls, Origin("sac", "sac 1"))}
    with_sac = replace(registries, trainers=Registry("trainer", entries))
    hyper = {"steps_per_update": 4.0, "init_entcoef": 0.5, "tau": 0.01, "buffer_size": 300}
    path = write(behavior(trainer_type="sac", hyperparameters=hyper, network_settings={}))
    run = converted(path, with_sac)
    assert run["trainer"]["hyperparameters"] == {
        "updates_per_step": 0.25,
        "tau": 0.01,
        "buffer_size": 300,
        "gamma": 0.9,
        "batch_size": 128,
        "buffer_init_steps": 0,
        "learning_rate": 3e-4,
    }
    assert run["trainer"]["time_horizon"] == 1000
    assert "init_entcoef: this trainer has no such setting" in convert(path, None, None, with_sac)


ONE = "behaviors: {Ball: }\n"
OWN = "environment_parameters"
LESSON = "{name: a, value: 1}"
BAD = {
    "": "is empty",
    "a: [": "Ball.yaml:1: not YAML",
    "[1, 2]": "must be a mapping",
    "trainer: {}\nenvironment: {}": "is a run file already: python -m trainers.learn",
    "CartPole-v1: {n_steps: 1}": "is no trainer configuration of ML-Agents': it has no `behaviors`",
    "behaviors: {}": "it has no `behaviors`",
    "behaviors: 5": "behaviors: should be a mapping (key: value), not 5",
    "behaviors: {Ball: 5}": "behaviors.Ball: should be a mapping (key: value), not 5",
    "behaviors: {A: {}, B: {}}": "several behaviors, each a run of its own: choose one with "
    "--behavior: A, B",
    "behaviors: {Ball: {trainer: ppo, batch_size: 3}}": "mlagents.trainers.upgrade_config",
    "behaviors: {Ball: {}}\nparameter_randomization: {}": "mlagents.trainers.upgrade_config",
    "behaviors: {Ball: {trainer_type: poca}}": "unknown trainer 'poca'; known: ddpg, ppo, ",
    "behaviors: {Ball: {trainer_type: sac}}": "examples/ventosa-sac-plugin",
    "behaviors:\n  Ball:\n    hyperparameters:\n      batch_size: many": "Ball.yaml:4: "
    "trainer.hyperparameters.batch_size: should be a whole number, not 'many'",
    "behaviors: {Ball: {hyperparameters: {batch_size: 9, buffer_size: 8}}}": "batch_size 9 is over",
    f"{ONE}{OWN}:\n  wall: {{sampler_type: normal}}": "Ball.yaml:3: "
    f"{OWN}.wall.sampler_type: unknown name 'normal'",
    f"{ONE}{OWN}: {{wall: {{curriculum: []}}}}": "wall.curriculum: should have at least 1 item",
    f"{ONE}{OWN}: {{wall: {{curriculum: [{{Lesson0: 1}}]}}}}": "unknown key; "
    "known: completion_criteria, name, value",
    f"{ONE}{OWN}: {{a: {{curriculum: [{LESSON}, {LESSON}]}}}}": "a.curriculum.0: needs completion",
}


@pytest.mark.parametrize(("text", "message"), BAD.items())
def test_what_can_not_be_converted_is_said(
    write: Any, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    assert main([str(write(text))]) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert not said.out


def test_measures_are_not_mixed(write: Any, registries: Registries) -> None:
    lessons = [lesson(1, 0.5, measure="progress"), lesson(2, 3.0), lesson(3)]
    with pytest.raises(UserError, match="some lessons by progress and some by reward"):
        convert(write({**FILE, OWN: {"wall": {"curriculum": lessons}}}), None, None, registries)


def test_a_behavior_is_asked_for_by_name(write: Any, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(write({"behaviors": {"Ball": BALL, "Cube": {"max_steps": 77}}}))
    assert main([path, "--behavior", "Cube", "--env", "Cube-v0"]) == 0
    run = yaml.safe_load(capsys.readouterr().out)
    assert run["environment"]["id"] == "Cube-v0"
    assert run["trainer"]["max_steps"] == 77
    assert main([path, "--behavior", "Bal"]) == 2
    assert "has no such behavior; did you mean 'Ball'?" in capsys.readouterr().err


PLACES = [path for path, _ in leaves(FILE)] + [
    ("behaviors",),
    ("behaviors", "Ball"),
    ("behaviors", "Ball", "network_settings", "memory"),
    (OWN,),
    (OWN, "wall"),
    (OWN, "wall", "curriculum"),
    (OWN, "wall", "curriculum", 0),
    (OWN, "wall", "curriculum", 1, "completion_criteria"),
]
WRONG = st.sampled_from(
    [None, True, 0, -1, 0.0, math.inf, math.nan, 10**18, "", "text", [], [1], [{}], {}, {"a": {}}]
)


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=25
)
@given(place=st.sampled_from(PLACES), value=WRONG)
def test_whatever_stands_there_is_converted_or_refused(
    write: Any, registries: Registries, place: tuple[Any, ...], value: Any
) -> None:
    data = copy.deepcopy(FILE)
    around = data
    for step in place[:-1]:
        around = around[step]
    around[place[-1]] = value
    with contextlib.suppress(UserError):
        converted(write(data), registries)
