"""Weights & Biases and MLflow: what their own readers find, and what is asked of their packages.

The packages need not be installed: stand-ins keep what they are told. With `PYTHONPATH` on a folder
that has the packages, their own readers are asked, too.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trainers.common.errors import UserError
from trainers.loggers.base import LoggedRun, Logger
from trainers.loggers.mlflow import MLflow
from trainers.loggers.wandb import WeightsAndBiases

REWARD, LOSS = "Environment/Cumulative Reward", "Losses/Policy Loss"
FRAMES = np.zeros((3, 4, 6, 3), np.uint8)
SETTINGS = {"trainer": {"gamma": 0.5}, "rewards": [{"type": "touch"}]}


def log(logger: Logger, *steps: int) -> None:
    logger.text("configuration", "seed: 1", steps[0])
    logger.hyperparameters(SETTINGS, [REWARD])
    for step in steps:
        logger.scalars({REWARD: step / 100, LOSS: 1.0}, step)
    logger.image("Observations/camera", FRAMES[0], steps[-1])
    logger.video("Evaluation/Episode", FRAMES, 10.0, steps[-1])
    logger.close()


class FakeClient:
    """An `MlflowClient` whose server is a dictionary of the class."""

    runs: dict[str, SimpleNamespace]

    def __init__(self, tracking_uri: str | None):
        self.uri = tracking_uri

    def get_experiment_by_name(self, name: str) -> None:
        return None

    def create_experiment(self, name: str) -> str:
        return f"experiment {name}"

    def create_run(self, experiment: str, run_name: str) -> Any:
        run = SimpleNamespace(of=experiment, name=run_name, points=[], params={}, files=[])
        key = f"run {len(self.runs)}"
        self.runs[key] = run
        return SimpleNamespace(info=SimpleNamespace(run_id=key))

    def update_run(self, run_id: str, status: str) -> None:
        self.runs[run_id].status = status

    def get_run(self, run_id: str) -> Any:
        run = self.runs[run_id]
        data = SimpleNamespace(params=run.params, metrics={name for name, *_ in run.points})
        return SimpleNamespace(data=data)

    def get_metric_history(self, run_id: str, key: str) -> list[Any]:
        points = self.runs[run_id].points
        return [SimpleNamespace(step=step) for name, _, _, step in points if name == key]

    def log_batch(self, run_id: str, metrics: Any = (), params: Any = ()) -> None:
        assert len(params) <= 100
        self.runs[run_id].points += metrics
        self.runs[run_id].params |= dict(params)

    def log_text(self, run_id: str, text: str, name: str) -> None:
        self.runs[run_id].files.append(name)

    def log_image(self, run_id: str, image: np.ndarray, key: str, step: int) -> None:
        self.runs[run_id].files.append(f"{key} {step} {image.shape}")

    def log_artifact(self, run_id: str, path: str, folder: str | None) -> None:
        assert Path(path).read_bytes().startswith(b"GIF89a")
        self.runs[run_id].files.append(f"{folder}/{Path(path).name}")

    def set_terminated(self, run_id: str) -> None:
        self.runs[run_id].status = "FINISHED"


@pytest.fixture
def fake_mlflow(monkeypatch: pytest.MonkeyPatch) -> type[FakeClient]:
    entities = SimpleNamespace(Metric=lambda *point: point, Param=lambda *pair: pair)
    monkeypatch.setitem(sys.modules, "mlflow", SimpleNamespace(MlflowClient=FakeClient))  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "mlflow.entities", entities)  # type: ignore[arg-type]
    monkeypatch.setattr(FakeClient, "runs", {}, raising=False)
    return FakeClient


def test_mlflow_is_told_each_point_once_by_a_run_that_is_resumed(
    fake_mlflow: type[FakeClient], tmp_path: Path
) -> None:
    settings = MLflow.Settings(experiment="poles")
    log(MLflow(settings, LoggedRun(tmp_path)), 100, 200, 300)
    log(MLflow(settings, LoggedRun(tmp_path, resumed_at=100)), 200, 300, 400)
    (run,) = fake_mlflow.runs.values()
    assert (run.of, run.name, run.status) == ("experiment poles", tmp_path.name, "FINISHED")
    rewards = [(step, value) for name, value, _, step in run.points if name == REWARD]
    assert rewards == [(100, 1.0), (200, 2.0), (300, 3.0), (400, 4.0)]
    assert [step for name, *_, step in run.points if name == LOSS] == [100, 200, 300, 400]
    assert run.params == {"trainer.gamma": "0.5", "rewards.0.type": "touch"}
    files = ["configuration.md", "Observations/camera 300 (4, 6, 3)", "Evaluation/Episode 300.gif"]
    assert run.files[:3] == files


def test_mlflow_gets_settings_in_parts_and_names_it_allows(
    fake_mlflow: type[FakeClient], tmp_path: Path
) -> None:
    logger = MLflow(MLflow.Settings(), LoggedRun(tmp_path))
    logger.hyperparameters({f"key {number}": number for number in range(250)}, [])
    logger.scalars({"Policy/KL (mean), äöß%": 1.0}, 5)
    (run,) = fake_mlflow.runs.values()
    assert len(run.params) == 250
    assert [name for name, *_ in run.points] == ["Policy/KL _mean__ äöß_"]


class FakeWandb(SimpleNamespace):
    """The package `wandb` as far as it is asked for anything."""

    def __init__(self) -> None:
        super().__init__(begun=[], rows=[], finished=0)
        self.config = SimpleNamespace(update=lambda values, **options: self.rows.append(values))
        self.Html = self.Image = lambda what: type(what).__name__
        self.Video = lambda file, format: (format, file.read()[:6])
        self.Settings = dict

    def init(self, **options: Any) -> FakeWandb:
        self.begun.append(options)
        return self

    def log(self, values: dict[str, Any], step: int) -> None:
        self.rows.append((step, values))

    def finish(self) -> None:
        self.finished += 1


def test_wandb_is_given_the_same_run_where_it_is_resumed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)  # type: ignore[arg-type]
    settings = WeightsAndBiases.Settings(project="poles", tags=("a",), mode="offline")
    log(WeightsAndBiases(settings, LoggedRun(tmp_path)), 100, 200)
    log(WeightsAndBiases(settings, LoggedRun(tmp_path, resumed_at=100)), 200)
    first, second = fake.begun
    assert first["id"] == second["id"]
    assert (first["project"], first["mode"], first["resume"]) == ("poles", "offline", "allow")
    assert first["name"] == tmp_path.name
    assert first["settings"]["console"] == "off"
    assert fake.rows[:6] == [
        (100, {"configuration": "str"}),
        SETTINGS,
        (100, {REWARD: 1.0, LOSS: 1.0}),
        (200, {REWARD: 2.0, LOSS: 1.0}),
        (200, {"Observations/camera": "ndarray"}),
        (200, {"Evaluation/Episode": ("gif", b"GIF89a")}),
    ]
    assert fake.finished == 2


@pytest.mark.parametrize(("cls", "extra"), [(MLflow, "mlflow"), (WeightsAndBiases, "wandb")])
def test_the_extra_of_a_package_that_is_missing_is_named(
    monkeypatch: pytest.MonkeyPatch, cls: type[Logger], extra: str
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=rf"^{extra} is not installed: .*'ventosa\[{extra}\]'$"):
        cls.check(cls.Settings())


def test_mlflows_own_reader_finds_it_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy")
    monkeypatch.chdir(tmp_path)  # where it keeps artifacts
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    settings = MLflow.Settings(tracking_uri=uri)
    log(MLflow(settings, LoggedRun(tmp_path)), 100, 200)
    log(MLflow(settings, LoggedRun(tmp_path, resumed_at=100)), 200, 300)
    client = mlflow.MlflowClient(uri)
    (run,) = client.search_runs([client.get_experiment_by_name("ventosa").experiment_id])
    history = client.get_metric_history(run.info.run_id, REWARD)
    assert [(point.step, point.value) for point in history] == [(100, 1.0), (200, 2.0), (300, 3.0)]
    assert run.data.params == {"trainer.gamma": "0.5", "rewards.0.type": "touch"}
    files = {file.path for file in client.list_artifacts(run.info.run_id, "Evaluation")}
    assert files == {"Evaluation/Episode 200.gif", "Evaluation/Episode 300.gif"}


def test_wandbs_own_reader_finds_it_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb")
    monkeypatch.chdir(tmp_path)
    log(
        WeightsAndBiases(WeightsAndBiases.Settings(mode="offline"), LoggedRun(tmp_path)),
        100, 200,
    )  # fmt: skip
    wandb.teardown()  # waits for its process, which writes the file
    (path,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    rows = [dict(row) for row in history(path)]
    assert [(row["_step"], row[REWARD]) for row in rows if REWARD in row] == [
        ("100", "1"), ("200", "2"),
    ]  # fmt: skip
    (gif,) = tmp_path.glob("wandb/offline-run-*/files/media/videos/Evaluation/*.gif")
    assert gif.read_bytes().startswith(b"GIF89a")


def history(path: Path) -> Iterator[list[tuple[str, str]]]:
    """The rows of an offline run's file, values as JSON.

    It is a log of LevelDB's (7 bytes of header in front): records in chunks, which have a checksum,
    their length and a type, 2 and 3 where more of the record follows.
    """
    from wandb.proto.wandb_internal_pb2 import Record  # type: ignore[import-not-found]

    content, place, whole = path.read_bytes(), 7, b""
    while place < len(content):
        _, length, kind = struct.unpack_from("<IHB", content, place)
        whole += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (2, 3):
            continue
        record, whole = Record.FromString(whole), b""
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            yield [(item.key or "/".join(item.nested_key), item.value_json) for item in items]
