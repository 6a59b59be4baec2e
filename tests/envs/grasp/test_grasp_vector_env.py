from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from curricula.samplers import (
    GaussianParameters,
    GaussianSampler,
    ParameterValue,
    UniformParameters,
    UniformSampler,
)
from encoders.cameras import Pinhole, Sampling
from encoders.spaces import DepthImage, PointCloud, RgbImage
from envs.grasp.scene.sampler import heading
from envs.grasp.sensors.clouds import CloudCamera
from envs.grasp.settings import Camera, Cloud, GraspSettings, Randomize
from envs.grasp.simulators.pybullet import PyBulletSimulator
from envs.grasp.vector_env import GraspVectorEnv
from rewards.plugin import ventosa_rewards
from rewards.reward import RewardTerm
from trainers.saving.serialization import flatten, unflatten

SHAPED = ("touch", "collision", "position", "rotation", "approach", "facing")
SMALL = {"depth": Camera(type="depth", width=32, height=24)}
POINTS = Camera(type="points", width=32, height=24, cloud=Cloud(points=50))
ALL = {**SMALL, "above": Camera(type="rgb", width=20, height=30, fov_deg=50), "cloud": POINTS}
MODES = pytest.mark.parametrize("frame_grab", [True, False], ids=["frame_grab", "stream"])
MakeEnv = Callable[..., GraspVectorEnv]


def uniform(low: float, high: float) -> UniformSampler:
    parameters = UniformParameters(min_value=low, max_value=high)
    return UniformSampler(sampler_type="uniform", sampler_parameters=parameters)


def gaussian(mean: float, st_dev: float) -> GaussianSampler:
    parameters = GaussianParameters(mean=mean, st_dev=st_dev)
    return GaussianSampler(sampler_type="gaussian", sampler_parameters=parameters)


def terms(*names: str, weight: float = 1.0) -> list[RewardTerm]:
    built_in = ventosa_rewards()
    return [RewardTerm(name, weight, built_in[name](built_in[name].Settings())) for name in names]


@pytest.fixture
def make() -> Iterator[MakeEnv]:
    environments = []

    def build(
        num_envs: int = 4,
        *,
        rewards: tuple[str, ...] = SHAPED,
        weight: float = 1.0,
        seed: int = 0,
        **settings: Any,
    ) -> GraspVectorEnv:
        settings = {"workers": 0, "cameras": SMALL, **settings}
        env = GraspVectorEnv(
            GraspSettings(num_envs=num_envs, **settings), terms(*rewards, weight=weight), seed
        )
        environments.append(env)
        return env

    yield build
    for env in environments:
        env.close()


def perfect(env: GraspVectorEnv, **change: Any) -> np.ndarray:
    """Actions that bring the cups 15 mm in front of the grasp points, but for `change`."""
    gap, turn, up = (change.get(name, 0.0) for name in ("gap_m", "turn_rad", "up_m"))
    scenes = env.scenes
    yaw = scenes.target_yaw_rad
    tooltip = scenes.target_m - (0.015 + gap) * heading(yaw) + [0, 0, up]
    return env.action_for(tooltip, yaw + turn)


def still(env: GraspVectorEnv) -> np.ndarray:
    """Actions that lead nowhere near a block: high up, pulled back."""
    return np.tile([-1.0, 0.0, 1.0, 0.0], (env.num_envs, 1))


