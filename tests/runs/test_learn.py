"""The command line, from the run file to the exit code."""

from __future__ import annotations

import ctypes
import io
import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from envs.grasp.simulators import workers
from trainers.common.options import version
from trainers.experience.env_runner import EnvRunner
from trainers.learn import Stop, main, parse, stop_on_signals
from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run
from trainers.saving.checkpoint import Checkpoints, Loaded

REPOSITORY = Path(__file__).parents[2]
CONSTANT = {"learning_rate_schedule": "constant", "beta_schedule": "constant"}
GRASP: dict[str, Any] = {
    "type": "grasp",
    "num_envs": 4,
    "workers": 0,
    "episode_steps": 3,
    "privileged": True,
    "cameras": {"depth": {"type": "depth", "width": 32, "height": 32}},
}
GRASP_SECTIONS: dict[str, Any] = {
    "rewards": [{"type": "touch"}, {"type": "approach"}, {"type": "rotation"}],
    "encoders": {"depth": {"type": "paper", "size": 32}},
    "curriculum": {
        "type": "lessons",
        "measure": "reward",
        "smoothing_episodes": 5,
        "min_lesson_length": 20,
        "count": 3,
        "thresholds": {"first": -50.0, "last": -40.0},
        "parameters": {"lateral_limit_m": {"first": 0.2, "last": 0.05}},
    },
    "environment_parameters": {
        "noise_sigma_m": {
            "sampler_type": "uniform",
            "sampler_parameters": {"min_value": 0.0, "max_value": 0.01},
        }
    },
}
Learn = Callable[..., Any]
WriteRun = Callable[..., Path]


def latest(results: Path, run_id: str) -> Loaded:
    return Checkpoints(results / run_id / "checkpoints", keep=1).load_latest()


def status(results: Path, run_id: str = "toy") -> dict[str, Any]:
    return dict(json.loads((results / run_id / "status.json").read_text()))


def call_at_env_step(
    monkeypatch: pytest.MonkeyPatch, number: int, action: Callable[[], None]
) -> None:
    """Does something just before the environments' nth step from now."""
    step, calls = EnvRunner.step, iter(range(1, 10**6))

    def stepped(self: EnvRunner, actions: Any) -> Any:
        if next(calls) == number:
            action()
        return step(self, actions)

    monkeypatch.setattr(EnvRunner, "step", stepped)


def send(number: signal.Signals) -> Callable[[], None]:
    return lambda: os.kill(os.getpid(), number)


# -- a run and what it leaves behind -------------------------------------------------------------

LESSONS = {
    "type": "lessons",
    "measure": "success",
    "smoothing_episodes": 9,
    "min_lesson_length": 9,
    "lessons": [{"threshold": 0.9, "parameters": {"scale": 2.0}}, {"parameters": {"scale": 1.0}}],
}
FINISHED = "finished: max_steps: 64 steps were taken"
CAMERA = {"camera": {"type": "conv", "layers": [[2, 3, 2]]}}


@pytest.fixture
def short_run(learn: Learn, write_run: WriteRun) -> Any:
    config = write_run(
        "picture", {"summary_freq": 16}, encoders=CAMERA, curriculum=LESSONS, seed=11
    )
    return learn(config, "trainer.hyperparameters.gamma=0.5", "--seed", 12)


def test_a_run_leaves_what_users_of_ml_agents_look_for(short_run: Any) -> None:
    assert short_run.code == 0
    assert short_run.errors == ""
    events = EventAccumulator(str(short_run.results / "toy"))
    events.Reload()
    tags = events.Tags()
    assert set(tags["scalars"]) == {
        "Environment/Cumulative Reward",
        "Environment/Episode Length",
        "Environment/Lesson Number/lesson",
        "Environment/Success Rate",
        "Environment/Distance M",
        "Reward/near",
        "Losses/Policy Loss",
        "Losses/Value Loss",
        "Policy/Entropy",
        "Policy/Learning Rate",
        "Policy/Critic Learning Rate",
        "Policy/Epsilon",
        "Policy/Beta",
        "Policy/KL",
        "Policy/Clip Fraction",
        "Policy/Explained Variance",
        "Performance/Steps Per Second",
    }
    for tag in tags["scalars"]:
        assert [point.step for point in events.Scalars(tag)] == [16, 32, 48, 64]
    lengths = events.Scalars("Environment/Episode Length")
    assert {point.value for point in lengths} == {4.0}
    rewards, terms = (
        [point.value for point in events.Scalars(tag)]
        for tag in ("Environment/Cumulative Reward", "Reward/near")
    )
    assert rewards == terms
    assert max(rewards) < 0
    rates = [point.value for point in events.Scalars("Policy/Learning Rate")]
    assert rates == pytest.approx([3e-4 * left for left in (1.0, 0.75, 0.5, 0.25)])
    assert tags["images"] == ["Observations/camera"]
    (text,) = events.Tensors("configuration/text_summary")
    assert "gamma: 0.5" in text.tensor_proto.string_val[0].decode()


