"""What TensorBoard itself finds in the event files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from trainers.loggers.animation import animated_gif
from trainers.loggers.base import LoggedRun, flat
from trainers.loggers.tensorboard import TensorBoard

FRAMES = np.zeros((3, 40, 60, 3), np.uint8)
FRAMES[np.arange(3), :, :, np.arange(3)] = 255  # red, green, blue


def read_back(directory: Path) -> EventAccumulator:
    accumulator = EventAccumulator(str(directory))
    accumulator.Reload()
    return accumulator


def shown(gif: bytes) -> tuple[list[tuple[int, ...]], list[int]]:
    """Color of the middle pixel, and the milliseconds, of each frame."""
    image = Image.open(io.BytesIO(gif))
    colors, durations = [], []
    for number in range(image.n_frames):  # type: ignore[attr-defined]
        image.seek(number)
        colors.append(image.convert("RGB").getpixel((30, 20)))
        durations.append(image.info["duration"])
    return colors, durations  # type: ignore[return-value]


@pytest.mark.parametrize(("fps", "each_ms"), [(1.0, 1000), (30.0, 30), (25.0, 40), (1000.0, 20)])
def test_frames_are_shown_one_after_the_other(fps: float, each_ms: int) -> None:
    colors, durations = shown(animated_gif(FRAMES, fps))
    assert colors == [(255, 0, 0), (0, 255, 0), (0, 0, 255)]
    assert durations == [each_ms] * 3


def test_a_video_is_among_the_images_and_moves(tmp_path: Path) -> None:
    logger = TensorBoard(TensorBoard.Settings(), LoggedRun(tmp_path))
    logger.video("Evaluation/Episode", FRAMES, 10.0, step=7)
    (image,) = read_back(tmp_path).Images("Evaluation/Episode")
    logger.close()
    assert (image.step, image.width, image.height) == (7, 60, 40)
    assert shown(image.encoded_image_string) == shown(animated_gif(FRAMES, 10.0))


def test_the_page_hparams_has_settings_and_what_is_compared(tmp_path: Path) -> None:
    logger = TensorBoard(TensorBoard.Settings(), LoggedRun(tmp_path))
    settings = {"trainer": {"trainer_type": "ppo", "gamma": 0.5}, "seed": 3, "curriculum": None}
    logger.hyperparameters(settings, ["Environment/Cumulative Reward"])
    content = read_back(tmp_path).PluginTagToContent("hparams")
    logger.close()
    begun = HParamsPluginData.FromString(content["_hparams_/session_start_info"])
    values = begun.session_start_info.hparams
    assert values["trainer.trainer_type"].string_value == "ppo"
    assert values["trainer.gamma"].number_value == 0.5
    assert values["seed"].number_value == 3.0
    assert values["curriculum"].string_value == "null"
    about = HParamsPluginData.FromString(content["_hparams_/experiment"]).experiment
    assert [info.name.tag for info in about.metric_infos] == ["Environment/Cumulative Reward"]
    assert "_hparams_/session_end_info" not in content  # the run goes on


def test_settings_are_flattened_by_their_paths() -> None:
    nested = {
        "rewards": [{"type": "touch", "weight": 2.0}],
        "encoders": {},
        "environment": {"range_m": [1, 2], "frame_grab": True, "cameras": {"depth": {"width": 4}}},
    }
    assert flat(nested) == {
        "rewards.0.type": "touch",
        "rewards.0.weight": 2.0,
        "encoders": "{}",
        "environment.range_m": "[1, 2]",
        "environment.frame_grab": True,
        "environment.cameras.depth.width": 4,
    }


def test_a_service_finds_its_own_run_again(tmp_path: Path) -> None:
    numbers = iter("ab")
    first = LoggedRun(tmp_path)
    assert first.identifier("wandb", lambda: next(numbers)) == "a"
    assert first.identifier("mlflow", lambda: next(numbers)) == "b"
    resumed = LoggedRun(tmp_path, resumed_at=100)
    assert resumed.identifier("wandb", lambda: next(numbers)) == "a"
    assert resumed.identifier("mlflow", lambda: next(numbers)) == "b"