def same(first: Any, second: Any) -> None:
    """Asserts that two nested results are the same, bit for bit."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            same(first[key], second[key])
    elif isinstance(first, tuple | list):
        for one, other in zip(first, second, strict=True):
            same(one, other)
    else:
        assert np.asarray(first).dtype == np.asarray(second).dtype
        np.testing.assert_array_equal(first, second)


def play(env: GraspVectorEnv, steps: int, seed: int) -> list[Any]:
    """Steps with random actions, of which every third is perfect, so that episodes end."""
    rng, results = np.random.default_rng(seed), []
    for step in range(steps):
        actions = rng.uniform(-1, 1, (env.num_envs, 4))
        if step % 3 == 2:
            hit = rng.random(env.num_envs) < 0.5
            actions[hit] = perfect(env)[hit]
        results.append(env.step(actions))
    return results


# -- gymnasium's interface -------------------------------------------------------------------------


def test_more_pixels_than_the_machine_holds_are_refused_at_once() -> None:
    camera = Camera(type="depth", width=4096, height=4096)
    # Twice the observations and twice their bounds, of two bytes a pixel.
    message = r"^num_envs 65536: .* needs 8,796\.1 GB, and the machine has .* GB: lower it"
    with pytest.raises(ValueError, match=message):
        GraspVectorEnv(GraspSettings(num_envs=65536, cameras={"depth": camera}), [])


@MODES
def test_spaces_contain_what_is_delivered(make: MakeEnv, frame_grab: bool) -> None:
    env = make(5, frame_grab=frame_grab, cameras=ALL, privileged=True, episode_steps=2)
    assert isinstance(env, VectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    spaces = env.single_observation_space.spaces
    focal_length_px = 16 / np.tan(np.radians(44.0 / 2))
    camera = Pinhole(focal_length_px, focal_length_px, 16.0, 12.0)
    assert spaces["depth"] == DepthImage(24, 32, pinhole=camera)
    assert isinstance(spaces["above"], RgbImage)
    assert isinstance(spaces["cloud"], PointCloud)
    assert env.single_action_space == gymnasium.spaces.Box(-1, 1, (4,), np.float32)
    assert env.action_space.shape == (5, 4)
    observations, infos = env.reset(seed=0)
    assert infos == {}
    shapes = {"depth": (5, 24, 32, 1), "above": (5, 30, 20, 3), "cloud": (5, 50, 4)}
    shapes["privileged"] = (5, 22)
    for step in range(5):
        assert {name: value.shape for name, value in observations.items()} == shapes
        assert env.observation_space.contains(observations), step
        assert observations["depth"].dtype == np.uint16
        for row in range(5):
            one = {name: value[row] for name, value in observations.items()}
            assert env.single_observation_space.contains(one)
        assert np.isfinite(observations["privileged"]).all()
        env.action_space.seed(step)
        observations, reward, terminated, truncated, infos = env.step(env.action_space.sample())
        assert reward.shape == terminated.shape == truncated.shape == (5,)
        assert reward.dtype == np.float64
        assert terminated.dtype == truncated.dtype == bool
        assert infos["same_frame"].shape == (5,)
        for values in (*infos["episode_metrics"].values(), *infos["reward_terms"].values()):
            assert values.shape == (5,)


def test_images_lie_in_the_cameras_range(make: MakeEnv) -> None:
    observations, _ = make(8).reset(seed=0)
    depth = observations["depth"]
    seen = depth[depth > 0]  # what lies behind the table is beyond the range
    assert seen.min() >= 400
    assert seen.max() <= 2000
    assert 0.0 < (depth == 0).mean() < 0.6
    assert ((depth > 500) & (depth < 1500)).mean() > 0.3  # mostly table and blocks
    assert (np.abs(depth[0].astype(int) - depth[1].astype(int)) > 10).mean() > 0.05


def test_an_episode_may_go_on_after_success(make: MakeEnv) -> None:
    env = make(2, episode_steps=3, end_on_success=False)
    env.reset(seed=1)
    actions = perfect(env)
    for step in range(3):
        _, _, terminated, truncated, infos = env.step(actions)
        assert infos["episode_metrics"]["success"].all()
        assert not terminated.any()
        assert truncated.all() == (step == 2)


@MODES
def test_autoreset_happens_in_the_step_an_episode_ends_in(make: MakeEnv, frame_grab: bool) -> None:
    env = make(6, frame_grab=frame_grab, privileged=True)
    first, _ = env.reset(seed=1)
    scenes = env.scenes
    actions = still(env)
    done = np.array([True, False, True, False, False, True])
    actions[done] = perfect(env)[done]
    observations, _, terminated, truncated, infos = env.step(actions)
    np.testing.assert_array_equal(terminated, done)
    assert not truncated.any()
    np.testing.assert_array_equal(infos["_final_obs"], done)
    final = infos["final_obs"]
    assert final.keys() == observations.keys()
    # RunningEpisodes that go on keep their scenes, the others have new ones.
    moved = (env.scenes.target_m != scenes.target_m).any(axis=1)
    np.testing.assert_array_equal(moved, done)
    # The privileged numbers tell before from after: progress is zero at a beginning.
    tool_before = final["privileged"][:, :3]
    assert np.abs(tool_before[done] - observations["privileged"][done, :3]).max() > 1.0
    np.testing.assert_array_equal(final["privileged"][~done], observations["privileged"][~done])
    np.testing.assert_allclose(observations["privileged"][:, 17], np.where(done, 0.0, 0.1))
    np.testing.assert_allclose(final["privileged"][:, 17], 0.1)
    unchanged = (final["depth"] == first["depth"]).all(axis=(1, 2, 3))
    assert (unchanged == frame_grab).all()
    assert (final["depth"][done] != observations["depth"][done]).any(axis=(1, 2, 3)).all()
    np.testing.assert_array_equal(final["depth"][~done], observations["depth"][~done])


def test_no_final_observations_while_nothing_ends(make: MakeEnv) -> None:
    env = make(2)
    env.reset(seed=0)
    infos = env.step(still(env))[4]
    assert "final_obs" not in infos
    assert "_final_obs" not in infos


def test_reset_mask_begins_only_what_it_names(make: MakeEnv) -> None:
    env = make(4, privileged=True)
    env.reset(seed=0)
    before, *_ = env.step(still(env))
    target = env.scenes.target_m
    mask = np.array([False, True, True, False])
    after, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal((env.scenes.target_m != target).any(1), mask)
    np.testing.assert_array_equal((before["depth"] != after["depth"]).any((1, 2, 3)), mask)
    np.testing.assert_allclose(after["privileged"][:, 17], np.where(mask, 0.0, 0.1))
    for name in after:
        np.testing.assert_array_equal(before[name][~mask], after[name][~mask])


def test_a_first_reset_begins_everything_whatever_the_mask(make: MakeEnv) -> None:
    observations, _ = make(3).reset(options={"reset_mask": np.array([True, False, False])})
    assert (observations["depth"] > 0).any(axis=(1, 2, 3)).all()


@pytest.mark.parametrize(
    "actions",
    [
        np.zeros((4, 3)),
        np.zeros(4),
        np.zeros((3, 4)),
        np.full((4, 4), np.nan),
        np.array([[0, 0, 0, np.inf]] * 4),
    ],
    ids=["three numbers", "one row", "three rows", "nan", "inf"],
)
def test_actions_that_are_none(make: MakeEnv, actions: np.ndarray) -> None:
    env = make(4)
    env.reset(seed=0)
    before = env.state_dict()
    with pytest.raises(ValueError, match=r"actions must be finite and of shape \(4, 4\)"):
        env.step(actions)
    same(env.state_dict(), before)


# -- the task --------------------------------------------------------------------------------------


def test_the_perfect_action_succeeds_everywhere_at_once_without_collision(make: MakeEnv) -> None:
    env = make(64, rewards=("touch", "collision", "position", "rotation"))
    env.reset(seed=5)
    for _ in range(5):
        actions = perfect(env)
        assert np.abs(actions).max() <= 1.0
        _, reward, terminated, truncated, infos = env.step(actions)
        assert terminated.all()
        assert not truncated.any()
        np.testing.assert_allclose(reward, 1.0)  # position and rotation
        episode_metrics = infos["episode_metrics"]
        assert episode_metrics["success"].all()
        assert not episode_metrics["collision"].any()
        assert episode_metrics["position_error_m"].max() < 1e-9
        assert episode_metrics["yaw_error_deg"].max() < 1e-9


@pytest.mark.parametrize(
    ("change", "position", "rotation"),
    [
        ({}, True, True),
        ({"gap_m": 0.0045}, True, True),
        ({"gap_m": 0.006}, False, False),
        ({"gap_m": -0.006}, False, False),
        ({"up_m": 0.0095}, True, True),
        ({"up_m": 0.0105}, False, False),
        ({"turn_rad": np.radians(1.9)}, True, True),
        ({"turn_rad": np.radians(-2.1)}, True, False),
    ],
    ids=str,
)
def test_success_is_judged_by_the_goal_region(
    make: MakeEnv, change: dict[str, float], position: bool, rotation: bool
) -> None:
    env = make(3)
    env.reset(seed=2)
    _, _, terminated, _, infos = env.step(perfect(env, **change))
    assert (infos["reward_terms"]["position"] == (0.5 if position else 0.0)).all()
    assert (infos["reward_terms"]["rotation"] == (0.5 if rotation else 0.0)).all()
    assert (terminated == rotation).all()
    assert (infos["episode_metrics"]["success"] == rotation).all()
    episode_metrics = infos["episode_metrics"]
    up, gap = abs(change.get("up_m", 0.0)), abs(change.get("gap_m", 0.0))
    np.testing.assert_allclose(episode_metrics["position_error_y_m"], up, atol=1e-9)
    np.testing.assert_allclose(episode_metrics["position_error_z_m"], gap, atol=1e-9)
    np.testing.assert_allclose(episode_metrics["position_error_m"], max(up, gap), atol=1e-9)
    turn = np.degrees(abs(change.get("turn_rad", 0.0)))
    np.testing.assert_allclose(episode_metrics["yaw_error_deg"], turn, atol=1e-6)


def test_touching_is_paid_once_and_position_is_not_paid_inside_the_block(make: MakeEnv) -> None:
    env = make(4)
    env.reset(seed=3)
    paid = []
    for gap in (0.06, -0.018, 0.06, -0.018):
        _, _, terminated, _, infos = env.step(perfect(env, gap_m=gap))
        assert not terminated.any()
        paid.append(infos["reward_terms"]["touch"].tolist())
    assert paid == [[0.0] * 4, [0.1] * 4, [0.0] * 4, [0.0] * 4]


def test_collision_is_paid_per_step_and_reported_for_the_episode(make: MakeEnv) -> None:
    env = make(2)
    env.reset(seed=0)
    table = np.tile([0.0, 0.0, -1.0, 0.0], (2, 1))  # the cup's lower half in the table
    _, _, _, _, infos = env.step(still(env))
    assert not infos["episode_metrics"]["collision"].any()
    for _ in range(2):
        _, _, _, _, infos = env.step(table)
        np.testing.assert_allclose(infos["reward_terms"]["collision"], -0.1)
        assert infos["episode_metrics"]["collision"].all()
    env.step(still(env))  # out of it
    _, _, _, _, infos = env.step(still(env))
    np.testing.assert_allclose(infos["reward_terms"]["collision"], 0.0)
    assert infos["episode_metrics"]["collision"].all()


@pytest.mark.parametrize("episode_steps", [1, 4])
def test_episodes_are_truncated(make: MakeEnv, episode_steps: int) -> None:
    env = make(3, episode_steps=episode_steps)
    env.reset(seed=0)
    for _ in range(2):
        for step in range(episode_steps):
            _, _, terminated, truncated, _ = env.step(still(env))
            assert not terminated.any()
            assert (truncated == (step == episode_steps - 1)).all()


def test_success_in_the_last_step_is_no_truncation(make: MakeEnv) -> None:
    env = make(2, episode_steps=1)
    env.reset(seed=0)
    _, _, terminated, truncated, _ = env.step(perfect(env))
    assert terminated.all()
    assert not truncated.any()


def test_the_reward_is_the_sum_of_its_weighted_terms(make: MakeEnv) -> None:
    single, double = make(6, seed=1), make(6, seed=1, weight=2.0)
    for env in (single, double):
        env.reset(seed=1)
    for one, two in zip(play(single, 8, 0), play(double, 8, 0), strict=True):
        assert set(one[4]["reward_terms"]) == set(SHAPED)
        total = np.sum([*one[4]["reward_terms"].values()], axis=0)
        np.testing.assert_allclose(one[1], total)
        np.testing.assert_allclose(two[1], 2 * one[1])
        assert np.ptp(one[1]) > 0


def test_no_rewards_at_all(make: MakeEnv) -> None:
    env = make(2, rewards=())
    env.reset(seed=0)
    _, reward, _, _, infos = env.step(still(env))
    np.testing.assert_array_equal(reward, [0.0, 0.0])
    assert infos["reward_terms"] == {}


# -- frames ----------------------------------------------------------------------------------------


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts, by camera call, how many pictures were taken."""
    taken: list[int] = []
    render = PyBulletSimulator.render

    def counted(self: PyBulletSimulator, indices: np.ndarray, views: Any) -> np.ndarray:
        taken.extend(int(index) for index in indices)
        return render(self, indices, views)

    monkeypatch.setattr(PyBulletSimulator, "render", counted)
    return taken