def test_the_status_says_how_it_ended(short_run: Any) -> None:
    said = status(short_run.results)
    assert said["state"] == "finished"
    assert said["step"] == said["max_steps"] == 64
    assert (said["lesson"], said["lessons"]) == (1, 2)
    assert said["reward"] < 0
    assert 0 <= said["success"] <= 1
    assert said["steps_per_second"] > 0
    assert said["elapsed_s"] > 0
    assert said["run_id"] == "toy"
    assert Path(said["last_checkpoint"]) == short_run.results / "toy/checkpoints/step-64"


def test_the_terminal_says_where_the_run_stands(short_run: Any) -> None:
    lines = short_run.output.splitlines()
    begin, end = lines.index("toy: to step 64"), lines.index(FINISHED)
    points = lines[begin + 1 : end]
    assert [line.split()[0] for line in points] == ["16/64", "32/64", "48/64", "64/64"]
    assert "lesson 1/2" in points[-1]


def test_it_says_first_what_it_trains_and_last_how_to_go_on(
    short_run: Any, learn: Learn, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    lines = [" ".join(line.split()) for line in short_run.output.splitlines()]
    assert lines[0] == f"{version()}: {tmp_path / 'toy.yaml'}"
    assert lines[1] == "environment picture, 4 in parallel"
    results = short_run.results
    assert f"TensorBoard tensorboard --logdir {results}" in lines
    commands = {line.split(" python -m ")[0]: line for line in lines if " python -m " in line}
    assert commands["evaluate"].endswith(f"trainers.evaluate {results / 'toy'}")
    assert commands["export"].endswith(f"trainers.export {results / 'toy'} policies/toy")
    words = shlex.split(commands["train on"])[4:]  # without "train on python -m trainers.learn"
    assert words[-3:] == ["--results-dir", str(results), "--resume"]
    del words[-3:-1]  # which `learn` gives
    longer = learn(*words[1:])
    assert (longer.code, longer.step) == (0, 128)


def test_a_check_builds_everything_and_writes_nothing(
    learn: Learn, write_run: WriteRun, tmp_path: Path
) -> None:
    config = write_run("picture", encoders=CAMERA, evaluation={"interval": 32, "episodes": 4})
    before = everything(tmp_path)
    done = learn(config, "--check", "--seed", 7)
    assert (done.code, done.errors) == (0, "")
    _, told = done.output.split("\n", 1)
    resolved, rest = told.split("\n\n")
    assert yaml.safe_load(resolved)["seed"] == 7
    lines = [" ".join(line.split()) for line in rest.splitlines()]
    assert lines[:2] == [
        "observations",
        "camera DepthImage(8, 8, range_m=(0.5, 40.0), encoding='uint16')",
    ]
    assert "actor.frame_encoders.camera" in rest  # the layers of its network
    assert lines[-1] == "all of it can be built; nothing was written"
    assert everything(tmp_path) == before
    assert not done.results.exists()


def test_a_check_finds_what_only_the_first_evaluation_shows(
    learn: Learn, write_run: WriteRun
) -> None:
    target = {"metric": "sucess", "at_least": 1.0}
    config = write_run(evaluation={"interval": 32, "episodes": 4, "stop_when": target})
    done = learn(config, "--check")
    assert done.code == 2
    assert "evaluation.stop_when.metric: 'sucess' is not among" in done.errors


def test_its_configuration_is_the_run_and_runs_again_to_the_same_weights(
    short_run: Any, learn: Learn, registries: Registries, tmp_path: Path
) -> None:
    written = short_run.results / "toy/configuration.yaml"
    asked = ["trainer.hyperparameters.gamma=0.5", "seed=12"]
    run = load_run(written, [], registries)
    assert run == load_run(tmp_path / "toy.yaml", asked, registries)
    assert run.seed == 12
    assert learn(written, "--run-id", "again").code == 0
    first, second = latest(short_run.results, "toy"), latest(short_run.results, "again")
    assert all(torch.equal(tensor, second.weights[name]) for name, tensor in first.weights.items())
    assert learn(written, "--run-id", "other", "--seed", 13).code == 0
    third = latest(short_run.results, "other")
    assert any(not torch.equal(t, third.weights[name]) for name, t in first.weights.items())


def test_flags_stand_for_keys_of_the_run_file(learn: Learn, write_run: WriteRun) -> None:
    done = learn(write_run(), "--num-envs", 2, "--seed", 3, "--device", "cpu", "--run-id", "mine")
    assert done.code == 0
    written = yaml.safe_load((done.results / "mine/configuration.yaml").read_text())
    assert written["environment"]["num_envs"] == 2
    assert (written["seed"], written["device"]) == (3, "cpu")


# -- the user's mistakes -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["trainer.hyperparameters.lerning_rate=1"], ["lerning_rate", "'learning_rate'"]),
        (["trainer.hyperparameters.batch_size=17"], ["batch_size 17 is over buffer_size 16"]),
        (["rewards=[{type: tuch}]"], ["rewards.0.type", "'tuch'", "'touch'"]),
        (["environment.num_envs=many"], ["environment.num_envs", "whole number"]),
        (["encoders={gaol: {type: vector}}"], ["encoders: ", "'gaol'", "'goal'"]),
        (["environment_parameters={scael: 1}"], ["environment_parameters", "'scale'"]),
        (["--device", "cuda:99"], ["device", "'cuda:99'", "use 'cpu'"]),
        (["--resume"], ["no checkpoint to resume", "without --resume"]),
        (
            ["--run-id", "../results/one", "--force"],
            ["'../results/one': a run's name is", "no path"],
        ),
        (["--run-id", ""], ["'': a run's name is", "not empty"]),
        (["--initialize-from", "ghost"], ["ghost: neither a run nor a checkpoint"]),
    ],
)
def test_a_mistake_is_told_without_a_traceback_and_leaves_nothing(
    learn: Learn, write_run: WriteRun, arguments: list[str], words: list[str]
) -> None:
    done = learn(write_run(), *arguments)
    assert done.code == 2
    assert done.errors.startswith("error: ")
    assert [word for word in words if word not in done.errors] == []
    assert not done.results.exists()


