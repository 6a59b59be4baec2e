"""The depth sensor's model, as both simulators have it."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from worlds import fixed_views, home, sampled

from encoders.spaces import DepthImage
from envs.grasp.robot.urdf import load_robot
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.sensors.depth import sense_depth, sensor_of
from envs.grasp.sensors.noise import fill_uniforms
from envs.grasp.settings import Camera, Support
from envs.grasp.simulators.fast import FastSimulator
from envs.grasp.simulators.pybullet import PyBulletSimulator

FLAT = np.full((1, 200, 300), 1.0, np.float32)


def cameras(sigma_m: list[float], missing: list[float] | None = None) -> CameraPoses:
    views = fixed_views(Camera(type="depth"), len(sigma_m))
    shares = np.zeros(len(sigma_m)) if missing is None else np.array(missing)
    return views.with_arrays({"noise_sigma_m": np.array(sigma_m), "missing_fraction": shares})


def render_depth(
    depth: np.ndarray, encoding: str = "uint16", sigma: float = 0.005, seed: int = 1
) -> np.ndarray:
    """Metres as they are delivered, from one picture; 0 where nothing was seen."""
    space = DepthImage(*depth.shape[1:], (0.4, 2.0), encoding)
    raw = sense_depth(depth, cameras([sigma]), space, np.array([seed], np.uint64))
    assert raw.shape == (*depth.shape, 1)
    assert raw.dtype == space.dtype
    raw = raw[..., 0].astype(float)
    return np.where(raw, raw / 1000 if encoding == "uint16" else 0.4 + raw * 1.6 / 255, 0.0)


@pytest.mark.parametrize("encoding", ["uint16", "uint8"])
def test_noise_is_gaussian_around_the_true_depth(encoding: str) -> None:
    sigma = 0.02  # some steps of the coarse encoding
    error = render_depth(FLAT, encoding, sigma) - 1.0
    step = 0.001 if encoding == "uint16" else 1.6 / 255
    spread = np.sqrt(sigma**2 + step**2 / 12)  # the rounding's own is uniform
    assert abs(error.mean()) < 5 * spread / np.sqrt(FLAT.size)
    assert error.std() == pytest.approx(spread, rel=0.02)
    for count, share in ((1, 0.683), (2, 0.954), (3, 0.9973)):
        assert (np.abs(error) < count * sigma).mean() == pytest.approx(share, abs=0.06)


def test_noise_is_independent_between_pixels() -> None:
    error = render_depth(FLAT, sigma=0.02)[0] - 1.0
    for other in (np.roll(error, 1, 0), np.roll(error, 1, 1)):
        assert abs(np.corrcoef(error.ravel(), other.ravel())[0, 1]) < 0.02


@pytest.mark.parametrize("encoding", ["uint16", "uint8"])
def test_no_noise_leaves_only_the_encodings_rounding(encoding: str) -> None:
    depth = np.linspace(0.41, 2.0, 900, dtype=np.float32).reshape(1, 30, 30)
    step = 0.001 if encoding == "uint16" else 1.6 / 255
    error = render_depth(depth, encoding, sigma=0.0) - depth
    assert 0.4 * step < np.abs(error).max() <= 0.501 * step


@pytest.mark.parametrize("encoding", ["uint16", "uint8"])
def test_what_is_outside_the_range_with_its_noise_is_not_seen(encoding: str) -> None:
    depth = np.array([[[0.1, 0.39, 0.4, 0.41, 1.99, 2.0, 2.01, 5.0, np.inf]]], np.float32)
    sensed = render_depth(depth.repeat(4000, axis=1), encoding, sigma=0.01)[0]
    seen = (sensed > 0.0).mean(axis=0)
    one = 0.8413  # of a normal distribution, what lies over minus one sigma
    expected = [0.0, 1 - one, 0.5, one, one, 0.5, 1 - one, 0.0, 0.0]
    np.testing.assert_allclose(seen, expected, atol=0.03)
    assert sensed[sensed > 0.0].min() >= 0.4
    assert sensed.max() <= 2.0 + 1e-9


def test_noise_depends_on_its_seed_alone() -> None:
    space = DepthImage(20, 20)
    depth = np.full((3, 20, 20), 1.0, np.float32)
    views = cameras([0.01] * 3, [0.2, 0.3, 0.2])
    many = sense_depth(depth, views, space, np.array([5, 6, 5], np.uint64))
    np.testing.assert_array_equal(many[0], many[2])
    assert (many[0] != many[1]).mean() > 0.8
    alone = sense_depth(depth[:1], views[1:2], space, np.array([6], np.uint64))
    np.testing.assert_array_equal(alone[0], many[1])


def test_every_picture_has_its_own_sigma() -> None:
    space = DepthImage(100, 100)
    depth = np.full((3, 100, 100), 1.0, np.float32)
    seeds = np.array([1, 2, 3], np.uint64)
    sensed = sense_depth(depth, cameras([0.0, 0.01, 0.05]), space, seeds)
    assert sensed.std(axis=(1, 2, 3)) == pytest.approx([0.0, 10.0, 50.0], rel=0.03)


def test_true_depth_is_left_alone() -> None:
    depth = FLAT.copy()
    render_depth(depth)
    np.testing.assert_array_equal(depth, FLAT)


# -- missing pixels --------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["uint16", "uint8"])
def test_every_picture_misses_its_own_share_of_pixels_and_no_other_changes(encoding: str) -> None:
    space = DepthImage(201, 301, encoding=encoding)  # an odd number of pixels
    depth = np.full((4, 201, 301), 1.0, np.float32)
    seeds, sigma = np.array([1, 2, 3, 2], np.uint64), [0.005, 0.01, 0.002, 0.01]
    whole = sense_depth(depth, cameras(sigma), space, seeds)
    holed = sense_depth(depth, cameras(sigma, [0.0, 0.3, 1.0, 0.01]), space, seeds)
    missing = holed == 0
    share = missing.mean(axis=(1, 2, 3))
    assert share[[0, 2]].tolist() == [0.0, 1.0]
    assert share[1] == pytest.approx(0.3, abs=0.01)
    assert share[3] == pytest.approx(0.01, abs=0.002)
    np.testing.assert_array_equal(holed[~missing], whole[~missing])
    assert not (missing[3] & ~missing[1]).any()  # more of the same seed's are missing


def test_pixels_are_missing_independently_of_each_other_and_of_the_noise() -> None:
    space, depth = DepthImage(200, 300, (0.01, 9.0)), FLAT + 0.0
    seed = np.array([7], np.uint64)
    missing = sense_depth(depth, cameras([0.0], [0.5]), space, seed)[0, ..., 0] == 0
    noise = sense_depth(depth, cameras([0.02]), space, seed)[0, ..., 0] - 1000.0
    limit = 5 / np.sqrt(depth.size)
    for other in (np.roll(missing, 1, 0), np.roll(missing, 1, 1), noise, np.abs(noise)):
        assert abs(np.corrcoef(missing.ravel(), other.ravel())[0, 1]) < limit
    halves = missing.reshape(2, -1)  # the two numbers of each pair
    assert abs(np.corrcoef(*halves)[0, 1]) < limit * np.sqrt(2)


def test_uniforms_are_uniform() -> None:
    count = 2_000_000
    sample = np.empty(count, np.float32)
    fill_uniforms(np.uint64(12345678901234567), sample)
    assert sample.min() >= 0.0
    assert sample.max() < 1.0
    ordered = np.sort(sample[::20].astype(float))
    rank = np.arange(1, len(ordered) + 1) / len(ordered)
    # Kolmogorov and Smirnov's distance; 1.95 / sqrt(n) is exceeded once in a thousand times.
    assert np.abs(rank - ordered).max() < 1.95 / np.sqrt(len(ordered))


@pytest.mark.parametrize("encoding", ["uint16", "uint8"])
def test_both_simulators_have_the_same_sensor(encoding: str) -> None:
    """Bit for bit, of the depths that each of them shows."""
    camera = Camera(type="depth", width=41, height=33)
    scenes, views = sampled(3, depth=camera)
    view = views["depth"].with_arrays(
        {
            "noise_sigma_m": np.array([0.0, 0.002, 0.02]),
            "missing_fraction": np.array([0.0, 0.05, 0.3]),
        }
    )
    space = DepthImage(33, 41, (0.6, 1.2), encoding)
    everywhere, seeds = np.arange(3), np.array([4, 5, 6], np.uint64)
    unseen = []
    for make in (PyBulletSimulator, FastSimulator):
        simulator = make(3, load_robot(), Support())
        simulator.load(everywhere, scenes, home(3))
        depth = simulator.render(everywhere, view)
        raw = simulator.render_depth(everywhere, view, space, seeds)
        simulator.close()
        np.testing.assert_array_equal(raw, sense_depth(depth, view, space, seeds))
        np.testing.assert_array_equal(raw[0], space.encode(depth[0]))
        unseen.append(raw[..., 0] == 0)
    assert (unseen[0] == unseen[1]).mean() > 0.99  # but for silhouettes, and depths near the ends
    assert 0.1 < unseen[0][0].mean() < 0.9


@pytest.mark.parametrize("share", [(-0.1, 0.5), (0.5, 1.5)])
def test_shares_of_missing_pixels_are_probabilities(share: tuple[float, float]) -> None:
    with pytest.raises(ValidationError, match=r"missing_fraction \[.*\].*within 0 and 1"):
        Camera(type="depth", missing_fraction=share)


def test_a_sensor_that_makes_no_sense_is_refused() -> None:
    space, seeds = DepthImage(200, 300), np.array([1], np.uint64)
    for views in (cameras([np.nan]), cameras([0.0], [np.inf]), cameras([0.0, 0.0])):
        with pytest.raises(ValueError, match="must be within 0 and 1, one for each of 1 pictures"):
            sense_depth(FLAT, views, space, seeds)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("noise_sigma_m", -0.001),
        ("noise_sigma_m", np.inf),
        ("missing_fraction", -0.1),
        ("missing_fraction", 1.1),
        ("missing_fraction", np.nan),
        ("sensor_strength", -1.0),
        ("sensor_strength", 10.5),
    ],
)
def test_what_the_settings_would_not_allow_is_refused(name: str, value: float) -> None:
    poses = fixed_views(Camera(type="depth", width=4, height=3), 2)
    wrong = poses.with_arrays({name: np.array([0.0, value])})
    with pytest.raises(ValueError, match=f"{name} must be within 0 and 1"):
        sensor_of(wrong, DepthImage(3, 4), np.zeros(2, np.uint64))
