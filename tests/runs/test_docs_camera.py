"""The page on cameras does what it says."""

from __future__ import annotations

import re
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from envs.views import CameraFile
from trainers.evaluation import evaluation_environment, find_run
from trainers.inference.onnx_policy import OnnxPolicy

POLICY = Path(__file__).parents[2] / "policies" / "grasp_gaussian"
PAGE = (Path(__file__).parents[2] / "docs/camera.md").read_text()
(FILE,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
(LOOP,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_camera_file_has_every_key_there_is_but_the_one_that_stands_for_others() -> None:
    content = yaml.safe_load(FILE)
    CameraFile.model_validate(content)
    assert set(content) == set(CameraFile.model_fields) - {"rotation"}


def seen(count: int) -> list[np.ndarray]:
    """What the shipped policy's camera sees of some scenes, as it delivers it."""
    _, run = find_run(str(POLICY), [], Path("results"))
    with closing(evaluation_environment(run, count)) as env:
        observations, _ = env.reset(seed=0)
    return list(observations["depth"][..., 0])


def test_the_loop_moves_the_robot_where_it_is_sure(
    shipped_onnx: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = OnnxPolicy.load(shipped_onnx)
    ((name, raw),) = policy.raw_inputs.items()
    frames = [*seen(8), np.full(raw.shape, 900, np.uint16)]
    answers = [policy.run({name: frame[None]}) for frame in frames]
    expected = [answer["pose"][0].tolist() for answer in answers if answer["sure"][0]]
    assert len(expected) > 4
    assert not answers[-1]["sure"][0]  # of a wall
    moves: list[dict[str, float]] = []

    class Camera:
        def is_open(self) -> bool:
            return bool(frames)

        def read(self) -> np.ndarray:
            return frames.pop(0)

    class Robot:
        def move_to(self, pose: dict[str, float]) -> None:
            moves.append(pose)

    monkeypatch.chdir(shipped_onnx.parent)
    known: dict[str, Any] = {"camera": Camera(), "robot": Robot()}
    exec(LOOP, known)
    np.testing.assert_allclose([list(pose.values()) for pose in moves], expected, atol=1e-6)
    assert list(moves[0]) == ["x_m", "y_m", "z_m", "yaw_rad"]
    frames.append(np.zeros((4, 4), np.uint16))
    with pytest.raises(ValueError, match=r"uint16 \(4, 4\), where the policy takes"):
        exec(LOOP, known)
