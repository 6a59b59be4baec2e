from __future__ import annotations

import cv2
import numpy as np
import pytest

from envs.environment import EnvironmentFailure
from envs.grasp.scene.placement import BLOCK_CLEARANCE_M, _apart_on_support, rules
from envs.grasp.scene.sampler import SceneError, Scenes, SceneSampler, heading, to_world
from envs.grasp.sensors.camera import CameraPoses
from envs.grasp.settings import Camera, GraspSettings, Randomize, Support, Workspace

COUNT = 500
NO_LIMIT = np.pi
WIDE = Support(x_m=(0.0, 9.0), y_m=(-9.0, 9.0))
TWO_CAMERAS = {
    "depth": Camera(type="depth"),
    "above": Camera(
        type="rgb", width=60, height=32, fov_deg=36, position_m=(1.1, 0, 2.0), target_m=(1.15, 0, 0)
    ),
}


def sample(
    settings: GraspSettings, count: int = COUNT, yaw_limit: float = NO_LIMIT, seed: int = 0
) -> tuple[Scenes, dict[str, CameraPoses]]:
    rng = np.random.default_rng(seed)
    return SceneSampler(settings).sample(rng, np.full(count, yaw_limit))


@pytest.fixture(scope="module")
def scenes() -> Scenes:
    return sample(GraspSettings())[0]


def outline(scenes: Scenes) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corners (n, B, 3) of all of a block's boxes, in its body frame."""
    used = (scenes.box_half_m > 0).all(-1, keepdims=True)
    low = np.where(used, scenes.box_center_m - scenes.box_half_m, np.inf).min(2)
    high = np.where(used, scenes.box_center_m + scenes.box_half_m, -np.inf).max(2)
    return low, high


def outline_points(scenes: Scenes) -> np.ndarray:
    """(n, B, p, 3) points all along the border of the blocks' footprints, in the world frame."""
    low, high = outline(scenes)
    t = np.linspace(0, 1, 30)
    square = np.concatenate(
        [np.stack(pair, -1) for pair in ((t, 0 * t), (t, 0 * t + 1), (0 * t, t), (0 * t + 1, t))]
    )
    square = np.hstack([square, np.zeros((len(square), 1))])
    points = low[:, :, None] + square * (high - low)[:, :, None]
    cosine, sine = np.cos(scenes.block_yaw_rad), np.sin(scenes.block_yaw_rad)
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    turn = np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], -1)
    turned = np.einsum("nbij,nbpj->nbpi", turn.reshape(*cosine.shape, 3, 3), points)
    return turned + scenes.block_position_m[:, :, None]


def distance_to_rectangle(points: np.ndarray, scenes: Scenes, block: int) -> np.ndarray:
    """Horizontal distance (n, p) of world points to a block's footprint; 0 inside."""
    low, high = outline(scenes)
    along = heading(scenes.block_yaw_rad[:, block])
    across = heading(scenes.block_yaw_rad[:, block] + np.pi / 2)
    away = points - scenes.block_position_m[:, None, block]
    local = np.stack([(away * along[:, None]).sum(-1), (away * across[:, None]).sum(-1)], -1)
    beyond = np.maximum(low[:, None, block, :2] - local, local - high[:, None, block, :2])
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)


def test_hand_computed_frames() -> None:
    np.testing.assert_allclose(
        heading(np.array([0.0, np.pi / 2])), [[1, 0, 0], [0, 1, 0]], atol=1e-9
    )
    world = to_world(
        np.array([[[0.1, 0.2, 0.3]]]), np.array([[1.0, 2.0, 3.0]]), np.array([np.pi / 2])
    )
    np.testing.assert_allclose(world, [[[0.8, 2.1, 3.3]]])


def test_footprints_keep_their_distance(scenes: Scenes) -> None:
    points = outline_points(scenes)
    nearest = np.inf
    for i in range(3):
        for j in range(3):
            if i != j:
                distance = distance_to_rectangle(points[:, i], scenes, j)
                nearest = min(nearest, float(distance.min()))
    assert nearest > 0.9 * BLOCK_CLEARANCE_M
    # ... and not by keeping far more of it than is asked for
    assert nearest < 3 * BLOCK_CLEARANCE_M


