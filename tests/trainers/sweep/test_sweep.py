"""Sweeps from the command line."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
import pytest
from optuna.trial import TrialState, create_trial
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from trainers import learn
from trainers.common.command import DONE, FAILED, MISTAKE, TERMINATED
from trainers.common.errors import UserError
from trainers.comparison import jobs
from trainers.comparison.jobs import Ended, Job
from trainers.comparison.results import Curves, read_status
from trainers.experience.env_runner import NonFiniteError
from trainers.run import run_file
from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run
from trainers.saving.run_lock import RunLock
from trainers.sweep.__main__ import main
from trainers.sweep.plan import load_sweep
from trainers.sweep.study import distributions, open_study

RATE, BATCH = "trainer.hyperparameters.learning_rate", "trainer.hyperparameters.batch_size"
STORAGE = "results/pole/study.journal"
SHORT = {"trainer.max_steps": 256}
ONE = {RATE: {"log_uniform": [1e-4, 1e-2]}}


class InProcess:
    """Runs what jobs run, without the seconds that a process takes to start.

    Attributes:
        commands: those that were run.
        on_step: called with a run's id whenever it asks whether to stop.
    """

    def __init__(self) -> None:
        self.commands: list[Sequence[str]] = []
        self.on_step: Callable[[str], None] = lambda run_id: None

    def __call__(self, command: Sequence[str], job: Job) -> Ended:
        self.commands.append(command)
        options = learn.parse(command[3:])
        stopped, asked = False, 0

        def stop() -> bool:
            nonlocal stopped, asked
            self.on_step(options.run_id)
            asked += 1
            stopped = stopped or (asked % 8 == 0 and job.stop())
            return stopped

        try:
            finished = run_file(options, stop)
        except (UserError, NonFiniteError) as error:
            return Ended(MISTAKE, f"a warning\nerror: {error}\n")
        return Ended(DONE if finished else TERMINATED, "")


@pytest.fixture
def runs(tmp_path: Path, known: Registries, monkeypatch: pytest.MonkeyPatch) -> InProcess:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("trainers.runfile.registry.load_registries", lambda: known)
    monkeypatch.setattr("trainers.run.load_registries", lambda: known)
    fake = InProcess()
    monkeypatch.setattr(jobs, "_execute", fake)
    return fake


def sweep(path: Path, *words: str) -> int:
    return main([str(path), "--results-dir", "results", "--jobs", "1", *words])


def trials_of(storage: str = STORAGE) -> list[optuna.trial.FrozenTrial]:
    journal = optuna.storages.journal.JournalFileBackend(storage)
    found = optuna.load_study(
        study_name="pole", storage=optuna.storages.JournalStorage(journal)
    ).get_trials()
    return list(found)


def files(folder: str) -> list[Path]:
    return [path for path in sorted(Path(folder).rglob("*")) if path.is_file()]


def test_a_sweep_from_its_file_to_its_report(
    sweep_file: Callable[..., Path],
    runs: InProcess,
    known: Registries,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = sweep_file(fixed=SHORT, trials=2)
    assert sweep(path) == DONE
    trials = trials_of()
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 2
    # Two evaluations of 256 steps, and the last of them is the score.
    evaluations = Curves(Path("results/pole/trial-0001")).curve("Evaluation/Reward")[1].tolist()
    assert list(trials[1].intermediate_values.items()) == list(enumerate(evaluations))[1:]
    assert trials[1].value == evaluations[-1]
    best = max(trials, key=lambda trial: (trial.value, -trial.number))
    ready = load_run(Path("results/pole/best.yaml"), [], known)
    assert ready.trainer.settings.hyperparameters.learning_rate == best.params[RATE]
    page = Path("results/pole/report.md").read_text()
    assert f"Best: trial {best.number}, reward {best.value:.4g}." in page
    assert f"\n| {best.number} | {best.params[RATE]:.4g} | {best.params[BATCH]} | " in page
    assert page.count("| 256 | finished |") == 2
    for name in ("heat_maps", "parallel"):
        assert f"({name}.png)" in page
        assert Path(f"results/pole/{name}.png").stat().st_size > 5000
        assert Path(f"results/pole/{name}.svg").read_text().startswith("<?xml")
    capsys.readouterr()
    # What is there is not run again.
    assert sweep(path, "--trials", "3") == DONE
    assert re.findall(r"trial-.* begins", capsys.readouterr().out) == ["trial-0002 begins"]
    assert len(runs.commands) == len(trials_of()) == 3


def test_tensorboard_has_the_settings_that_were_tried(
    sweep_file: Callable[..., Path], runs: InProcess
) -> None:
    sweep(sweep_file(fixed=SHORT, trials=1))
    (trial,) = trials_of()
    events = Curves(Path("results/pole/trial-0000"))._events
    content = events.PluginTagToContent("hparams")
    begun = HParamsPluginData.FromString(content["_hparams_/session_start_info"])
    values = {name: value.number_value for name, value in begun.session_start_info.hparams.items()}
    assert values.items() >= {RATE: trial.params[RATE], BATCH: trial.params[BATCH]}.items()
    about = HParamsPluginData.FromString(content["_hparams_/experiment"]).experiment
    assert "Evaluation/Reward" in [info.name.tag for info in about.metric_infos]


def test_an_interrupted_sweep_goes_on_as_if_it_had_not_been(
    sweep_file: Callable[..., Path], runs: InProcess
) -> None:
    path = sweep_file(fixed=SHORT, space=ONE, trials=2)
    assert sweep(path, "--storage", "whole.journal") == DONE
    whole = trials_of("whole.journal")
    Path("results").rename("whole")

    def interrupt(run_id: str) -> None:
        if read_status(Path("results/pole", run_id)).get("step", 0) >= 128:
            stop: Any = signal.getsignal(signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)
            while not stop.requested():  # the main thread hears of it, when it has its turn
                time.sleep(1e-3)
            runs.on_step = lambda run_id: None

    runs.on_step = interrupt
    assert sweep(path) == TERMINATED
    (left,) = trials_of()
    assert left.state is TrialState.RUNNING
    assert read_status(Path("results/pole/trial-0000"))["state"] == "interrupted"
    assert "| interrupted, or running |" in Path("results/pole/report.md").read_text()
    assert sweep(path) == DONE
    assert "--resume" in runs.commands[-2]
    for one, other in zip(trials_of(), whole, strict=True):
        assert (one.params, one.value) == (other.params, other.value)
        assert one.intermediate_values == other.intermediate_values
    assert not list(Path("results/pole/running").iterdir())


@contextmanager
def held_by_another(place: Path) -> Iterator[None]:
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            RunLock(place)
            os.write(writer, b"held")
            time.sleep(120.0)
        finally:  # never back into pytest
            os._exit(1)
    try:
        assert os.read(reader, 4) == b"held"
        yield
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(reader)
        os.close(writer)


def test_a_trial_that_another_process_goes_on_with_is_left_to_it(
    sweep_file: Callable[..., Path], runs: InProcess
) -> None:
    path = sweep_file(fixed=SHORT, space=ONE, trials=2)
    with held_by_another(Path("results/pole/running/trial-0000")):
        assert sweep(path) == DONE
    assert [trial.state for trial in trials_of()] == [TrialState.RUNNING, TrialState.COMPLETE]
    assert sweep(path) == DONE
    assert [trial.state for trial in trials_of()] == [TrialState.COMPLETE] * 2


def test_a_broken_trial_is_told_of_and_the_sweep_goes_on(
    sweep_file: Callable[..., Path], runs: InProcess
) -> None:
    space = {"environment.id": {"choice": ["NoPole-v1", "CartPole-v1"]}, "seed": {"choice": [3]}}
    assert sweep(sweep_file(fixed=SHORT, space=space, sampler="grid")) == DONE
    broken, finished = trials_of()
    assert (broken.state, finished.state) == (TrialState.FAIL, TrialState.COMPLETE)
    page = Path("results/pole/report.md").read_text()
    assert "| 0 | NoPole-v1 | 3 |  | 0 | broken: environment (gymnasium): " in page
    assert "a warning" not in page
    assert finished.params["environment.id"] in Path("results/pole/best.yaml").read_text()


def test_a_sweep_of_broken_trials_has_a_report_and_fails(
    sweep_file: Callable[..., Path], runs: InProcess
) -> None:
    fixed = {"environment.id": "NoPole-v1"}
    assert sweep(sweep_file(fixed=fixed, trials=2)) == FAILED
    assert Path("results/pole/report.md").read_text().count("| broken: ") == 2
    assert not Path("results/pole/best.yaml").exists()


def test_what_does_badly_is_pruned_and_can_be_gone_on_with(
    sweep_file: Callable[..., Path], runs: InProcess, known: Registries
) -> None:
    path = sweep_file(fixed={"trainer.max_steps": 512}, space=ONE, trials=6)
    plan = load_sweep(path, known)
    study = open_study(plan, STORAGE)
    for _ in range(5):  # what hasn't been reached yet by any pole
        good = dict.fromkeys(range(1, 5), 1e6)
        params = {RATE: 1e-3}
        study.add_trial(
            create_trial(
                params=params,
                distributions=distributions(plan),
                value=1e6,
                intermediate_values=good,
                user_attrs={"score": "reward"},
            )
        )
    assert sweep(path) == DONE
    pruned = trials_of()[5]
    assert pruned.state is TrialState.PRUNED
    status = read_status(Path("results/pole/trial-0005"))
    assert status["state"] == "interrupted"
    assert 128 <= status["step"] < 384
    assert f"| pruned: reward {pruned.value:.4g} |" in Path("results/pole/report.md").read_text()
    command = [word for word in runs.commands[-1][3:] if word not in ("--resume", "--force")]
    assert run_file(learn.parse([*command, "--resume"]), lambda: False)


def test_what_is_there_of_another_run_is_left_alone(
    sweep_file: Callable[..., Path], runs: InProcess
) -> None:
    assert sweep(sweep_file(fixed=SHORT, space=ONE, trials=1)) == DONE
    before = {path: path.read_bytes() for path in files("results/pole/trial-0000")}
    other = sweep_file(fixed={"trainer.max_steps": 128}, space=ONE, trials=1)
    assert sweep(other, "--storage", "other.journal") == FAILED
    assert {path: path.read_bytes() for path in files("results/pole/trial-0000")} == before
    assert "made by another run file" in Path("results/pole/report.md").read_text()


def test_mistakes_are_one_line_and_nothing_is_begun(
    sweep_file: Callable[..., Path], runs: InProcess, capsys: pytest.CaptureFixture[str]
) -> None:
    path = sweep_file(space={"no.such.key": {"choice": [1]}})
    assert sweep(path) == MISTAKE
    assert f"error: {path}:3: space.no.such.key: " in capsys.readouterr().err
    assert sweep(sweep_file(), "--storage", "sqlite:////nowhere/at/all.db") == MISTAKE
    assert "error: --storage sqlite:////nowhere/at/all.db: can't be used" in capsys.readouterr().err
    assert not Path("results").exists()
    assert not runs.commands


@pytest.mark.parametrize("package", ["optuna", "matplotlib"])
def test_a_package_that_is_missing_is_named(
    package: str,
    sweep_file: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    find: Any = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == package else find(name)
    )
    assert main([str(sweep_file())]) == MISTAKE
    said = f"error: {package} is not installed: pip install 'ventosa[sweep]'\n"
    assert capsys.readouterr().err == said
