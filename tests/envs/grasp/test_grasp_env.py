from __future__ import annotations

import warnings
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import envs
from envs.grasp.env import GraspEnv, make_vector_env
from envs.grasp.scene.sampler import heading
from envs.grasp.vector_env import GraspVectorEnv

TINY = {"depth": {"type": "depth", "width": 16, "height": 12}}


@pytest.fixture
def env() -> Iterator[GraspEnv]:
    env = GraspEnv(cameras=TINY)
    yield env
    env.close()


def test_gymnasiums_own_checks_pass(env: GraspEnv) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)


def test_make_builds_it_by_name() -> None:
    assert envs.__name__ == "envs"  # the import registers it
    env = gymnasium.make("ventosa/Grasp-v0", cameras=TINY, episode_steps=3)
    assert isinstance(env.unwrapped, GraspEnv)
    observations, info = env.reset(seed=0)
    assert info == {}
    assert observations["depth"].shape == (12, 16, 1)
    for step in range(3):
        observations, reward, terminated, truncated, info = env.step(
            np.array([-1, 0, 1, 0], np.float32)
        )
        assert env.observation_space.contains(observations)
        assert isinstance(reward, float)
        assert (terminated, truncated) == (False, step == 2)
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert info["episode_metrics"]["success"] == 0.0
    env.close()


def test_make_vec_builds_the_batch() -> None:
    env = gymnasium.make_vec("ventosa/Grasp-v0", num_envs=3, cameras=TINY, workers=0)
    assert isinstance(env.unwrapped, GraspVectorEnv)
    observations, _ = env.reset(seed=0)
    assert observations["depth"].shape == (3, 12, 16, 1)
    observations, reward, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observations)
    assert reward.shape == (3,)
    env.close()


def test_one_environment_is_the_batch_of_one(env: GraspEnv) -> None:
    batch = make_vector_env(1, cameras=TINY)
    one, _ = env.reset(seed=5)
    many, _ = batch.reset(seed=5)
    np.testing.assert_array_equal(one["depth"], many["depth"][0])
    rng = np.random.default_rng(0)
    for _ in range(4):
        action = rng.uniform(-1, 1, 4)
        one, reward, terminated, truncated, info = env.step(action)
        many, rewards, *_, infos = batch.step(action[None])
        np.testing.assert_array_equal(one["depth"], many["depth"][0])
        assert reward == rewards[0]
        assert not terminated
        assert not truncated
        for key in ("reward_terms", "episode_metrics"):
            assert info[key] == {name: values[0] for name, values in infos[key].items()}
    batch.close()


def test_success_ends_the_episode_and_leaves_the_reset_to_the_user(env: GraspEnv) -> None:
    first, _ = env.reset(seed=0)
    scenes = env._batch.scenes
    yaw = scenes.target_yaw_rad
    action = env._batch.action_for(scenes.target_m - 0.015 * heading(yaw), yaw)[0]
    observations, reward, terminated, truncated, info = env.step(action)
    assert terminated
    assert not truncated
    assert reward > 1.0  # position, rotation, and some for the approach
    assert info["episode_metrics"]["success"] == 1.0
    np.testing.assert_array_equal(observations["depth"], first["depth"])
    np.testing.assert_array_equal(env._batch.scenes.target_m, scenes.target_m)
    second, _ = env.reset()
    assert (second["depth"] != first["depth"]).any()


def test_render_shows_the_orange_robot() -> None:
    env = gymnasium.make("ventosa/Grasp-v0", cameras=TINY, render_mode="rgb_array")
    env.reset(seed=0)
    pictures = [env.render()]
    env.step(np.array([0.0, 0.0, 0.0, 0.0], np.float32))
    pictures.append(env.render())
    env.close()
    orange = []
    for picture in pictures:
        assert picture.shape == (480, 640, 3)
        assert picture.dtype == np.uint8
        red, green, blue = np.moveaxis(picture.astype(float), -1, 0)
        # The URDF's orange: 0.95, 0.36, 0.05, in whatever light; no block has it.
        orange.append((red > 60) & (np.abs(green / red - 0.38) < 0.06) & (blue / red < 0.12))
        assert 0.02 < orange[-1].mean() < 0.5
    assert (orange[0] != orange[1]).mean() > 0.02  # it has moved


def test_pictures_of_a_batch_are_one_an_environment() -> None:
    env = make_vector_env(2, cameras=TINY, render_mode="rgb_array", workers=0)
    env.reset(seed=0)
    pictures = env.render()
    assert len(pictures) == 2
    assert (pictures[0] != pictures[1]).any()
    np.testing.assert_array_equal(pictures[0], env.render()[0])
    env.close()


def test_no_render_mode_no_picture(env: GraspEnv) -> None:
    env.reset(seed=0)
    assert env.render() is None


def test_rewards_are_chosen_by_name_and_weight() -> None:
    env = GraspEnv(cameras=TINY, rewards={"facing": 3.0})
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.array([-1.0, 0.0, 1.0, 0.0]))
    yaw = env._batch.scenes.target_yaw_rad[0]
    assert info["reward_terms"] == {"facing": pytest.approx(3 * 0.01 * np.cos(yaw))}
    assert reward == pytest.approx(0.03 * np.cos(yaw))
    env.close()


def test_unknown_rewards_are_named() -> None:
    with pytest.raises(ValueError, match=r"unknown rewards \['aproach'\]; there are .*'approach'"):
        make_vector_env(1, rewards={"aproach": 1.0, "touch": 1.0})


def test_unknown_settings_are_named() -> None:
    with pytest.raises(ValueError, match="episode_length"):
        GraspEnv(episode_length=3)


def test_closing_twice_does_no_harm(env: GraspEnv) -> None:
    env.reset(seed=0)
    env.close()
    env.close()