def test_frame_grab_takes_exactly_one_picture_per_episode(
    make: MakeEnv, pictures: list[int]
) -> None:
    env = make(4, episode_steps=3)
    observations, _ = env.reset(seed=0)
    assert pictures == [0, 1, 2, 3]
    episodes = 4
    for step in range(12):
        del pictures[:]
        actions = still(env)
        if step == 4:
            actions[[0, 2]] = perfect(env)[[0, 2]]
        before = observations
        observations, _, terminated, truncated, infos = env.step(actions)
        done = terminated | truncated
        episodes += done.sum()
        assert pictures == np.flatnonzero(done).tolist()
        np.testing.assert_array_equal(infos["same_frame"], ~done)
        alike = (observations["depth"] == before["depth"]).all((1, 2, 3))
        np.testing.assert_array_equal(alike, infos["same_frame"])
    assert episodes > 4 + 12


def test_the_stream_takes_a_picture_at_every_step(make: MakeEnv, pictures: list[int]) -> None:
    env = make(3, frame_grab=False, episode_steps=3)
    observations, _ = env.reset(seed=0)
    for step in range(6):
        del pictures[:]
        before = observations
        observations, _, _, truncated, infos = env.step(still(env))
        assert pictures == [0, 1, 2] * (2 if step % 3 == 2 else 1)
        assert truncated.all() == (step % 3 == 2)
        assert not infos["same_frame"].any()
        assert (observations["depth"] != before["depth"]).any((1, 2, 3)).all()


