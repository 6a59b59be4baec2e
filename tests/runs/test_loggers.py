"""Whole runs beside services that can be had, can't be reached, or fail later."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from envs.evaluation import Evaluator
from trainers.evaluate import main as evaluate
from trainers.loggers.base import LoggedRun
from trainers.loggers.mlflow import MLflow
from trainers.reporting import event_log

Learn = Callable[..., Any]
WriteRun = Callable[..., Path]
REWARD = "Environment/Cumulative Reward"
BOTH = [{"type": "tensorboard"}, {"type": "mlflow", "tracking_uri": "http://127.0.0.1:9"}]


@pytest.fixture
def mlflow_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(uri: str) -> None:
        raise ConnectionError(f"no answer from {uri}\nand so on")

    package = SimpleNamespace(MlflowClient=unreachable, __spec__="installed")
    monkeypatch.setitem(sys.modules, "mlflow", package)  # type: ignore[arg-type]


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [message for message in caplog.messages if "the logger" in message]


@pytest.mark.usefixtures("mlflow_is_there")
def test_a_service_that_can_not_be_reached_is_told_once_and_the_run_goes_on(
    learn: Learn, write_run: WriteRun, caplog: pytest.LogCaptureFixture
) -> None:
    done = learn(write_run(loggers=BOTH))
    assert (done.code, done.step) == (0, 64)
    assert told(caplog) == [
        f"{done.results / 'toy'}: the logger 'mlflow' fails (no answer from http://127.0.0.1:9 and "
        "so on): the run goes on, and is logged again as soon as that can be"
    ]
    events = EventAccumulator(str(done.results / "toy"))
    events.Reload()
    assert events.Scalars(REWARD)


@pytest.mark.usefixtures("mlflow_is_there")
@pytest.mark.parametrize("retry_after_s", [0.0, 600.0])
def test_a_service_that_fails_later_is_tried_again_after_a_while(
    learn: Learn,
    write_run: WriteRun,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    retry_after_s: float,
) -> None:
    built: list[LoggedRun] = []
    points: list[int] = []

    def build(self: MLflow, settings: MLflow.Settings, run: LoggedRun) -> None:
        built.append(run)

    def scalars(self: MLflow, values: Mapping[str, float], step: int) -> None:
        points.append(step)
        if len(points) % 2 == 0:
            raise TimeoutError("too slow")

    monkeypatch.setattr(MLflow, "__init__", build)
    monkeypatch.setattr(MLflow, "scalars", scalars)
    for name in ("text", "image", "hyperparameters", "close"):
        monkeypatch.setattr(MLflow, name, lambda *_: None)
    monkeypatch.setattr(event_log, "RETRY_AFTER_S", retry_after_s)
    done = learn(write_run("target", {"max_steps": 160, "summary_freq": 32}, loggers=BOTH))
    assert done.code == 0
    assert len(told(caplog)) == 1
    if retry_after_s:
        assert (len(built), len(points)) == (1, 2)
    else:
        assert len(points) >= 5
        assert len(built) == 1 + len(points) // 2


def test_a_package_that_is_missing_is_told_before_anything_begins(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mlflow", None)  # type: ignore[arg-type]
    done = learn(write_run(loggers=BOTH))
    told = "error: mlflow is not installed: pip install 'ventosa[mlflow]'\n"
    assert (done.code, done.errors) == (2, told)
    assert not done.results.exists()


def test_a_run_without_loggers_leaves_checkpoints_alone(learn: Learn, write_run: WriteRun) -> None:
    done = learn(write_run(loggers=[]))
    assert (done.code, done.step) == (0, 64)
    assert not list((done.results / "toy").glob("events.*"))


def test_the_page_hparams_has_the_runs_settings_and_its_figures(
    learn: Learn, write_run: WriteRun
) -> None:
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    done = learn(write_run(evaluation={"interval": 32, "episodes": 4}))
    events = EventAccumulator(str(done.results / "toy"))
    events.Reload()
    content = events.PluginTagToContent("hparams")
    begun = HParamsPluginData.FromString(content["_hparams_/session_start_info"])
    values = begun.session_start_info.hparams
    assert values["trainer.max_steps"].number_value == 64.0
    assert values["environment.type"].string_value == "target"
    about = HParamsPluginData.FromString(content["_hparams_/experiment"]).experiment
    compared = {info.name.tag for info in about.metric_infos}
    assert {REWARD, "Evaluation/Reward"} <= compared & set(events.Tags()["scalars"])


class Blinking(gymnasium.Env[Any, Any]):
    """Episodes of four steps, and a picture that changes with each."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None):
        self.render_mode, self._step = render_mode, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self._step += 1
        return np.zeros(1, np.float32), 1.0, self._step == 4, False, {}

    def render(self) -> Any:
        return np.full((30, 40, 3), 50 * self._step, np.uint8)


def test_evaluations_of_what_is_rendered_have_a_video_and_films(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    spec = gymnasium.envs.registration.EnvSpec("Blinking-v0", Blinking)
    monkeypatch.setitem(gymnasium.registry, "Blinking-v0", spec)
    environment = {"type": "gymnasium", "id": "Blinking-v0", "num_envs": 2}
    rendered = {**environment, "kwargs": {"render_mode": "rgb_array"}}
    done = learn(write_run(rendered, evaluation={"interval": 32, "episodes": 4}))
    events = EventAccumulator(str(done.results / "toy"))
    events.Reload()
    videos = events.Images("Evaluation/Episode")
    assert [video.step for video in videos] == [0, 32, 64]
    image = Image.open(io.BytesIO(videos[0].encoded_image_string))
    assert image.n_frames == 5  # type: ignore[attr-defined]

    run = str(done.results / "toy")
    assert evaluate([run, "--render", "--episodes", "4"]) == 0
    files = {path.name for path in (done.results / "toy/evaluation").iterdir()}
    assert files == {f"{which}-{n}.gif" for which in ("first", "worst") for n in (1, 2)} | {
        "evaluation.json"
    }
    capfd.readouterr()
    assert evaluate([run, "environment.kwargs.render_mode=null", "--render"]) == 2
    assert "environment.kwargs.render_mode=rgb_array behind the policy" in capfd.readouterr().err


def test_first_actions_are_drawn_at_each_evaluation(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drawn(self: Evaluator, actions: Any) -> Any:
        return np.full((4, len(actions), 3), 9, np.uint8)

    monkeypatch.setattr(Evaluator, "drawn", drawn)
    done = learn(write_run("darts", evaluation={"interval": 32, "episodes": 6}))
    events = EventAccumulator(str(done.results / "toy"))
    events.Reload()
    images = events.Images("Evaluation/First Actions")
    # Of the first of two batches of four environments.
    assert [(image.step, image.width) for image in images] == [(0, 4), (32, 4), (64, 4)]
