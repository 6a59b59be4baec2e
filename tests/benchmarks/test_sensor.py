"""The figures of a structured-light camera's frames, and their comparison."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import sensor

DISPARITY_M = 585.0 * 0.075


def wall(deviation_mm: float = 0.0, steps: bool = True) -> sensor.Frame:
    """A slanted wall, from 0.9 m on the left to 1.6 m on the right."""
    depth = np.tile(np.linspace(0.9, 1.6, 640), (480, 1))
    depth += np.random.default_rng(0).normal(0.0, deviation_mm / 1000.0, depth.shape)
    if steps:
        depth = DISPARITY_M / (np.rint(8.0 * DISPARITY_M / depth) / 8.0)
    return np.rint(1000.0 * depth).astype(np.uint16)


def test_steps_are_found() -> None:
    found = sensor.measure(wall())
    for depth_m in sensor.STEPS_AT_M:
        step_mm = 1000.0 * depth_m**2 / (8.0 * DISPARITY_M)
        assert found[f"step at {depth_m} m (mm)"] == pytest.approx(step_mm, rel=0.02)


def test_deviations_from_planes_leave_edges_out() -> None:
    frame = wall(3.0, steps=False)
    frame[200:300] = np.where(np.arange(640) % 40 < 20, frame[200:300], 900)
    found = sensor.measure(frame)
    for depth_m in sensor.PLANES_AT_M:
        # and a millimetre's rounding
        assert found[f"deviation from planes at {depth_m} m (mm)"] == pytest.approx(3.02, rel=0.02)


def test_missing_pixels_are_counted_and_what_a_frame_does_not_show_is_no_number() -> None:
    frame = np.full((480, 640), 700, np.uint16)
    frame[:120] = 0
    found = sensor.measure(frame)
    assert found.pop(sensor.MISSING) == 25.0
    assert np.isnan(list(found.values())).all()


def test_simulated_frames_are_as_a_real_one() -> None:
    found = sensor.simulated(6)
    for name in sensor.NAMES[1:4]:
        assert found[name] == pytest.approx(sensor.REAL[name], rel=0.025)
    for name in sensor.NAMES[4:]:
        assert found[name] == pytest.approx(sensor.REAL[name], rel=0.15)
    assert 2.0 < found[sensor.MISSING] < 15.0


def test_a_frame_of_ones_own_is_printed_beside_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(sensor, "SPEED_ROUNDS", 1)
    monkeypatch.setattr(sensor, "SPEED_WORLDS", 2)
    cv2.imwrite(str(tmp_path / "own.png"), wall())
    assert sensor.main([str(tmp_path / "own.png"), "--frames", "1"]) == 0
    printed = capsys.readouterr().out
    assert "own.png" in printed
    assert "structured_light" in printed


def test_what_is_no_depth_frame_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "color.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(
        sensor.UserError, match=r"color\.png: uint8 of shape .*expected is a 16-bit"
    ):
        sensor.read(tmp_path / "color.png")
    with pytest.raises(sensor.UserError, match=r"none\.png: can't be read: No such file"):
        sensor.read(tmp_path / "none.png")
    (tmp_path / "empty.png").touch()
    with pytest.raises(sensor.UserError, match=r"empty\.png: no image"):
        sensor.read(tmp_path / "empty.png")