@pytest.mark.parametrize("simulator", ["fast", "pybullet"])
def test_points_lie_where_things_are(make: MakeEnv, simulator: str) -> None:
    exact = POINTS.model_copy(update={"noise_sigma_m": 0.0})
    still_cameras = Randomize(camera_position_m=0.0, camera_rotation_deg=0.0)
    env = make(4, simulator=simulator, cameras={"cloud": exact}, randomize=still_cameras)
    observations, _ = env.reset(seed=0)
    for cloud, target_m in zip(observations["cloud"], env.scenes.target_m, strict=True):
        points = cloud[cloud[:, 3] > 0, :3]
        on_table = points[np.abs(points[:, 2] - 0.6) < 0.003]
        assert 5 < len(on_table) < len(points)
        assert points[:, 2].min() > 0.54  # the table's front, 5 cm thick
        assert np.linalg.norm(points - target_m, axis=1).min() < 0.1


@pytest.mark.parametrize("sensor", ["gaussian", "structured_light"])
def test_points_do_not_tell_where_the_camera_really_is(make: MakeEnv, sensor: str) -> None:
    camera = Camera(type="points", width=32, height=24, cloud=Cloud(points=200), sensor=sensor)
    moved = Randomize(camera_position_m=0.05, camera_rotation_deg=5.0)
    env = make(4, simulator="fast", cameras={"cloud": camera}, randomize=moved)
    observations, _ = env.reset(seed=0)
    nominal = CloudCamera(camera)
    for cloud in observations["cloud"]:
        # Each is on the ray of a pixel of the camera as it is thought to be, at a whole millimetre.
        image = nominal.image(cloud)
        points = nominal.clouds(image[None], np.zeros(1, np.uint64))[0]
        order, expected = (np.lexsort(some.T) for some in (points, cloud))
        np.testing.assert_allclose(points[order], cloud[expected], atol=1e-6)


