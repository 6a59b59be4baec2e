"""Random numbers of environments: their own, whoever draws beside them."""

from __future__ import annotations

import numpy as np
import pytest

from envs.grasp.streams import EnvironmentStreams
from envs.grasp.vector_env import GraspVectorEnv
from rewards.grasp.shaping import Facing
from rewards.reward import RewardTerm

EVERYONE = np.arange(6)


def test_an_environment_draws_the_same_whoever_draws_beside_it() -> None:
    whole, part = EnvironmentStreams(3, 0, 6), EnvironmentStreams(3, 4, 2)
    for size in ((6, 3), (6,)):
        drawn = whole.rows(EVERYONE).random(size)
        assert np.array_equal(drawn[4:], part.rows(np.arange(2)).random((2, *size[1:])))
    alone = whole.rows(np.array([5])).random(1)
    assert np.array_equal(alone, part.rows(np.array([1])).random(1))
    assert len(np.unique(drawn)) == 6
    assert not np.isin(EnvironmentStreams(4, 0, 6).rows(EVERYONE).random(6), drawn).any()


def test_what_is_drawn_has_its_moments() -> None:
    rows = EnvironmentStreams(0, 0, 2).rows(np.arange(2))
    count = 200_000
    uniform = rows.uniform(-1.0, 3.0, (2, count))
    assert [uniform.min(), uniform.max()] == pytest.approx([-1, 3], abs=1e-3)
    assert [uniform.mean(), uniform.var()] == pytest.approx([1, 4 / 3], rel=0.01)
    normal = rows.normal(2.0, 0.5, (2, count))
    assert (normal.mean(), normal.std()) == (pytest.approx(2, abs=0.005), pytest.approx(0.5, 0.01))
    assert np.mean(np.abs(normal - 2.0) < 0.5) == pytest.approx(0.6827, abs=0.005)
    integers = rows.integers(2, 5, (2, count))
    assert np.bincount(integers.ravel())[2:] == pytest.approx(np.full(3, 2 * count / 3), rel=0.02)
    seeds = rows.integers(2**63, size=(2, count), dtype=np.uint64)
    assert seeds.dtype == np.uint64
    assert seeds.max() / 2**63 == pytest.approx(1.0, abs=1e-4)
    assert seeds.max() < 2**63


def test_rows_of_other_environments_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^\(5,\) is not of the 6 environments that draw$"):
        EnvironmentStreams(0, 0, 6).rows(EVERYONE).random(5)


def make(count: int, first: int) -> GraspVectorEnv:
    camera = {"type": "depth", "width": 8, "height": 8}
    settings = GraspVectorEnv.Settings(
        num_envs=count, episode_steps=2, frame_grab=False, cameras={"depth": camera}
    )
    env = GraspVectorEnv(settings, [RewardTerm("facing", 1.0, Facing(Facing.Settings()))], seed=7)
    env.number_from(first)
    return env


def test_a_share_of_grasp_environments_lives_as_it_does_among_all() -> None:
    whole, part = make(4, 0), make(2, 2)
    for name, values in whole.reset()[0].items():
        assert np.array_equal(values[2:], part.reset()[0][name])
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 4, 4))
    for step in actions:
        whole_step, part_step = whole.step(step), part.step(step[2:])
        assert np.array_equal(whole_step[0]["depth"][2:], part_step[0]["depth"])
        assert np.array_equal(whole_step[1][2:], part_step[1])
    other = make(2, 0)
    other.reset()
    other.load_state_dict(part.state_dict())
    restored, went_on = (env.step(actions[0, 2:])[0]["depth"] for env in (other, part))
    assert np.array_equal(restored, went_on)


def test_a_state_without_streams_is_of_one_process_alone() -> None:
    alone, later = make(2, 0), make(2, 2)
    alone.reset()
    state = {**alone.state_dict(), "streams": None}
    alone.load_state_dict(state)
    with pytest.raises(ValueError, match=r"several processes would draw the same: go on in one$"):
        later.load_state_dict(state)
