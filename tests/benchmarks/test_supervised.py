"""The fit by supervision: right actions succeed, and a few steps get nearer to them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import supervised as fit
from envs.grasp.settings import GraspSettings
from envs.grasp.vector_env import GraspVectorEnv
from trainers.runfile.registry import load_registries
from trainers.runfile.settings import load_run
from trainers.session import build_factory

RUN_FILE = Path(__file__).parents[2] / "config" / "run.yaml"


def test_right_actions_succeed_on_the_last_lesson() -> None:
    env = GraspVectorEnv(GraspSettings(simulator="fast", num_envs=16, workers=0), [])
    env.reset(seed=0)
    *_, infos = env.step_without_reset(fit.right_actions(env))
    env.close()
    assert infos["episode_metrics"]["success"].all()
    assert infos["episode_metrics"]["position_error_m"].max() < 1e-6
    assert infos["episode_metrics"]["yaw_error_deg"].max() < 1e-4


def test_the_tolerances_are_the_goal_regions_in_actions() -> None:
    env = GraspVectorEnv(GraspSettings(simulator="fast", num_envs=1, workers=0), [])
    env.reset(seed=0)
    env.close()
    # Half ranges of the workspace: 0.265, 0.45 and 0.2 m, and 40 degrees.
    np.testing.assert_allclose(
        fit._tolerances(env)[0], [0.005 / 0.265, 0.01 / 0.45, 0.01 / 0.2, 2.0 / 40.0], rtol=1e-5
    )


def test_it_tells_how_far_it_is(capsys) -> None:
    torch.set_num_threads(1)
    assert fit.main([str(RUN_FILE), "--minutes", "0.03", "encoders.depth.keypoints=4"]) == 0
    lines = capsys.readouterr().out.replace("\n", " ").split("min,")[1:]
    assert len(lines) >= 2
    assert "0 images: success 0.0%" in lines[0]
    assert all("position mm" in line and "yaw deg" in line for line in lines)


def test_what_can_not_be_fitted_is_said(capsys) -> None:
    assert fit.main([str(RUN_FILE.parent / "gymnasium" / "pendulum_ppo.yaml")]) == 2
    assert "environment.type: only the grasp task" in capsys.readouterr().err
    assert fit.main(["nowhere.yaml"]) == 2
    assert "nowhere.yaml: there is no such file" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["quick.yaml", "run.yaml"])
def test_actions_of_stochastic_and_deterministic_policies_can_be_fitted(name: str) -> None:
    run = load_run(RUN_FILE.parent / name, ["environment.num_envs=8"], load_registries())
    with closing(fit._environment(run, 0)) as env:
        factory = build_factory(run, load_registries(), env)
        policy = fit.build_policy(run.trainer.settings, factory)
        actions = fit._actions(policy, env)
    assert actions.shape == (8, 4)
    assert actions.requires_grad