def test_the_stream_shows_the_robot(make: MakeEnv) -> None:
    env = make(4, frame_grab=False)
    first, _ = env.reset(seed=0)
    # Beside the target and off the table: the arm hides what was farther away.
    second, *_ = env.step(np.tile([0.0, 0.0, 0.6, 0.0], (4, 1)))
    images = first["depth"], second["depth"]
    before, after = (np.where(depth, depth, 3000).astype(int) for depth in images)
    nearer = after < before - 50
    assert (nearer.mean((1, 2, 3)) > 0.02).all()


@MODES
def test_observations_handed_out_are_never_written_to_again(
    make: MakeEnv, frame_grab: bool
) -> None:
    env = make(4, frame_grab=frame_grab, cameras=ALL, privileged=True, episode_steps=3)
    observations, _ = env.reset(seed=0)
    handed = [(observations, {name: value.copy() for name, value in observations.items()})]
    for _, _, _, _, infos in [result := env.step(still(env)) for _ in range(7)]:
        for seen in (result[0], infos.get("final_obs", {})):
            handed.append((seen, {name: value.copy() for name, value in seen.items()}))
    state = env.state_dict()
    kept = unflatten(*(json.loads(json.dumps(flatten(state)[0])), _copied(flatten(state)[1])))
    env.reset(options={"reset_mask": np.array([True, False, False, True])})
    play(env, 6, 0)
    for seen, copy in handed:
        same(seen, copy)
    same(state, kept)


def _copied(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: array.copy() for name, array in arrays.items()}


# -- parameters ------------------------------------------------------------------------------------


def test_parameters_hold_from_the_next_reset_on(make: MakeEnv) -> None:
    env = make(3, privileged=True)
    env.reset(seed=0)
    env.set_parameters({"vertical_limit_m": 0.1, "gap_limit_m": 0.12, "yaw_limit_deg": 10.0})
    far = {"up_m": 0.02, "gap_m": 0.05}
    observations, _, terminated, _, _ = env.step(perfect(env, **far))
    assert not terminated.any()
    np.testing.assert_allclose(observations["privileged"][0, 13:16], [0.1, 0.1, 0.2], rtol=1e-6)
    mask = np.array([True, False, False])
    observations, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_allclose(observations["privileged"][0, 13:16], [0.1, 1.0, 1.2], rtol=1e-6)
    _, _, terminated, _, infos = env.step(perfect(env, **far))
    np.testing.assert_array_equal(terminated, mask)
    # Errors are reported to the middle of the region that was asked for: a gap of 65 or 15 mm.
    metrics = infos["episode_metrics"]
    np.testing.assert_allclose(metrics["position_error_y_m"], 0.02)
    np.testing.assert_allclose(metrics["position_error_z_m"], [0.0, 0.05, 0.05], atol=1e-12)
    np.testing.assert_allclose(metrics["position_error_m"][0], 0.02)


def test_parameters_replace_those_set_before(make: MakeEnv) -> None:
    env = make(2, privileged=True)
    env.set_parameters({"lateral_limit_m": 0.1})
    env.set_parameters({"vertical_limit_m": 0.1})
    observations, _ = env.reset(seed=0)
    np.testing.assert_allclose(observations["privileged"][0, 13:15], [0.1, 1.0], rtol=1e-6)


def test_parameters_may_be_drawn_at_every_reset(make: MakeEnv) -> None:
    env = make(64, privileged=True)
    sampler = UniformSampler(
        sampler_type="uniform",
        sampler_parameters=UniformParameters(min_value=0.02, max_value=0.08),
    )
    env.set_parameters({"lateral_limit_m": sampler})
    first, _ = env.reset(seed=0)
    second, _ = env.reset()
    limits = first["privileged"][:, 13] / 10
    assert 0.02 <= limits.min() < 0.025
    assert 0.075 < limits.max() <= 0.08
    assert (second["privileged"][:, 13] != first["privileged"][:, 13]).all()


def test_the_blocks_yaw_limit_is_a_parameter(make: MakeEnv) -> None:
    env = make(16)
    env.set_parameters({"block_yaw_limit_deg": 3.0})
    env.reset(seed=0)
    yaw = np.degrees(np.abs(env.scenes.block_yaw_rad))
    assert 2.0 < yaw.max() <= 3.0


@pytest.mark.parametrize(
    ("value", "yaw_deg", "words"),
    [
        (31.0, (-30.0, 30.0), "31: .*from -30 to 30 deg.*leaves 0 to 30"),
        (-1.0, (-30.0, 30.0), "-1: "),
        (5.0, (10.0, 30.0), "5: .*leaves 10 to 30"),
        (5.0, (-30.0, -10.0), "5: .*leaves 10 to 30"),
        (uniform(5.0, 40.0), (-30.0, 30.0), "5 to 40: "),
    ],
)
def test_a_limit_outside_of_the_blocks_yaw_is_refused(
    make: MakeEnv, value: ParameterValue, yaw_deg: tuple[float, float], words: str
) -> None:
    env = make(1, randomize={"block_yaw_deg": yaw_deg})
    with pytest.raises(ValueError, match=f"block_yaw_limit_deg {words}"):
        env.set_parameters({"block_yaw_limit_deg": value})


