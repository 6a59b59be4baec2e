"""A structured-light camera's images, against geometry and formulas worked out here."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from worlds import fixed_views, home, sampled

from encoders.spaces import DepthImage
from envs.grasp.robot.urdf import load_robot
from envs.grasp.sensors.camera import CameraPoses, pinhole, sample_views
from envs.grasp.sensors.depth import sense_depth
from envs.grasp.sensors.shadows import find_shadows, greatest, place, reach
from envs.grasp.sensors.structured_light import StructuredLight
from envs.grasp.settings import Camera, Support
from envs.grasp.simulators.fast import FastSimulator
from envs.grasp.simulators.pybullet import PyBulletSimulator

FOCAL_PX, BASELINE_M = 585.0, 0.075
DISPARITY_M = FOCAL_PX * BASELINE_M
WIDTH, HEIGHT = 640, 480
# No fault at all but the projector's shadow.
IDEAL: dict[str, Any] = {
    "disparity_step_px": 0.0,
    "jitter_px": 0.0,
    "min_support": 0.5,
    "axial_sigma_m": 0.0,
    "axial_growth_per_m": 0.0,
    "incidence_deg": (89.8, 90.0),
    "speck_fraction": 0.0,
    "depth_scale": 0.0,
    "depth_offset_m": 0.0,
    "focal_scale": 0.0,
    "center_fraction": 0.0,
}
# Of a camera whose calibration is right.
CALIBRATED: dict[str, Any] = dict.fromkeys(
    ("depth_scale", "depth_offset_m", "focal_scale", "center_fraction"), 0.0
)


def camera(every: int = 1, width: int = WIDTH, height: int = HEIGHT, **sensor: Any) -> Camera:
    return Camera(
        type="depth",
        width=width,
        height=height,
        intrinsics={"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": width / 2, "cy": height / 2},
        sampling={"every": every},
        sensor={"type": "structured_light", **sensor},
    )


def sense(depth: np.ndarray, views: CameraPoses, seed: int = 0) -> np.ndarray:
    """Millimetres (n, H, W), 0 where nothing was seen, of true depths (H, W) or (n, H, W)."""
    images = np.broadcast_to(depth, (len(views), *depth.shape[-2:])).astype(np.float32)
    seeds = np.arange(len(views), dtype=np.uint64) + np.uint64(1000 * seed)
    return sense_depth(images, views, DepthImage(*images.shape[1:]), seeds)[..., 0].astype(float)


def shoot(depth: np.ndarray, every: int = 1, count: int = 1, **sensor: Any) -> np.ndarray:
    """As `sense`, by a camera that takes every so manyth pixel of (HEIGHT, WIDTH) true depths."""
    return sense(depth[::every, ::every], fixed_views(camera(every, **sensor), count))


def box_before_wall(left: int = 300, near_m: float = 1.0, far_m: float = 1.6) -> np.ndarray:
    depth = np.full((HEIGHT, WIDTH), far_m)
    depth[60:420, left : left + 150] = near_m
    return depth


# -- shadows ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("baseline_m", [BASELINE_M, -BASELINE_M, 0.05])
def test_a_box_casts_a_shadow_of_its_width_on_one_side(baseline_m: float) -> None:
    missing = shoot(box_before_wall(), count=4, **IDEAL | {"baseline_m": baseline_m}) == 0
    # f b (1 / z_near - 1 / z_far), worked out: 585 * 0.075 * 0.375 = 16.45 and 10.97 columns
    width = {0.075: 16.45, 0.05: 10.97}[abs(baseline_m)]
    left, right = missing[:, 60:420, 200:300].sum(2), missing[:, 60:420, 450:550].sum(2)
    shadow, other = (left, right) if baseline_m > 0 else (right, left)
    assert shadow.mean() == pytest.approx(width, abs=0.15)
    assert shadow.min() >= width - 2
    assert shadow.max() <= width + 2
    assert not other.any()
    assert missing.sum() == shadow.sum()
    # It touches the box.
    assert missing[:, 60:420, 299 if baseline_m > 0 else 450].all()


@pytest.mark.parametrize("every", [3, 6])
def test_a_sampled_shadow_is_as_wide_on_average(every: int) -> None:
    widths = [
        every * (shoot(box_before_wall(300 + shift), every, **IDEAL)[0][70 // every] == 0).sum()
        for shift in range(12)
    ]
    rows = [
        every * (shoot(box_before_wall(300 + shift), every, **IDEAL)[0] == 0).sum(1)[60 // every :]
        for shift in range(12)
    ]
    assert np.mean([row[: 360 // every] for row in rows]) == pytest.approx(16.45, rel=0.05)
    assert np.ptp(widths) <= 2 * every


def test_without_shadows_nothing_is_missing_beside_a_box() -> None:
    assert shoot(box_before_wall(), **IDEAL | {"shadow": False}).all()


def test_a_shadow_grows_with_the_strength() -> None:
    missing = shoot(box_before_wall(), count=4, **IDEAL | {"strength": (2.0, 2.0)}) == 0
    assert missing[:, 60:420].sum(2).mean() == pytest.approx(32.9, abs=0.2)


def hidden_by_definition(disparity: np.ndarray, factor: float) -> np.ndarray:
    """Whether d' - d > |u' - u| - 1/2 for any pixel on one side."""
    width, side = disparity.shape[1], 1 if factor > 0 else -1
    hidden = np.zeros(disparity.shape, bool)
    for u in range(width):
        for k in range(1, width):
            if 0 <= u + side * k < width:
                gain = abs(factor) * (disparity[:, u + side * k] - disparity[:, u])
                hidden[:, u] |= gain > k - 0.5
    return hidden


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (4, 3), (9, 7), (3, 64), (2, 150)])
@pytest.mark.parametrize("factor", [1.0, -1.0, 0.4, -3.0])
@pytest.mark.parametrize("margin", [1, 3])
def test_shadows_are_those_of_every_pair_of_pixels(
    size: tuple[int, int], factor: float, margin: int
) -> None:
    height, width = size
    rng = np.random.default_rng(width)
    # Some things near, some far, and nothing at all here and there.
    disparity = rng.choice([0.0, 5.0, 20.0, 45.0], size) + rng.random(size)
    stride, ends = width + 2 * margin, reach(width)
    placed = np.full((height + 2) * stride, np.nan, np.float32)
    keys, *room = (
        np.full(height * stride + 2 * ends, np.float32(1e9), np.float32) for _ in range(3)
    )
    side = 1 if factor > 0 else -1
    true = (disparity / 7.0).astype(np.float32).ravel()
    nearest = 7.0 * greatest(true, 0, width * height)
    assert nearest == pytest.approx(disparity.max(), rel=1e-6)
    place(true, 0, 7.0, width, margin, side * (nearest + 1.0), placed, keys)
    shown = np.pad(disparity, ((1, 1), (margin, margin)), mode="edge")
    np.testing.assert_allclose(placed.reshape(shown.shape), shown, rtol=1e-6)
    found = find_shadows(height * stride, factor, abs(factor) * nearest, keys, *room)
    dark = (found > keys)[ends:-ends].reshape(height, stride)[:, margin:-margin]
    toward = np.roll(shown, -side, axis=1)[1:-1, margin:-margin] - disparity
    dark |= toward > 0.5 / abs(factor)  # by the next pixel
    np.testing.assert_array_equal(dark, hidden_by_definition(disparity, factor))


# -- noise and steps -------------------------------------------------------------------------------


def test_disparities_are_eighths_of_a_pixel() -> None:
    for depth_m in (0.97, 1.2, 1.5):
        image = shoot(np.full((HEIGHT, WIDTH), depth_m), **CALIBRATED)
        levels = np.unique(image[image > 0]) / 1000.0
        # Rounded to millimetres, so that a step is known to one of the last and the first.
        step_m = np.ptp(levels) / (len(levels) - 1)
        assert step_m == pytest.approx(
            depth_m**2 / (8.0 * DISPARITY_M), rel=0.2 / len(levels) + 0.02
        )
        eighths = 8.0 * DISPARITY_M / levels
        rounding = 8.0 * DISPARITY_M / levels**2 * 0.0005
        assert (np.abs(eighths - np.rint(eighths)) <= rounding * 1.01).all()


@pytest.mark.parametrize("every", [1, 6])
@pytest.mark.parametrize("depth_m", [0.6, 1.2, 1.8])
def test_noise_grows_with_the_square_of_the_distance(depth_m: float, every: int) -> None:
    only = IDEAL | {"axial_sigma_m": 0.0012, "axial_growth_per_m": 0.0019}
    image = shoot(np.full((HEIGHT, WIDTH), depth_m), every, count=6, **only)
    sigma_mm = 1.2 + 1.9 * (depth_m - 0.4) ** 2
    # Noise is common to 8x8 pixels, and codes are whole millimetres.
    assert image.std() == pytest.approx(np.hypot(sigma_mm, 1.0 / np.sqrt(12.0)), rel=0.03)
    assert image.mean() == pytest.approx(1000.0 * depth_m, abs=0.15)


def test_noise_is_common_to_a_window_and_white_beyond() -> None:
    only = IDEAL | {"axial_sigma_m": 0.01, "window_px": 8.0}
    error = shoot(np.full((HEIGHT, WIDTH), 1.0), count=4, **only) - 1000.0
    for axis in (1, 2):
        for shift, expected in ((1, 7 / 8), (4, 1 / 2), (8, 0.0), (16, 0.0)):
            pair = np.corrcoef(error.ravel(), np.roll(error, shift, axis).ravel())
            assert pair[0, 1] == pytest.approx(expected, abs=0.04)
    sampled_error = shoot(np.full((HEIGHT, WIDTH), 1.0), 8, count=40, **only)
    pair = np.corrcoef(sampled_error.ravel(), np.roll(sampled_error, 1, 2).ravel())
    assert pair[0, 1] == pytest.approx(0.0, abs=0.03)


MIDDLE = (..., slice(HEIGHT // 2 - 40, HEIGHT // 2 + 40), slice(WIDTH // 2 - 4, WIDTH // 2 + 4))


def plane(incidence_deg: float, depth_m: float = 1.0) -> np.ndarray:
    """Depths (HEIGHT, WIDTH) of a plane, turned about the vertical: the incidence at `MIDDLE`."""
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL_PX
    inverse = (1.0 - np.tan(np.radians(incidence_deg)) * x) / depth_m
    with np.errstate(divide="ignore"):
        depth = np.where(inverse > 0.1, 1.0 / inverse, np.inf)
    return np.tile(depth, (HEIGHT, 1))


@pytest.mark.parametrize("incidence_deg", [0.0, 30.0, 65.0, 70.0, 78.0])
def test_noise_grows_with_the_incidence(incidence_deg: float) -> None:
    depth = plane(incidence_deg)
    only = IDEAL | {"axial_sigma_m": 0.0012, "axial_growth_per_m": 0.0019}
    error = (shoot(depth, count=24, **only) - 1000.0 * depth)[MIDDLE]
    theta = np.radians(incidence_deg)
    sigma_mm = 1.2 + 1.9 * 0.6**2
    if incidence_deg > 60.0:  # Nguyen et al., equation 3, at 1 m
        sigma_mm += 0.1 * theta**2 / (np.pi / 2 - theta) ** 2
    assert error.std() == pytest.approx(sigma_mm, rel=0.1, abs=0.1 if incidence_deg < 60 else 0.4)


# -- what is missing -------------------------------------------------------------------------------


def test_grazing_surfaces_are_missing() -> None:
    only = IDEAL | {"incidence_deg": (70.0, 80.0)}
    share = {
        angle: (shoot(plane(angle), count=24, **only)[MIDDLE] == 0).mean()
        for angle in (60.0, 69.0, 75.0, 82.0)
    }
    assert share[60.0] == share[69.0] == 0.0
    # Half way between both cosines is at 75.1 deg.
    assert share[75.0] == pytest.approx(0.5, abs=0.06)
    assert share[82.0] > 0.98


@pytest.mark.parametrize("every", [1, 6])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_dark_boxes_miss_their_share_and_nothing_else_does(every: int, share: float) -> None:
    views = fixed_views(camera(every, **IDEAL), 8)
    # Half a metre wide and 0.3 m high, before the wall and reaching through it, turned by 30 deg.
    turn, half_m = np.radians(30.0), np.array([0.25, 0.15, 0.02])
    axes = np.array(
        [[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    box = np.concatenate([[[0.1, -0.05, 1.2]], axes / half_m[:, None]])
    views = views.with_arrays(
        {"dark": np.tile(box, (8, 1, 1, 1)), "dark_missing": np.full((8, 1), share)}
    )
    v, u = np.mgrid[:HEIGHT:every, :WIDTH:every]
    eye = pinhole(views.camera)
    points = 1.2 * np.stack(
        [(u / every + 0.5 - eye.cx) / eye.fx, (v / every + 0.5 - eye.cy) / eye.fy]
    )
    across, down = np.tensordot(axes[:2, :2], points - np.array([0.1, -0.05])[:, None, None], 1)
    inside = (np.abs(across) < 0.25) & (np.abs(down) < 0.15)
    missing = sense(np.full(u.shape, 1.2), views) == 0
    assert missing[:, inside].mean() == pytest.approx(share, abs=0.05)
    assert not missing[:, ~inside].any()
    behind = sense(np.full(u.shape, 1.3), views)
    assert behind.all()


def test_a_dark_box_about_the_camera_is_no_mistake() -> None:
    views = fixed_views(camera(8, **IDEAL))
    box = np.concatenate([np.zeros((1, 3)), np.eye(3) / 5.0])
    views = views.with_arrays({"dark": box[None, None], "dark_missing": np.ones((1, 1))})
    assert not sense(np.full((60, 80), 1.0), views).any()


def test_single_pixels_are_missing() -> None:
    only = IDEAL | {"speck_fraction": 0.01}
    missing = shoot(np.full((HEIGHT, WIDTH), 1.0), **only)[0] == 0
    assert missing.mean() == pytest.approx(0.01, rel=0.06)
    for axis in (0, 1):
        both = (missing & np.roll(missing, 1, axis)).mean()
        assert both == pytest.approx(1e-4, rel=0.5)


def test_pixels_beside_an_edge_are_missing_where_windows_see_too_little() -> None:
    only = IDEAL | {"min_support": 0.6, "window_px": 7.0}
    depth = box_before_wall(300, 1.0, 1.3)
    for every in (1, 6):
        missing = shoot(depth, every, count=10, **only) == 0
        rows = slice(60 // every + 2, 420 // every - 2)
        right = missing[:, rows, 400 // every : 500 // every].sum(2)
        # (0.6 - 0.5) * 7 sensor pixels on either side
        assert every * right.mean() == pytest.approx(1.4, rel=0.1)


# -- edges -----------------------------------------------------------------------------------------


def test_edges_are_ragged_and_coherent() -> None:
    """As on a real frame: a sigma of 0.8 to 0.95 px, to one half common to 2 to 4 rows."""
    image = shoot(box_before_wall(), count=4, **CALIBRATED)
    near = (image > 0) & (image < 1300)
    # The last column of the box, on the side without a shadow.
    last = np.stack([[row[400:500].nonzero()[0][-1] for row in image[70:410]] for image in near])
    error = last - last.mean()
    assert 0.6 < error.std() < 1.1
    assert last.mean() == pytest.approx(49.0, abs=0.6)
    for rows, low, high in ((1, 0.5, 0.9), (2, 0.35, 0.75), (12, -0.2, 0.2)):
        shifted = np.corrcoef(error[:, :-rows].ravel(), error[:, rows:].ravel())[0, 1]
        assert low < shifted < high


# -- sampling --------------------------------------------------------------------------------------


def clutter(seed: int) -> np.ndarray:
    """A slanted floor with boxes on it."""
    rng = np.random.default_rng(seed)
    v = np.arange(HEIGHT)[:, None]
    depth = np.tile(1.0 / (0.55 + 0.0007 * v), (1, WIDTH))
    for _ in range(5):
        left, top = rng.integers(0, 540), rng.integers(0, 400)
        box = depth[top : top + 80, left : left + 100]
        box[:] = np.minimum(box, rng.uniform(0.8, 1.3))
    return depth


def test_a_sampled_image_is_the_whole_one_sampled() -> None:
    """In its statistics: missing shares, errors, and what lies between a box and the floor."""
    kinds = {name: [] for name in ("missing", "sigma", "wrong")}
    for every in (1, 6):
        figures = []
        for seed in range(16):
            depth = clutter(seed)
            views = sample_views(camera(every, **CALIBRATED), np.random.default_rng(0), 1, 0.0, 0.0)
            true = 1000.0 * depth[::6, ::6]
            image = sense(depth[::every, ::every], views, seed)[0][:: 6 // every, :: 6 // every]
            error = np.abs(image - true)[image > 0]
            near = error[error < 20.0]
            figures.append([(image == 0).mean(), near.std(), (error > 30.0).mean()])
        for kind, value in zip(kinds.values(), np.mean(figures, axis=0), strict=True):
            kind.append(value)
    whole, taken = np.array(list(kinds.values())).T
    assert whole[0] > 0.01
    np.testing.assert_allclose(taken[:2], whole[:2], rtol=0.08)
    # Of the few that saw what is beside them, more are missing on the whole image instead.
    assert whole[2] < taken[2] < 1.6 * whole[2]


# -- all of it -------------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 6])
def test_a_strength_of_0_leaves_the_true_depth(every: int) -> None:
    depth, space = clutter(0)[::every, ::every], DepthImage(HEIGHT // every, WIDTH // every)
    views = fixed_views(camera(every, strength=(0.0, 0.0)))
    views = views.with_arrays(
        {
            "dark": np.concatenate([[[0, 0, 1.2]], np.eye(3) / 0.3])[None, None],
            "dark_missing": np.ones((1, 1)),
        }
    )
    codes = space.encode(depth.astype(np.float32))[..., 0].astype(float)
    error = np.abs(sense(depth, views)[0] - codes)
    assert error.max() <= 1.0  # where the next millimetre is as near
    assert error.mean() < 0.002


def test_scale_and_offset_are_those_of_the_view() -> None:
    views = fixed_views(camera(4, **IDEAL), 2).with_arrays(
        {
            "depth_scale_error": np.array([0.01, -0.02]),
            "depth_offset_m": np.array([0.003, 0.01]),
        }
    )
    image = sense(np.full((120, 160), 1.5), views)
    np.testing.assert_array_equal(image[0], 1518)
    np.testing.assert_array_equal(image[1], 1480)
    beyond = sense(np.full((120, 160), 2.01), views)
    assert not beyond[0].any()
    np.testing.assert_allclose(beyond[1], 1979.8, atol=0.5)


def test_an_image_depends_on_its_own_seed_and_strength_alone() -> None:
    views = fixed_views(camera(6), 3)
    views = views.with_arrays({"sensor_strength": np.array([1.0, 10.0, 1.0])})
    depth = np.stack([clutter(k)[::6, ::6] for k in range(3)])
    space, seeds = DepthImage(80, 107), np.array([5, 6, 5], np.uint64)
    images = sense_depth(depth.astype(np.float32), views, space, seeds)
    for k in range(3):
        alone = sense_depth(
            depth[k : k + 1].astype(np.float32), views[k : k + 1], space, seeds[k : k + 1]
        )
        np.testing.assert_array_equal(alone[0], images[k])
    again = sense_depth(depth[:1].astype(np.float32), views[:1], space, seeds[1:2])
    assert (again[0] != images[0]).mean() > 0.2


@pytest.mark.parametrize("size", [(1, 1), (3, 7), (7, 3), (1, 40), (60, 1), (5, 300)])
@pytest.mark.parametrize("strength", [0.0, 1.0, 10.0])
def test_any_size_will_do(size: tuple[int, int], strength: float) -> None:
    height, width = size
    rng = np.random.default_rng(0)
    depth = rng.choice([0.3, 0.7, 1.1, 1.7, 3.0, np.inf], size)
    lens = camera(1, width, height, strength=(strength, strength), **CALIBRATED)
    image = sense(depth, fixed_views(lens, 3))
    assert ((image == 0) | ((image >= 400) & (image <= 2000))).all()
    assert not sense(np.full(size, np.inf), fixed_views(lens, 3)).any()
    assert strength > 0 or (image > 0).sum() == 3 * ((depth > 0.4) & (depth < 2.0)).sum()


def test_missing_pixels_of_the_camera_come_on_top() -> None:
    views = fixed_views(camera(4, **IDEAL), 3).with_arrays(
        {"missing_fraction": np.array([0.0, 0.3, 1.0])}
    )
    missing = (sense(np.full((120, 160), 1.0), views) == 0).mean((1, 2))
    np.testing.assert_allclose(missing, [0.0, 0.3, 1.0], atol=0.015)


def test_both_simulators_have_the_same_sensor() -> None:
    lens = Camera(
        type="depth",
        width=246,
        height=198,
        sampling={"every": 6},
        sensor={"type": "structured_light", "dark_blocks": 1.0},
    )
    scenes, views = sampled(3, depth=lens)
    space, everywhere = DepthImage(33, 41), np.arange(3)
    seeds = np.array([4, 5, 6], np.uint64)
    for make in (PyBulletSimulator, FastSimulator):
        simulator = make(3, load_robot(), Support())
        simulator.load(everywhere, scenes, home(3))
        depth = simulator.render(everywhere, views["depth"])
        raw = simulator.render_depth(everywhere, views["depth"], space, seeds)
        simulator.close()
        # But for the last bit of a depth that was 1 / (1 / depth) on the way.
        assert (raw == sense_depth(depth, views["depth"], space, seeds)).mean() > 0.999


# -- settings and views ----------------------------------------------------------------------------


def test_calibrations_are_drawn_within_their_ranges_and_grow_with_the_strength() -> None:
    def errors(strength: float) -> np.ndarray:
        lens = camera(6, strength=(strength, strength))
        views, ideal = sample_views(lens, np.random.default_rng(0), 500, 0.0, 0.0), pinhole(lens)
        fx, fy, cx, _ = views.intrinsics.T
        np.testing.assert_allclose(fx / ideal.fx, fy / ideal.fy)
        assert (views.sensor_strength == strength).all()
        focal, center = fx / ideal.fx - 1.0, (cx - ideal.cx) / (WIDTH / 6)
        return np.stack([focal, center, views.depth_scale_error, views.depth_offset_m])

    once = errors(1.0)
    most = np.array([0.01, 0.01, 0.01, 0.003])
    assert (np.abs(once).max(1) <= most).all()
    assert (np.abs(once).max(1) > 0.97 * most).all()
    np.testing.assert_allclose(errors(2.0)[:2], 2.0 * once[:2], rtol=1e-6)
    np.testing.assert_allclose(errors(2.0)[2:], once[2:])  # of which the image takes the strength


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("strength", (0.0, 11.0), "within 0 and 10"),
        ("baseline_m", 0.0, "without a baseline there is no disparity"),
        ("incidence_deg", (80.0, 70.0), "incidence_deg"),
        ("incidence_deg", (80.0, 95.0), "rise within 0 and 90 deg"),
        ("dark_missing", (0.5, 1.5), "within 0 and 1"),
        ("min_support", 0.4, "greater than or equal to 0.5"),
        ("windows_px", 7.0, "Extra inputs"),
    ],
)
def test_settings_that_make_no_sense_are_refused(setting: str, value: Any, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        StructuredLight(**{setting: value})