def test_pairs_of_footprints_are_turned_down_exactly_where_they_overlap() -> None:
    rng, rules_ = np.random.default_rng(0), rules(GraspSettings(support=WIDE))
    decided, area_m2 = [], []
    for _ in range(2000):
        size = rng.uniform(0.05, 0.3, (2, 3))
        position = np.zeros((2, 3))
        position[1, :2] = rng.uniform(-0.25, 0.25, 2)
        position[:, 0] += 3.0
        yaw = rng.uniform(-np.pi, np.pi, 2)
        decided.append(_apart_on_support(rules_, size, position, yaw))
        grown = []  # by half the clearance on every side
        for one, place, turn in zip(size, position, yaw, strict=True):
            x, y = one[0] / 2, np.zeros(1)
            center = place[:2] + [x * np.cos(turn), x * np.sin(turn)] + 0 * y
            sides = (one[:2] + BLOCK_CLEARANCE_M).astype(float)
            grown.append(
                cv2.boxPoints((tuple(center.tolist()), tuple(sides.tolist()), np.degrees(turn)))
            )
        area_m2.append(cv2.intersectConvexConvex(*grown)[0])
    decided, area_m2 = np.array(decided), np.array(area_m2)
    assert 0.2 < decided.mean() < 0.8
    clear = (area_m2 == 0.0) | (area_m2 > 1e-6)
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(decided[clear], area_m2[clear] == 0.0)


def test_target_is_nearest_by_its_lead(scenes: Scenes) -> None:
    distance = np.linalg.norm(scenes.block_position_m[..., :2], axis=-1)
    lead = distance[:, 1:].min(1) - distance[:, 0]
    assert lead.min() >= 0.05
    assert lead.min() < 0.06


@pytest.mark.parametrize("lead", [0.0, 0.12])
def test_lead_is_a_setting(lead: float) -> None:
    scenes, _ = sample(GraspSettings(target_lead_m=lead), 200)
    distance = np.linalg.norm(scenes.block_position_m[..., :2], axis=-1)
    smallest = (distance[:, 1:].min(1) - distance[:, 0]).min()
    assert lead <= smallest < lead + 0.02


def test_blocks_stand_on_the_support(scenes: Scenes) -> None:
    points = outline_points(scenes)
    np.testing.assert_allclose(points[..., 2], 0.6)  # the lowest boxes stand on the table's top
    assert points[..., 0].min() >= 0.88
    assert points[..., 0].max() <= 1.50
    assert np.abs(points[..., 1]).max() <= 0.50


def test_support_is_a_setting() -> None:
    support = Support(x_m=(0.9, 1.42), y_m=(-0.3, 0.35), top_m=0.65)
    points = outline_points(sample(GraspSettings(support=support), 200)[0])
    np.testing.assert_allclose(points[..., 2], 0.65)
    assert points[..., 0].min() >= 0.9
    assert points[..., 0].max() <= 1.42
    assert points[..., 1].min() >= -0.3
    assert points[..., 1].max() <= 0.35


def test_dimensions_of_an_l_use_their_whole_range() -> None:
    scenes, _ = sample(GraspSettings(randomize=Randomize(shapes=("L",))), 300)
    low, high = outline(scenes)
    legs = 2 * scenes.box_half_m[:, :, 1, 1] / (high - low)[..., 1]
    assert 0.5 <= legs.min() < 0.51
    assert 0.59 < legs.max() <= 0.6
    bars = 2 * scenes.box_half_m[:, :, 0, 2]
    assert 0.08 <= bars.min() < 0.0805
    assert 0.11 < bars.max() <= 0.12
    on_left = scenes.box_center_m[:, :, 1, 1] > 0
    assert 0.4 < on_left.mean() < 0.6


def test_everything_drawn_lies_in_its_range(scenes: Scenes) -> None:
    randomize = Randomize()
    low, high = outline(scenes)
    size = high - low
    for values, (smallest, largest) in (
        (scenes.block_position_m[..., 0], randomize.block_x_m),
        (scenes.block_position_m[..., 1], randomize.block_y_m),
        (np.degrees(scenes.block_yaw_rad), randomize.block_yaw_deg),
        (size[..., 0], randomize.block_depth_m),
        (size[..., 1], randomize.block_size_m),
        (size[..., 2], randomize.block_size_m),
        (scenes.light_intensity, randomize.light_intensity),
        (np.degrees(np.arcsin(scenes.light_direction[:, 2])), randomize.light_elevation_deg),
        (
            np.degrees(np.arctan2(scenes.light_direction[:, 1], scenes.light_direction[:, 0])),
            randomize.light_azimuth_deg,
        ),
    ):
        margin = 0.1 * (largest - smallest)
        assert smallest - 1e-9 <= values.min() < smallest + margin
        assert largest - margin < values.max() <= largest + 1e-9
    np.testing.assert_allclose(np.linalg.norm(scenes.light_direction, axis=1), 1.0)
    boxes = (scenes.box_half_m > 0).all(-1).sum(-1)
    assert all((boxes == count).mean() > 0.2 for count in (1, 2, 3))