def test_limits_inside_of_the_blocks_yaw_are_obeyed(make: MakeEnv) -> None:
    env = make(16, randomize={"block_yaw_deg": (10.0, 30.0)})
    for value in (10.0, 30.0, uniform(10.0, 30.0), gaussian(20.0, 50.0)):
        env.set_parameters({"block_yaw_limit_deg": value})
        env.reset(seed=0)
        yaw = np.degrees(env.scenes.block_yaw_rad)
        assert yaw.min() >= 10.0 - 1e-9
        assert yaw.max() <= 30.0 + 1e-9


def test_the_sensors_noise_is_a_parameter(make: MakeEnv) -> None:
    deviations = {}
    for sigma in (0.0, 0.02):
        env = make(4, frame_grab=False, seed=0)
        env.set_parameters({"noise_sigma_m": sigma})
        first, _ = env.reset(seed=0)
        first, *_ = env.step(still(env))
        second, *_ = env.step(still(env))  # the same picture, but for the noise
        difference = first["depth"].astype(float) - second["depth"]
        inside = (first["depth"] > 500) & (first["depth"] < 1800)
        deviations[sigma] = difference[inside].std()
    assert deviations[0.0] == 0.0
    assert deviations[0.02] == pytest.approx(20 * np.sqrt(2), rel=0.05)


def test_pixels_go_missing_by_parameter_and_by_setting(make: MakeEnv) -> None:
    camera = {"type": "depth", "width": 32, "height": 24, "missing_fraction": (0.2, 0.8)}
    env = make(64, cameras={"depth": camera})
    first, _ = env.reset(seed=0)
    share = env.state_dict()["views"]["depth"]["missing_fraction"]
    assert 0.2 <= share.min() < 0.25
    assert 0.75 < share.max() <= 0.8
    env.set_parameters({"missing_fraction": 0.0})
    whole, _ = env.reset(seed=0)  # the same scenes, cameras and noise
    seen = whole["depth"] > 0
    missing = ((first["depth"] == 0) & seen).sum((1, 2, 3)) / seen.sum((1, 2, 3))
    np.testing.assert_allclose(missing, share, atol=0.15)
    kept = first["depth"] > 0
    np.testing.assert_array_equal(first["depth"][kept], whole["depth"][kept])


def test_a_structured_light_cameras_faults_are_scaled_by_parameter_and_by_setting(
    make: MakeEnv,
) -> None:
    sensor = {"type": "structured_light", "strength": (0.5, 2.0)}
    camera = {"type": "depth", "width": 32, "height": 24, "sensor": sensor}
    env = make(64, cameras={"depth": camera})
    faulty, _ = env.reset(seed=0)
    strength = env.state_dict()["views"]["depth"]["sensor_strength"]
    assert 0.5 <= strength.min() < 0.6
    assert 1.9 < strength.max() <= 2.0
    env.set_parameters({"sensor_strength": 0.0})
    whole, _ = env.reset(seed=0)  # the same scenes and cameras
    assert not env.state_dict()["views"]["depth"]["sensor_strength"].any()
    seen = whole["depth"] > 0
    missing = ((faulty["depth"] == 0) & seen).sum((1, 2, 3)) / seen.sum((1, 2, 3))
    assert missing.all()
    assert missing[strength > 1.5].mean() > 1.5 * missing[strength < 1.0].mean()


def test_a_structured_light_cameras_episodes_go_on_where_they_were_left(make: MakeEnv) -> None:
    camera = {"type": "depth", "width": 32, "height": 24, "sensor": "structured_light"}
    options = {"cameras": {"depth": camera}, "frame_grab": False, "episode_steps": 3}
    env = make(4, **options)
    env.reset(seed=0)
    play(env, 2, 0)
    skeleton, arrays = flatten(env.state_dict())
    arrays = _copied(arrays)
    expected = play(env, 5, 1)
    resumed = make(4, seed=99, **options)
    resumed.load_state_dict(unflatten(skeleton, arrays))
    same(play(resumed, 5, 1), expected)


def test_a_drawn_share_of_missing_pixels_is_one(make: MakeEnv) -> None:
    env = make(32)
    wide = GaussianParameters(mean=0.5, st_dev=2.0)
    sampler = GaussianSampler(sampler_type="gaussian", sampler_parameters=wide)
    env.set_parameters({"missing_fraction": sampler})
    observations, _ = env.reset(seed=0)
    share = env.state_dict()["views"]["depth"]["missing_fraction"]
    assert (share.min(), share.max()) == (0.0, 1.0)
    seen = (observations["depth"] > 0).any((1, 2, 3))
    np.testing.assert_array_equal(seen, share < 1.0)


def test_a_drawn_noise_is_never_negative(make: MakeEnv) -> None:
    env = make(32)
    env.set_parameters(
        {
            "noise_sigma_m": GaussianSampler(
                sampler_type="gaussian",
                sampler_parameters=GaussianParameters(mean=0.0, st_dev=0.01),
            )
        }
    )
    env.reset(seed=0)
    sigma = env.state_dict()["views"]["depth"]["noise_sigma_m"]
    assert sigma.min() == 0.0
    assert 8 <= (sigma > 0).sum() <= 24


