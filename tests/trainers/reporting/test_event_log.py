from __future__ import annotations

import itertools
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from trainers.common.averager import Averager
from trainers.common.errors import UnwritableError
from trainers.reporting.event_log import RunLog

TAG = "Environment/Cumulative Reward"


@pytest.fixture(autouse=True)
def _a_second_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Event files are read in the order of their names, which begin with the second.

    Within a second a counter follows, in which 10 stands before 9.
    """
    seconds = itertools.count(int(time.time()))
    monkeypatch.setattr(time, "time", lambda: float(next(seconds)))


def read_back(directory: Path) -> EventAccumulator:
    accumulator = EventAccumulator(str(directory))
    accumulator.Reload()
    return accumulator


def points(directory: Path, tag: str = TAG) -> list[tuple[int, float]]:
    return [(event.step, event.value) for event in read_back(directory).Scalars(tag)]


def test_scalars_are_in_the_file_before_it_is_closed(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "results" / "run")
    log.scalars({TAG: 0.5, "Policy/Entropy": 1.25}, step=100)
    log.scalars({TAG: -1.5}, step=200)
    assert points(tmp_path / "results" / "run") == [(100, 0.5), (200, -1.5)]
    assert points(tmp_path / "results" / "run", "Policy/Entropy") == [(100, 1.25)]
    log.close()


def test_a_nan_is_logged_as_one(tmp_path: Path) -> None:
    log = RunLog(tmp_path)
    log.scalars({TAG: float("nan")}, step=1)
    assert math.isnan(points(tmp_path)[0][1])
    log.close()


def test_text_and_images(tmp_path: Path) -> None:
    import cv2

    log = RunLog(tmp_path)
    picture = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)
    gray = picture[..., :1]
    log.text("Run/Configuration", "seed: **1**", step=0)
    log.image("Camera/RGB", picture, step=3)
    log.image("Camera/Depth", gray, step=3)
    log.close()
    accumulator = read_back(tmp_path)
    (text,) = accumulator.Tensors("Run/Configuration/text_summary")
    assert text.tensor_proto.string_val[0] == b"seed: **1**"
    (image,) = accumulator.Images("Camera/RGB")
    decoded = cv2.imdecode(np.frombuffer(image.encoded_image_string, np.uint8), cv2.IMREAD_COLOR)
    assert image.step == 3
    assert np.array_equal(decoded[..., ::-1], picture)
    (image,) = accumulator.Images("Camera/Depth")
    decoded = cv2.imdecode(np.frombuffer(image.encoded_image_string, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decoded, np.repeat(gray, 3, axis=2))


def test_a_resumed_run_has_no_doubled_points(tmp_path: Path) -> None:
    first = RunLog(tmp_path)
    for step in (100, 200, 300, 400):
        first.scalars({TAG: 1.0}, step)
    first.close()
    # The checkpoint was saved at step 200; 300 and 400 were lost with the crash.
    second = RunLog(tmp_path, resumed_at=200)
    second.scalars({TAG: 2.0}, 300)
    second.close()
    assert points(tmp_path) == [(100, 1.0), (200, 1.0), (300, 2.0)]


def test_lost_points_are_hidden_even_where_the_new_ones_fall_between(tmp_path: Path) -> None:
    first = RunLog(tmp_path)
    for step in (100, 200, 300):
        first.scalars({TAG: 1.0}, step)
    first.close()
    RunLog(tmp_path, resumed_at=150).close()
    assert points(tmp_path) == [(100, 1.0)]


def test_status_is_strict_json(tmp_path: Path) -> None:
    log = RunLog(tmp_path)
    log.status({"step": 1})
    log.status(
        {
            "step": np.int64(5),
            "reward": float("nan"),
            "best": np.float32("inf"),
            "rewards": (0.5, np.array([1.0, np.nan])),
            "lesson": None,
            "path": Path("results/a"),
            "name": "è",
        }
    )
    log.close()

    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} is no JSON")

    text = (tmp_path / "status.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=refuse) == {
        "step": 5, "reward": None, "best": None, "rewards": [0.5, [1.0, None]], "lesson": None,
        "path": "results/a", "name": "è",
    }  # fmt: skip
    assert not list(tmp_path.glob(".status*"))


def test_a_failed_status_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    log = RunLog(tmp_path)
    log.status({"step": 1})

    def fail(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        log.status({"step": 2})
        log.status({"step": 3})
    (told,) = caplog.messages
    assert told.startswith(f"{tmp_path}: the log can't be written (cannot write: No space left")
    assert json.loads((tmp_path / "status.json").read_text()) == {"step": 1}
    assert not list(tmp_path.glob(".status*"))
    log.close()


def test_a_place_that_is_no_directory_is_an_error_naming_it(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UnwritableError) as caught:
        RunLog(tmp_path / "file" / "run")
    assert caught.value.filename == str(tmp_path / "file" / "run")


def test_a_full_disk_is_told_once_and_the_log_goes_on_when_it_has_room(tmp_path: Path) -> None:
    # A limit on the size of files stands in for a full disk: writes beyond it fail alike.
    program = """
import resource, sys
from pathlib import Path
from trainers.reporting.event_log import RunLog
log = RunLog(Path(sys.argv[1]))
log.scalars({"before": 1.0}, 0)
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
for step in range(100):
    log.scalars({f"tag {i}": float(step) for i in range(30)}, step)
    log.status({"step": step, "long": "x" * 2000})
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
log.scalars({"lost": 1.0}, 100)
log.status({"step": 100})
log.scalars({"after": 2.0}, 101)
log.close()
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)],
        capture_output=True, text=True, timeout=60, check=True,
        cwd=Path(__file__).parents[3],
    )  # fmt: skip
    (told,) = done.stderr.splitlines()
    assert told.startswith(f"{tmp_path}: the log can't be written (")
    assert "File too large" in told
    assert json.loads((tmp_path / "status.json").read_text()) == {"step": 100}
    assert points(tmp_path, "before") == [(0, 1.0)]
    assert points(tmp_path, "after") == [(101, 2.0)]
    assert "lost" not in read_back(tmp_path).Tags()["scalars"]


def test_averager_weighs_by_count_and_starts_anew() -> None:
    averager = Averager()
    averager.add({"reward": 2.0, "length": 10.0})
    averager.add({"reward": 5.0}, count=3)
    averager.add({"reward": float("nan")}, count=0)
    assert averager.pop_means() == {"reward": 17 / 4, "length": 10.0}
    assert averager.pop_means() == {}
    averager.add({"reward": 1.0})
    assert averager.pop_means() == {"reward": 1.0}