def test_a_run_file_that_is_not_there_is_named(learn: Learn, tmp_path: Path) -> None:
    done = learn(tmp_path / "nowhere.yaml")
    assert done.code == 2
    assert str(tmp_path / "nowhere.yaml") in done.errors


def test_a_results_folder_that_can_not_be_written_is_named(
    learn: Learn, write_run: WriteRun, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()  # permissions do not stop a superuser, who may run the tests
    done = learn(write_run(), results_dir=tmp_path / "file")
    assert done.code == 2
    assert f"{tmp_path / 'file'}" in done.errors
    assert "--results-dir" in done.errors


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["run.yaml", "--forse"],
        ["run.yaml", "--resume", "--force"],
        ["run.yaml", "--resume", "--initialize-from", "other"],
    ],
)
def test_mistyped_options_end_with_two(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2


def test_overrides_and_options_may_stand_in_any_order() -> None:
    options = parse(["--seed", "1", "run.yaml", "a.b=1", "--run-id", "x", "c=2"])
    assert options.config == Path("run.yaml")
    assert options.overrides == ["a.b=1", "c=2"]
    assert (options.run_id, options.seed) == ("x", 1)


def test_a_run_is_neither_overwritten_nor_lost_by_mistake(
    learn: Learn, write_run: WriteRun
) -> None:
    config = write_run()
    assert learn(config).code == 0
    kept = {path: path.read_bytes() for path in (learn(config).results / "toy").rglob("*.*")}

    again = learn(config)
    assert again.code == 2
    assert "--resume" in again.errors
    assert "--force" in again.errors
    # Each of these is a mistake found late, when the old run must still be there.
    assert learn(config, "--force", "--initialize-from", "ghost").code == 2
    assert learn(config, "--force", "trainer.network_settings.hidden_units=no").code == 2
    for change, said in [
        ("trainer.network_settings.activation=tanh", "activation: 'relu' then, 'tanh' now"),
        ("environment.num_envs=2", "environment.num_envs: 4 then, 2 now"),
    ]:
        misfit = learn(config, "--resume", change, "trainer.max_steps=80")
        assert misfit.code == 2
        assert "toy: the run was begun with other settings:\n  " in misfit.errors
        assert said in misfit.errors
        assert f"use --initialize-from {misfit.results / 'toy'}" in misfit.errors
    assert {path: path.read_bytes() for path in kept} == kept


def test_a_state_that_does_not_fit_names_the_way_out(learn: Learn, write_run: WriteRun) -> None:
    config = write_run()
    results = learn(config).results
    written = results / "toy/configuration.yaml"  # as if another version had built other networks
    wide = yaml.safe_load(written.read_text())
    wide["trainer"]["network_settings"]["hidden_units"] = 9
    written.write_text(yaml.safe_dump(wide))
    misfit = learn(written, "--run-id", "toy", "--resume")
    assert misfit.code == 2
    assert "the run can't go on from here" in misfit.errors
    assert "needs the run file, and the version of ventosa" in misfit.errors
    assert f"use --initialize-from {results / 'toy'}" in misfit.errors


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_finished_run_that_is_resumed_says_what_to_raise_and_stays_as_it_is(
    learn: Learn, write_run: WriteRun
) -> None:
    config = write_run()
    before = everything(learn(config).results)
    again = learn(config, "--resume")
    assert again.code == 0
    assert again.output.splitlines()[1:] == [
        "toy: finished already, at step 64 (trainer.max_steps: 64): raise that to go on"
    ]
    assert everything(again.results) == before
    assert learn(config, "--resume", "trainer.max_steps=80").step == 80


def test_a_run_that_reached_its_target_is_finished_until_that_is_raised(
    learn: Learn, write_run: WriteRun
) -> None:
    target = {"metric": "reward", "at_least": -1e9}
    config = write_run(evaluation={"interval": 32, "episodes": 4, "stop_when": target})
    before = everything(learn(config).results)
    again = learn(config, "--resume")
    assert again.code == 0
    assert "toy: finished already, at step 32 (evaluation.stop_when: reward is" in again.output
    assert everything(again.results) == before
    raised = learn(config, "--resume", "evaluation.stop_when.at_least=1e9")
    assert raised.code == 0
    assert status(raised.results)["step"] == 64


def test_force_replaces_a_run_and_nothing_else(learn: Learn, write_run: WriteRun) -> None:
    config = write_run()
    results = learn(config).results
    assert learn(config, "--force", "trainer.max_steps=16").code == 0
    assert [path.name for path in (results / "toy/checkpoints").glob("step-*")] == ["step-16"]
    (results / "photos").mkdir()
    (results / "photos/holiday.txt").write_text("sea")
    refused = learn(config, "--run-id", "photos", "--force")
    assert refused.code == 2
    assert "holiday.txt: no run wrote this" in refused.errors
    (results / "toy/notes.txt").write_text("mine")
    refused = learn(config, "--force")
    assert refused.code == 2
    assert f"{results / 'toy/notes.txt'}: no run wrote this" in refused.errors
    assert latest(results, "toy").step == 16
    assert (results / "photos/holiday.txt").read_text() == "sea"


def in_another_process(*arguments: Any) -> int:
    """Forks the command line off, with the toys in its registries; the process's id."""
    child = os.fork()
    if child == 0:
        try:
            os._exit(main([*map(str, arguments)]))
        finally:  # never back into pytest
            os._exit(99)
    return child


def exit_code(process: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


@pytest.mark.parametrize("option", ["--force", "--resume"])
def test_a_run_that_goes_on_is_left_to_the_process_that_has_it(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    config, codes = write_run(), []
    results = config.parent / "results"

    def intrude() -> None:
        intruder = in_another_process(config, option, "--results-dir", results)
        codes.append(exit_code(intruder))

    with monkeypatch.context() as patch:
        call_at_env_step(patch, 11, intrude)  # after a checkpoint
        done = learn(config)
    assert codes == [2]
    going_on = f"error: {results / 'toy'}: this run is going on: process {os.getpid()} on "
    assert done.errors.startswith(going_on)
    assert done.code == 0
    assert done.step == 64
    assert not (results / "toy/run.lock").exists()
    assert learn(config, option, "trainer.max_steps=80").code == 0


@pytest.mark.parametrize(
    "starts", [3, *(pytest.param(2 + n % 2, marks=pytest.mark.soak) for n in range(80))]
)
def test_of_starts_of_one_run_at_once_one_goes_on_and_nothing_is_mixed(
    learn: Learn, write_run: WriteRun, starts: int
) -> None:
    config = write_run()
    results = config.parent / "results"
    started = [
        in_another_process(config, "--seed", seed, "--results-dir", results)
        for seed in range(starts)
    ]
    codes = [exit_code(process) for process in started]
    assert sorted(codes) == [0] + [2] * (starts - 1)
    seed = codes.index(0)
    written = yaml.safe_load((results / "toy/configuration.yaml").read_text())
    assert written["seed"] == seed
    assert learn(config, "--seed", seed, "--run-id", "alone").code == 0
    toy, alone = latest(results, "toy"), latest(results, "alone")
    for name in ("weights.safetensors", "state.safetensors", "state.json"):
        assert (toy.path / name).read_bytes() == (alone.path / name).read_bytes()
    assert len(list((results / "toy").glob("events*"))) == 1


# -- other weights to begin with -----------------------------------------------------------------


@pytest.mark.parametrize("form", ["id", "run", "checkpoint"])
def test_a_run_begins_with_the_weights_it_is_given(
    learn: Learn, write_run: WriteRun, form: str
) -> None:
    config = write_run()
    results = learn(config, "--run-id", "first").results
    name = {
        "id": "first",
        "run": results / "first",
        "checkpoint": results / "first/checkpoints/step-64",
    }[form]
    frozen = "trainer.hyperparameters.learning_rate=1e-30"
    done = learn(config, frozen, "--run-id", "second", "--initialize-from", name, "--seed", 9)
    assert done.code == 0
    taken_over = f"begins with all weights of {results / 'first/checkpoints/step-'}"
    assert taken_over in done.output
    assert "optimizers, steps, lesson, replay buffer and random numbers are new" in done.output
    given, got = latest(results, "first"), latest(results, "second")
    assert got.step == 64  # its own count, from 0
    for key, tensor in given.weights.items():
        torch.testing.assert_close(got.weights[key], tensor, rtol=0, atol=1e-12)
    fresh = learn(config, frozen, "--run-id", "third", "--seed", 9)
    weights = latest(fresh.results, "third").weights
    assert any(not torch.allclose(t, weights[key]) for key, t in given.weights.items())


def test_weights_of_another_shape_are_refused(learn: Learn, write_run: WriteRun) -> None:
    config = write_run()
    learn(config, "--run-id", "first")
    smaller = "trainer.network_settings.hidden_units=4"
    done = learn(config, smaller, "--run-id", "second", "--initialize-from", "first")
    assert done.code == 2
    assert "--initialize-from first: these weights do not fit" in done.errors
    assert "configuration.yaml that they came with" in done.errors
    assert "size mismatch" in done.errors
    assert not (done.results / "second").exists()


# -- stopping and going on -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["ctrl-c", "sigterm"]
)
def test_a_signal_saves_the_run_for_a_later_resume(
    learn: Learn,
    write_run: WriteRun,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
    code: int,
) -> None:
    config = write_run()
    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        call_at_env_step(patch, 11, send(number))
        stopped = learn(config)
    assert signal.getsignal(number) == before
    assert stopped.code == code
    assert stopped.output.splitlines()[-6] == "stopped, and saved"
    assert stopped.output.endswith(f"--results-dir {stopped.results} --resume\n")
    assert stopped.errors == (
        f"{number.name}: stopping, and saving first; once more stops at once\n"
    )
    assert status(stopped.results)["state"] == "interrupted"
    assert stopped.step == 32  # of the 40 steps, those of the last update
    resumed = learn(config, "--resume")
    assert resumed.code == 0
    assert "\ntoy: from step 32 to step 64\n" in resumed.output
    assert status(resumed.results)["state"] == "finished"
    assert resumed.step == 64


def test_a_signal_is_answered_while_a_call_does_not_return(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said, libc = io.StringIO(), ctypes.CDLL(None)
    monkeypatch.setattr(sys, "stderr", said)
    mutex = ctypes.create_string_buffer(64)  # of zeros: what waits for it hears of no signal
    libc.pthread_mutex_lock(mutex)
    answered: list[bool] = []

    def ask() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        deadline = time.monotonic() + 60.0
        while not said.getvalue().endswith("\n") and time.monotonic() < deadline:
            time.sleep(0.01)
        answered.append("SIGTERM: stopping, and saving first" in said.getvalue())
        libc.pthread_mutex_unlock(mutex)

    with stop_on_signals() as stop:
        asking = threading.Thread(target=ask)
        asking.start()
        libc.pthread_mutex_lock(mutex)
        asking.join()
        assert stop.requested()
    assert answered == [True]


def test_signals_that_ask_for_nothing_are_not_answered(capfd: pytest.CaptureFixture[str]) -> None:
    with stop_on_signals():
        os.kill(os.getpid(), signal.SIGALRM)
    assert capfd.readouterr().err == ""


def test_the_second_signal_insists() -> None:
    with stop_on_signals() as stop:
        assert not stop.requested()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested()
        assert stop.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        assert stop.exit_code == 143
    assert not Stop().requested()


@pytest.mark.parametrize("stopped_by", ["limit", "signal"])
def test_a_grasp_run_taken_up_again_ends_exactly_as_one_that_was_not_stopped(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch, stopped_by: str
) -> None:
    hyper = {"buffer_size": 64, "batch_size": 32, **CONSTANT}
    network = {
        "critic": "separate",
        "critic_observations": ["privileged", "depth"],
        "normalize": True,
    }
    trainer = {"max_steps": 192, "hyperparameters": hyper, "network_settings": network}
    config = write_run(GRASP, trainer, **GRASP_SECTIONS)
    assert learn(config, "--run-id", "whole").code == 0
    with monkeypatch.context() as patch:
        if stopped_by == "signal":
            call_at_env_step(patch, 37, send(signal.SIGINT))  # in the third collection of 16
            assert learn(config, "--run-id", "halves").code == 130
        else:
            assert learn(config, "--run-id", "halves", "trainer.max_steps=128").code == 0
    results = learn(config, "--run-id", "halves", "--resume").results
    whole, halves = latest(results, "whole"), latest(results, "halves")
    assert whole.step == halves.step == 192
    assert whole.state["curriculum"]["lesson"] == 2
    for name in ("weights.safetensors", "state.safetensors", "state.json"):
        assert (halves.path / name).read_bytes() == (whole.path / name).read_bytes(), name


def test_a_checkpoint_cut_short_is_passed_over_with_a_note(
    learn: Learn, write_run: WriteRun
) -> None:
    config = write_run()
    results = learn(config).results
    damaged = results / "toy/checkpoints/step-64/state.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-10])
    done = learn(config, "--resume", "trainer.max_steps=80")
    assert done.code == 0
    lines = done.output.splitlines()
    note = lines[lines.index("toy: from step 32 to step 80") + 1]
    assert "passed over the damaged checkpoint" in note
    assert "step-64: state.safetensors is cut short" in note
    assert latest(results, "toy").step == 80
    events = EventAccumulator(str(results / "toy"))
    events.Reload()
    # What the first process logged after step 32 is hidden by the second's.
    steps = [point.step for point in events.Scalars("Policy/Entropy")]
    assert steps == [16, 32, 48, 64, 80]


def tiny_grasp(write_run: WriteRun, **environment: Any) -> Path:
    hyper = {"buffer_size": 16, "batch_size": 16}
    trainer = {"max_steps": 10**6, "checkpoint_interval": 16, "hyperparameters": hyper}
    sections = {**GRASP_SECTIONS, "curriculum": None}
    return write_run({**GRASP, **environment}, trainer, **sections)


@pytest.mark.parametrize(
    ("good_calls", "step", "last"),
    [
        (9, 40, "the last good checkpoint is {}/step-32"),
        (1, 8, "the last good checkpoint is {}/step-0"),
    ],
)
def test_a_reward_that_breaks_ends_the_run_with_its_name_and_the_way_back(
    learn: Learn, write_run: WriteRun, good_calls: int, step: int, last: str
) -> None:
    rewards = f"rewards=[{{type: touch}}, {{type: breaking, good_calls: {good_calls}}}]"
    done = learn(tiny_grasp(write_run), rewards)
    assert done.code == 1
    way_back = last.format(done.results / "toy/checkpoints")
    what = "the reward 'breaking' of environment 0 is nan, and should be finite"
    broken = f"error: step {step}: {what}; {way_back}\n"
    assert done.errors.endswith(broken)
    said = status(done.results)
    assert said["state"] == "failed"
    assert f"error: {said['reason']}\n" == broken


def test_observations_that_are_not_numbers_end_the_run(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch, registries: Registries
) -> None:
    cls = registries.environments.get("target").cls
    show, calls = cls.show, iter(range(10**6))

    def shown(self: Any, target: np.ndarray) -> dict[str, np.ndarray]:
        return {k: np.where(next(calls) == 9, np.nan, v) for k, v in show(self, target).items()}

    monkeypatch.setattr(cls, "show", shown)
    done = learn(write_run(), "trainer.checkpoint_interval=16")
    assert done.code == 1
    assert "the observation 'goal' of environment 0 is nan, and should be" in done.errors


def test_a_killed_worker_ends_the_run_by_its_name_and_leaves_it_saved(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tiny_grasp(write_run, workers=2)
    processes: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def recorded(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        processes.append(popen(*arguments, **options))
        return processes[-1]

    def kill_one() -> None:
        processes[1].kill()

    with monkeypatch.context() as patch:
        patch.setattr(workers.subprocess, "Popen", recorded)
        call_at_env_step(patch, 6, kill_one)
        done = learn(config, "trainer.checkpoint_interval=1000000")
    assert done.code == 1
    killed = f"worker 1 (process {processes[1].pid}) of the simulator was killed by SIGKILL"
    assert killed in done.errors
    assert status(done.results)["state"] == "failed"
    assert done.step == 16
    assert processes[0].poll() == 0  # the other one ended in peace
    more = ["--resume", "environment.workers=0", "trainer.max_steps=32"]
    assert learn(config, *more).code == 0
    assert latest(done.results, "toy").step == 32


# -- as its own process --------------------------------------------------------------------------


def start(folder: Path, *arguments: Any, **environment: str) -> subprocess.Popen[str]:
    """Starts the command line in a folder; a session of its own stands for a terminal's."""
    return subprocess.Popen(
        [sys.executable, "-m", "trainers.learn", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1", **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def test_ctrl_c_and_sigterm_stop_a_process_and_its_workers_quietly(
    learn: Learn, write_run: WriteRun, tmp_path: Path
) -> None:
    config = tiny_grasp(write_run)
    # Ctrl-C reaches every process of the terminal, SIGTERM the one it is sent to.
    stops = {
        "ctrl-c": (2, lambda pid: os.killpg(pid, signal.SIGINT), 130),
        "sigterm": (0, lambda pid: os.kill(pid, signal.SIGTERM), 143),
    }
    far = "trainer.checkpoint_interval=1000000"
    started = {
        name: start(tmp_path, config, far, f"environment.workers={workers}", "--run-id", name)
        for name, (workers, _, _) in stops.items()
    }
    for name, process in started.items():
        assert process.stdout is not None
        for line in process.stdout:
            if "steps/s" in line:
                break
        _, stop, code = stops[name]
        stop(process.pid)
        output, errors = process.communicate(timeout=120)
        assert process.returncode == code, errors
        assert "stopped, and saved\n" in output
        assert "Traceback" not in errors
        step = latest(tmp_path / "results", name).step
        assert step >= 16
        assert status(tmp_path / "results", name)["state"] == "interrupted"
        done = learn(config, "--run-id", name, "--resume", f"trainer.max_steps={step + 16}")
        assert done.code == 0
        assert latest(done.results, name).step == step + 16


def test_a_package_that_hides_ours_is_named(write_run: WriteRun, tmp_path: Path) -> None:
    (tmp_path / "rewards").mkdir()
    (tmp_path / "rewards/__init__.py").write_text("raise RuntimeError('not ours')")
    process = start(tmp_path, write_run())
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert f"error: {tmp_path / 'rewards'} would be imported in the place of" in errors
    assert "Traceback" not in errors


def test_it_runs_in_any_folder(write_run: WriteRun, tmp_path: Path) -> None:
    process = start(tmp_path, write_run(), "environment.type=grisp")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "unknown environment 'grisp'; did you mean 'grasp'?" in errors