@pytest.mark.parametrize("shape", ["parallelepiped", "L", "U"])
def test_shapes_are_a_setting(shape: str) -> None:
    scenes, _ = sample(GraspSettings(randomize=Randomize(shapes=(shape,))), 30)
    boxes = (scenes.box_half_m > 0).all(-1).sum(-1)
    assert (boxes == {"parallelepiped": 1, "L": 2, "U": 3}[shape]).all()


def test_a_zero_range_is_a_fixed_value() -> None:
    randomize = Randomize(block_yaw_deg=(7, 7), block_size_m=(0.15, 0.15), block_depth_m=(0.1, 0.1))
    scenes, _ = sample(GraspSettings(randomize=randomize), 20)
    np.testing.assert_allclose(np.degrees(scenes.block_yaw_rad), 7.0)
    low, high = outline(scenes)
    np.testing.assert_allclose(high - low, np.broadcast_to([0.1, 0.15, 0.15], low.shape))


def test_grasp_point_lies_on_the_targets_face(scenes: Scenes) -> None:
    away = scenes.target_m - scenes.block_position_m[:, 0]
    np.testing.assert_allclose((away * heading(scenes.target_yaw_rad)).sum(1), 0.0, atol=1e-12)
    # inside one of its boxes, with room for the disc of 4 cm in at least one direction
    across = (away * heading(scenes.target_yaw_rad + np.pi / 2)).sum(1)
    point = np.stack([across, away[:, 2]], -1)[:, None]
    low = (scenes.box_center_m - scenes.box_half_m)[:, 0, :, 1:]
    high = (scenes.box_center_m + scenes.box_half_m)[:, 0, :, 1:]
    used = (scenes.box_half_m > 0).all(-1)[:, 0]
    assert ((point > low) & (point < high) & used[..., None]).all(-1).any(1).all()


def test_centroid_is_the_papers_grasp_point() -> None:
    disc, _ = sample(GraspSettings(randomize=Randomize(shapes=("U",))), 50)
    settings = GraspSettings(grasp_point="centroid", randomize=Randomize(shapes=("U",)))
    scenes, _ = sample(settings, 50)
    half = scenes.box_half_m[:, 0]
    area = half[..., 1] * half[..., 2]
    height = (area * scenes.box_center_m[:, 0, :, 2]).sum(1) / area.sum(1)
    expected = scenes.block_position_m[:, 0] + np.stack([0 * height, 0 * height, height], -1)
    np.testing.assert_allclose(scenes.target_m, expected)  # a U's is in the middle
    middle = np.linalg.norm((disc.target_m - disc.block_position_m[:, 0])[:, :2], axis=1)
    assert middle.min() > 0.005  # the disc's is not


def test_grasp_point_is_inside_the_workspace_by_a_margin(scenes: Scenes) -> None:
    low, high = np.array([(0.82, 1.35), (-0.45, 0.45), (0.60, 1.00)]).T
    assert (scenes.target_m >= low + 0.03).all()
    assert (scenes.target_m <= high - 0.03).all()


def test_workspace_limits_position_and_yaw() -> None:
    workspace = Workspace(x_m=(0.9, 1.1), y_m=(-0.1, 0.2), z_m=(0.65, 0.8), yaw_deg=(-10, 15))
    scenes, _ = sample(GraspSettings(workspace=workspace), 100)
    low, high = np.array([(0.93, 1.07), (-0.07, 0.17), (0.68, 0.77)]).T
    assert (scenes.target_m >= low).all()
    assert (scenes.target_m <= high).all()
    target_yaw = np.degrees(scenes.target_yaw_rad)
    assert -10 <= target_yaw.min() < -7
    assert 12 < target_yaw.max() <= 15
    assert np.abs(np.degrees(scenes.block_yaw_rad[:, 1:])).max() > 20  # the others are free


