"""The pictures of an evaluation: what is judged, and what is drawn."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from envs.drawing import TEXT_HEIGHT_PX
from envs.grasp.env import make_vector_env
from envs.grasp.evaluation import overlay
from envs.grasp.evaluation import report as report_module
from envs.grasp.evaluation.film import film
from envs.grasp.evaluation.plots import (
    COMMAND_COLOR,
    TRUE_COLOR,
    contact_sheet,
    error_histograms,
)
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import heading
from envs.grasp.sensors.camera import project
from envs.grasp.settings import Camera, GraspSettings
from envs.grasp.vector_env import GraspVectorEnv

SHOWN, ENVS = 7, 8
ARM = Arm.of(GraspSettings(), load_robot())


@pytest.fixture(autouse=True)
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_module, "SHOWN", SHOWN)
    monkeypatch.setattr(report_module, "FILMED", 1)
    monkeypatch.setattr(report_module, "WORST_FILMED", 1)


@pytest.fixture(scope="module")
def env() -> Iterator[GraspVectorEnv]:
    made = make_vector_env(ENVS, simulator="fast", seed=1)
    made.reset()
    yield made
    made.close()


def actions(env: GraspVectorEnv, *, ahead: float, up: float, yaw_deg: float) -> np.ndarray:
    """Actions to poses that far from the grasp points."""
    scenes = env.scenes
    tooltip = scenes.target_m + ahead * heading(scenes.target_yaw_rad) + [0.0, 0.0, up]
    return env.action_for(tooltip, scenes.target_yaw_rad + np.radians(yaw_deg))


def outcomes(*, success: int) -> dict[str, np.ndarray]:
    good = np.arange(ENVS) < success
    return {"success": good, "no_seal": ~good}


def test_errors_are_those_to_the_middle_of_the_goal_region(env: GraspVectorEnv) -> None:
    report = env.evaluator().pictures()
    report.add(actions(env, ahead=-0.025, up=0.004, yaw_deg=-3.0), outcomes(success=1))
    (errors,) = report._errors
    # The region's gap goes from 10 to 20 mm.
    np.testing.assert_allclose(errors.error_m, np.tile([0.0, 0.004, 0.01], (ENVS, 1)), atol=1e-9)
    np.testing.assert_allclose(errors.yaw_error_deg, -3.0)
    np.testing.assert_allclose(errors.distance_m, np.hypot(0.004, 0.01))
    assert len(report._samples) == SHOWN
    assert report._samples[0].caption == "10.8 mm, 3.0 deg   picked"
    assert report._samples[1].caption == "10.8 mm, 3.0 deg   no seal"


def test_the_worst_are_those_that_failed_and_then_those_furthest_out(env: GraspVectorEnv) -> None:
    report = env.evaluator().pictures()
    # In the gap 0.0, 0.5, 1.0, ... of the limit of 5 mm off; later, 4 deg where 2 are allowed.
    gap_m = -0.015 - 0.0025 * np.arange(ENVS)[:, None]
    report.add(actions(env, ahead=gap_m, up=0.0, yaw_deg=0.0), {})  # type: ignore[arg-type]
    picked = np.arange(ENVS) != 3
    report.add(
        actions(env, ahead=-0.015, up=0.0, yaw_deg=4.0), {"success": picked, "missed": ~picked}
    )
    misses = np.concatenate([errors.misses for errors in report._errors])
    expected = [*(0.5 * np.arange(ENVS)), *np.where(picked, 4.0 / env_yaw_limit(report), np.inf)]
    np.testing.assert_allclose(misses, expected, atol=1e-9)
    assert [sample.errors.misses[0] for sample in report._worst] == sorted(misses)[::-1][:SHOWN]
    assert report._worst[0].errors.outcome[0] == "missed"


def env_yaw_limit(report: Any) -> float:
    (limit,) = set(report._errors[0].region.yaw_limit_deg)
    return float(limit)


@pytest.mark.parametrize("checked", [True, False])
def test_all_files_are_drawn_and_can_be_opened(env: GraspVectorEnv, checked: bool) -> None:
    report = env.evaluator().pictures()
    found = outcomes(success=ENVS) if checked else {}
    for _ in range(2):
        report.add(actions(env, ahead=-0.015, up=0.0, yaw_deg=0.0), found)
    files = dict(report.files())
    assert tuple(files) == report.file_names
    for name, content in files.items():
        with Image.open(io.BytesIO(content)) as image:
            image.load()
            assert min(image.size) > 300, name


def test_the_film_goes_on_to_the_pick_only_where_there_is_one(env: GraspVectorEnv) -> None:
    lengths_ms = []
    for found in ({}, outcomes(success=ENVS)):
        report = env.evaluator().pictures()
        report.add(actions(env, ahead=-0.015, up=0.0, yaw_deg=0.0), found)
        content = film(report._samples[:1], GraspSettings(), ARM, bool(found))
        with Image.open(io.BytesIO(content)) as image:
            assert image.info["loop"] == 0
            lengths_ms.append(0)
            for frame in range(image.n_frames):  # type: ignore[attr-defined]
                image.seek(frame)
                lengths_ms[-1] += image.info["duration"]
    # Lifting takes one second, and holding another.
    assert lengths_ms[1] - lengths_ms[0] > 2000


def test_a_cloud_is_drawn_as_the_image_of_its_points() -> None:
    made = make_vector_env(2, simulator="fast", cameras={"eye": Camera(type="points")})
    try:
        observations, _ = made.reset(seed=0)
        report = made.evaluator().pictures()
        report.add(np.zeros((2, 4)), {})
        for sample, cloud in zip(report._samples, observations["eye"], strict=True):
            assert sample.image.shape == (80, 80, 1)
            assert np.count_nonzero(sample.image) == cloud[:, 3].sum() == 512
        contact_sheet(report._samples, 0.03)
    finally:
        made.close()


def test_the_cup_is_drawn_where_the_camera_would_see_it(
    env: GraspVectorEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[tuple[Any, Any]] = []
    monkeypatch.setattr(
        "matplotlib.axes.Axes.plot",
        lambda self, u, v, color, **_: lines.append((u, v)) if color == COMMAND_COLOR else None,
    )
    report = env.evaluator().pictures()
    report.add(actions(env, ahead=-0.015, up=0.0, yaw_deg=0.0), {})
    sample = report._samples[0]
    contact_sheet([sample], 0.03)
    (rim_u, rim_v), (stem_u, stem_v) = lines
    u, v, depth = project(sample.view, sample.tooltip_m[None, None])[0, 0]
    assert (stem_u[0], stem_v[0]) == (pytest.approx(u), pytest.approx(v))
    # The rim is round the tooltip, 30 mm away: up and down these are f * 30 mm / depth pixels.
    focal_px = 80 / 2 / np.tan(np.radians(44.0) / 2)
    assert rim_u.min() < u < rim_u.max()
    assert np.ptp(rim_v) == pytest.approx(2 * focal_px * 0.03 / depth, rel=0.1)


def test_pictures_show_the_episodes_own_goal_region(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_vector_env(2, simulator="fast", seed=1)
    env.set_parameters({"gap_limit_m": 0.05, "lateral_limit_m": 0.03, "yaw_limit_deg": 4.0})
    env.reset()
    report = env.evaluator().pictures()
    report.add(actions(env, ahead=-0.03, up=0.0, yaw_deg=0.0), {})
    env.close()
    # In the middle of a gap of 10 to 50 mm the cup at the goal is the commanded one.
    drawn: dict[str, list[np.ndarray]] = {TRUE_COLOR: [], COMMAND_COLOR: [], "black": []}
    spans: list[tuple[float, float]] = []
    monkeypatch.setattr(
        "matplotlib.axes.Axes.plot",
        lambda self, u, v, color, **_: drawn[color].append(np.stack([u, v])),
    )
    monkeypatch.setattr(
        "matplotlib.axes.Axes.axvspan", lambda self, low, high, **_: spans.append((low, high))
    )
    contact_sheet(report._samples, 0.03)
    for true, command in zip(drawn[TRUE_COLOR], drawn[COMMAND_COLOR], strict=True):
        np.testing.assert_allclose(true, command, atol=1e-6)
    (errors,) = report._errors
    error_histograms(errors)
    expected = [(-limit, limit) for limit in (30.0, 10.0, 20.0, 4.0)]
    np.testing.assert_allclose(spans, expected)


def test_an_rgb_camera_alone_will_do() -> None:
    env = make_vector_env(1, simulator="fast", cameras={"top": Camera(type="rgb")})
    try:
        env.reset()
        report = env.evaluator().pictures()
        report.add(actions(env, ahead=-0.015, up=0.0, yaw_deg=0.0), {})
        assert next(iter(report.files()))[1].startswith(b"\x89PNG")
    finally:
        env.close()


def test_without_matplotlib_the_message_says_what_to_install(
    env: GraspVectorEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find_spec(name)
    )
    with pytest.raises(ValueError, match=r"matplotlib.*\[render\]"):
        env.evaluator().pictures()


def test_first_actions_are_drawn_where_the_camera_would_see_them(env: GraspVectorEnv) -> None:
    picture = env.evaluator().drawn(actions(env, ahead=-0.015, up=0.0, yaw_deg=0.0))
    assert picture is not None
    tile_px = overlay.TILE_PX
    assert picture.shape == (2 * (tile_px + TEXT_HEIGHT_PX), 3 * tile_px, 3)
    # A perfect command covers the goal.
    assert not (picture[:tile_px] == overlay.GOAL_COLOR).all(axis=2).any()
    apart = env.evaluator().drawn(actions(env, ahead=-0.1, up=0.0, yaw_deg=0.0))
    assert apart is not None
    depth, scenes = next(iter(env._running().views.values())), env.scenes
    middle_m = scenes.target_m[1] - 0.015 * heading(scenes.target_yaw_rad[1])
    u, v, _ = project(depth[1:2], middle_m[None, None])[0, 0]
    rim = overlay.cup_lines(middle_m, float(scenes.target_yaw_rad[1]), ARM.robot.cup_radius_m)[0]
    scale = tile_px / depth.camera.width
    tile = apart[:tile_px, tile_px : 2 * tile_px]
    white = np.argwhere((tile == overlay.GOAL_COLOR).all(axis=2))[:, ::-1] / scale
    seen = project(depth[1:2], rim[None])[0, :, :2]
    far = np.linalg.norm(white - [u, v], axis=1)
    # Its axis is as long as in the world; its rim is around the middle.
    assert len(white) > 20
    assert far.min() <= np.linalg.norm(seen - [u, v], axis=1).max() + 1.0


def test_clouds_alone_are_not_drawn() -> None:
    made = make_vector_env(2, simulator="fast", cameras={"eye": Camera(type="points")})
    try:
        made.reset(seed=0)
        assert made.evaluator().drawn(np.zeros((2, 4))) is None
    finally:
        made.close()