def test_unknown_parameters_are_named(make: MakeEnv) -> None:
    with pytest.raises(ValueError, match=r"\['block_yaw'\].*block_yaw_limit_deg.*yaw_limit_deg"):
        make(1).set_parameters({"block_yaw": 1.0, "yaw_limit_deg": 2.0})


# -- the same again --------------------------------------------------------------------------------


@MODES
def test_same_seed_same_rollout_other_seed_another(make: MakeEnv, frame_grab: bool) -> None:
    results = []
    for construction, seed in ((0, 7), (1, 7), (0, 8)):
        env = make(4, seed=construction, frame_grab=frame_grab, cameras=ALL, privileged=True)
        results.append([env.reset(seed=seed), *play(env, 8, 0)])
    same(results[0], results[1])
    first, other = (result[0][0] for result in (results[0], results[2]))
    for name in first:
        assert (first[name] != other[name]).any(axis=tuple(range(1, first[name].ndim))).all()


def test_the_constructors_seed_counts_until_a_reset_gives_one(make: MakeEnv) -> None:
    one, two, three = make(2, seed=4), make(2, seed=4), make(2, seed=5)
    first, second, third = (env.reset()[0]["depth"] for env in (one, two, three))
    np.testing.assert_array_equal(first, second)
    assert (first != third).any()
    assert (one.reset()[0]["depth"] != first).any()  # goes on, does not begin anew


def test_an_episode_does_not_depend_on_the_workers(make: MakeEnv) -> None:
    results = []
    for workers in (0, 2):
        env = make(5, workers=workers, cameras=ALL, frame_grab=False)
        results.append([env.reset(seed=3), *play(env, 5, 1)])
    same(results[0], results[1])


@MODES
def test_a_saved_state_has_the_same_future_bit_for_bit(make: MakeEnv, frame_grab: bool) -> None:
    options = {
        "frame_grab": frame_grab,
        "cameras": ALL,
        "privileged": True,
        "episode_steps": 4,
    }
    parameters = {
        "lateral_limit_m": UniformSampler(
            sampler_type="uniform",
            sampler_parameters=UniformParameters(min_value=0.01, max_value=0.1),
        ),
        "noise_sigma_m": 0.004,
    }
    env = make(6, **options)
    env.set_parameters(parameters)
    env.reset(seed=0)
    last = play(env, 5, 0)[-1][0]
    skeleton, arrays = flatten(env.state_dict())
    text, arrays = json.dumps(skeleton, allow_nan=False), _copied(arrays)
    expected = play(env, 9, 1)
    assert any((result[2] | result[3]).any() for result in expected)

    resumed = make(6, seed=99, **options)
    resumed.set_parameters(parameters)
    same(resumed.load_state_dict(unflatten(json.loads(text), arrays)), last)
    same(play(resumed, 9, 1), expected)
    same(flatten(resumed.state_dict())[1], flatten(env.state_dict())[1])


def test_a_state_can_be_gone_back_to_in_the_same_environment(make: MakeEnv) -> None:
    env = make(3, frame_grab=False)
    env.reset(seed=0)
    play(env, 2, 0)
    state = env.state_dict()
    expected = play(env, 6, 1)
    env.load_state_dict(state)
    same(play(env, 6, 1), expected)


@pytest.mark.parametrize(
    ("part", "old", "new", "words"),
    [
        # Tools without the ways on which they came in, and cameras that miss no pixels.
        ("tools", {"joints_rad": np.zeros((2, 6))}, "approach_rad", "approach_rad, joints_rad"),
        ("views.depth", {}, "missing_fraction", "missing_fraction"),
        ("cameras", {}, None, "above, depth"),
    ],
)
def test_the_state_of_another_versions_task_is_refused(
    make: MakeEnv, part: str, old: dict[str, Any], new: str | None, words: str
) -> None:
    env = make(2)
    env.reset(seed=0)
    before, state = env.state_dict(), env.state_dict()
    if part == "cameras":
        state["views"] = {"above": state["views"]["depth"]}
    else:
        arrays = state["tools"] if part == "tools" else state["views"]["depth"]
        del arrays[new]
        arrays.update(old)
    message = f"another version of the grasp task: {part} differs in {words}"
    with pytest.raises(ValueError, match=message):
        env.load_state_dict(state)
    same(env.state_dict(), before)


@pytest.mark.parametrize("other", [{"motion": "direct"}, {"standoff_m": 0.15}])
def test_the_state_of_another_standoff_is_refused(make: MakeEnv, other: dict[str, Any]) -> None:
    workspace = {"x_m": (1.0, 1.3), "yaw_deg": (-20.0, 20.0)}
    env, another = make(2, standoff_m=0.25, workspace=workspace), make(2, **other)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"7 knots, .* environment\.standoff_m or .*\.motion"):
        another.load_state_dict(env.state_dict())