@pytest.mark.parametrize("settings", [GraspSettings(), GraspSettings(cameras=TWO_CAMERAS)])
def test_every_face_is_in_every_cameras_view(settings: GraspSettings) -> None:
    scenes, views = sample(settings, 200)
    low, high = outline(scenes)
    across = heading(scenes.block_yaw_rad + np.pi / 2)
    for name, view in views.items():
        camera = settings.cameras[name]
        assert len(view) == 200
        # Angles off the optical axis, from the vectors themselves: no projection matrix.
        tangent = np.tan(np.radians(camera.fov_deg / 2))
        right, down, forward = np.moveaxis(view.rotation, -1, 0)
        largest = 0.0
        for side in (low[..., 1], high[..., 1]):
            for z in (low[..., 2], high[..., 2]):
                corner = scenes.block_position_m + across * side[..., None]
                corner = corner + np.stack([0 * z, 0 * z, z], -1)
                away = corner - view.position_m[:, None]
                ahead = (away * forward[:, None]).sum(-1)
                assert ahead.min() > 0
                u = np.abs((away * right[:, None]).sum(-1) / ahead) / tangent
                v = np.abs((away * down[:, None]).sum(-1) / ahead) / tangent
                assert u.max() <= 1 + 1e-9
                assert v.max() <= camera.height / camera.width + 1e-9
                largest = max(largest, float(u.max()))
        assert largest > 0.8  # the blocks' region fills the image


@pytest.mark.parametrize(("limit_deg", "largest"), [(5.0, 5.0), (0.0, 0.0), (170.0, 30.0)])
def test_yaw_limit_narrows_the_range(limit_deg: float, largest: float) -> None:
    scenes, _ = sample(GraspSettings(), 100, np.radians(limit_deg))
    yaw = np.abs(np.degrees(scenes.block_yaw_rad))
    assert 0.9 * largest <= yaw.max() <= largest + 1e-9


def test_yaw_limit_is_each_scenes_own() -> None:
    limits = np.radians(np.repeat([2.0, 20.0], 50))
    scenes, _ = SceneSampler(GraspSettings()).sample(np.random.default_rng(0), limits)
    yaw = np.abs(np.degrees(scenes.block_yaw_rad))
    assert yaw[:50].max() <= 2.0
    assert 15.0 < yaw[50:].max() <= 20.0


@pytest.mark.parametrize("count", [1, 2, 5])
def test_number_of_blocks_is_a_setting(count: int) -> None:
    randomize = Randomize(block_size_m=(0.12, 0.14))
    scenes, _ = sample(GraspSettings(blocks=count, randomize=randomize), 5)
    assert scenes.block_position_m.shape == (5, count, 3)


@pytest.mark.parametrize(
    "settings",
    [
        GraspSettings(randomize=Randomize(block_x_m=(1.0, 1.0))),  # no room for a lead of 5 cm
        GraspSettings(target_lead_m=1.0),
        GraspSettings(cameras={"d": Camera(type="depth", target_m=(-1.0, 0.0, 1.0))}),
        GraspSettings(support=Support(x_m=(0.9, 0.95))),
        GraspSettings(workspace=Workspace(z_m=(0.6, 0.65))),
    ],
    ids=["one line", "lead", "looks away", "support", "workspace"],
)
def test_impossible_ranges_are_an_error_that_names_the_way_out(settings: GraspSettings) -> None:
    with pytest.raises(SceneError, match=r"block_x_m.*target_lead_m.*fov_deg"):
        sample(settings, 1)


def test_a_run_that_it_ends_is_told_as_other_failures_of_environments_are() -> None:
    assert issubclass(SceneError, EnvironmentFailure)


@pytest.mark.parametrize(
    ("name", "value"), [("block_size_m", (0.05, 0.2)), ("block_depth_m", (0.0, 0.1))]
)
def test_blocks_that_cannot_be_built_are_an_error(name: str, value: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=name):
        Randomize(**{name: value})


def test_the_smallest_blocks_hold_the_cup() -> None:
    randomize = Randomize(block_size_m=(0.085, 0.09))
    scenes, _ = sample(GraspSettings(randomize=randomize), 20)
    used = (scenes.box_half_m > 0).all(-1)
    assert not scenes.box_half_m[~used].any()
    low, high = outline(scenes)
    assert ((high - low)[..., 1:] >= 0.085 - 1e-9).all()


def test_same_seed_same_scenes_other_seed_others() -> None:
    first, again, other = (sample(GraspSettings(), 10, seed=seed)[0] for seed in (3, 3, 4))
    for name, values in first.arrays().items():
        np.testing.assert_array_equal(values, again.arrays()[name])
    assert not np.isclose(first.target_m, other.target_m).all(axis=1).any()


def test_scenes_of_one_call_differ(scenes: Scenes) -> None:
    assert len(np.unique(scenes.target_m[:, 0])) == COUNT
    assert len(np.unique(scenes.light_intensity)) == COUNT