@pytest.mark.parametrize("simulator", ["fast", "pybullet"])
def test_a_state_has_what_stands_around(make: MakeEnv, simulator: str) -> None:
    options = {"randomize": {"surroundings": {}}, "simulator": simulator, "frame_grab": False}
    env, resumed = make(3, **options), make(3, seed=9, **options)
    env.reset(seed=0)
    play(env, 2, 0)
    state = env.state_dict()
    same(resumed.load_state_dict(state), env._observations())
    same(play(resumed, 4, 1), play(env, 4, 1))
    np.testing.assert_array_equal(resumed.scenes.around_half_m, env.scenes.around_half_m)


@pytest.mark.parametrize(("there", "message"), [(True, "drawn with "), (False, "drawn without ")])
def test_a_state_with_other_surroundings_is_refused(
    make: MakeEnv, *, there: bool, message: str
) -> None:
    full, bare = make(2, randomize={"surroundings": {}}), make(2)
    drawn, other = (full, bare) if there else (bare, full)
    drawn.reset(seed=0)
    with pytest.raises(ValueError, match=message + r"environment\.randomize\.surroundings"):
        other.load_state_dict(drawn.state_dict())


def test_the_robots_stand_where_the_state_has_them() -> None:
    settings = GraspSettings(num_envs=2, workers=0, cameras=SMALL)
    env = GraspVectorEnv(settings, [], render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.zeros((2, 4)))
    state, expected = env.state_dict(), env.render()
    env.reset()
    env.load_state_dict(state)
    same(env.render(), expected)
    env.close()


# -- privileged ------------------------------------------------------------------------------------


def test_privileged_numbers_are_the_true_state(make: MakeEnv) -> None:
    env = make(4, privileged=True, episode_steps=5)
    observations, _ = env.reset(seed=0)
    scenes, middle = env.scenes, np.array([1.05, 0.0, 0.75])
    numbers = observations["privileged"]
    np.testing.assert_allclose(numbers[:, 5:8] / 10 + middle, scenes.target_m, atol=1e-6)
    np.testing.assert_allclose(numbers[:, 8], np.sin(scenes.target_yaw_rad), atol=1e-6)
    assert (numbers[:, 18] == 1).all()  # nothing done yet
    assert (numbers[:, [17, 19, 20, 21]] == 0).all()
    observations, *_ = env.step(perfect(env, gap_m=0.04, turn_rad=0.05))
    numbers = observations["privileged"]
    yaw = scenes.target_yaw_rad
    expected = scenes.target_m - 0.055 * heading(yaw)
    np.testing.assert_allclose(numbers[:, :3] / 10 + middle, expected, atol=1e-6)
    np.testing.assert_allclose(numbers[:, 3], np.sin(yaw + 0.05), atol=1e-6)
    np.testing.assert_allclose(numbers[:, 4], 0.0, atol=1e-6)  # the tool is level
    np.testing.assert_allclose(numbers[:, 9:12] / 10, -0.055 * heading(yaw), atol=1e-6)
    np.testing.assert_allclose(numbers[:, 12], np.sin(0.05), atol=1e-6)
    np.testing.assert_allclose(
        numbers[:, 13:17], np.tile([0.1, 0.1, 0.2, np.radians(2.0) * 10], (4, 1)), rtol=1e-6
    )
    np.testing.assert_allclose(numbers[:, 17], 0.2)
    assert (numbers[:, 18:] == 0).all()
    observations, *_ = env.step(perfect(env, turn_rad=0.05))  # in place, but turned
    assert (observations["privileged"][:, 20] == 1).all()
    assert (observations["privileged"][:, 21] == 0).all()


def test_privileged_numbers_are_not_offered_unasked(make: MakeEnv) -> None:
    env = make(1)
    assert set(env.single_observation_space.spaces) == {"depth"}
    assert set(env.reset(seed=0)[0]) == {"depth"}


def test_privileged_numbers_may_leave_out_the_goals_limits(make: MakeEnv) -> None:
    whole, without = make(3, privileged=True), make(3, privileged=True, privileged_limits=False)
    assert without.single_observation_space["privileged"].shape == (18,)
    for env in (whole, without):
        env.set_parameters({"lateral_limit_m": 0.1})
    actions = np.full((3, 4), 0.2)
    for method, given in (("reset", {"seed": 0}), ("step", {"actions": actions})):
        seen = [getattr(env, method)(**given)[0]["privileged"] for env in (whole, without)]
        np.testing.assert_array_equal(seen[1], np.delete(seen[0], np.s_[13:17], axis=1))


def test_the_space_of_a_sampled_camera_says_which_pixels_it_has(make: MakeEnv) -> None:
    taken = {"crop": [2, 4, 28, 20], "every": 3}
    camera = Camera.model_validate({"type": "depth", "width": 32, "height": 24, "sampling": taken})
    env = make(2, cameras={"depth": camera})
    space = env.single_observation_space["depth"]
    assert isinstance(space, DepthImage)
    assert space.sampling == Sampling(32, 24, 2, 4, 10, 7, 3)
    assert env.reset(seed=0)[0]["depth"].shape == (2, 7, 10, 1)


def test_workers_are_all_the_threads_there_are(make: MakeEnv) -> None:
    before = threading.active_count()
    env = make(64, simulator="fast", workers=1)
    env.reset(seed=0)
    env.step(np.zeros((64, 4), np.float32))
    assert threading.active_count() <= before
