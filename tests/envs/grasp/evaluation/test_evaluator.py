"""What the grasp environment declares of how its policies are judged."""

from __future__ import annotations

import numpy as np

from envs.evaluation import PhysicalCheckOption, RunFileOption
from envs.grasp.env import make_vector_env
from envs.grasp.evaluation.evaluator import GraspEvaluator
from envs.grasp.settings import GraspSettings
from envs.grasp.vector_env import GraspVectorEnv

UNITS = {"_m": ("mm", 1000.0), "_deg": ("deg", 1.0)}


def test_every_metric_but_success_has_a_figure() -> None:
    env = make_vector_env(1, simulator="fast")
    try:
        env.reset()
        *_, infos = env.step(np.zeros((1, 4)))
    finally:
        env.close()
    metrics = [figure.metric for figure in GraspEvaluator.figures]
    assert sorted([*metrics, "success"]) == sorted(infos["episode_metrics"])


def test_errors_are_read_in_the_unit_that_fits_their_metrics() -> None:
    errors = [figure for figure in GraspEvaluator.figures if figure.summary == "quantiles"]
    assert len(errors) == 5
    for figure in errors:
        suffix = figure.metric[figure.metric.rindex("_") :]
        assert (figure.unit, figure.scale) == UNITS[suffix]
        assert figure.better == "lower"


def test_options_stand_for_keys_that_there_are_and_a_window_is_a_pick() -> None:
    keys, checks = [], {}
    for option in GraspVectorEnv.evaluation_options:
        match option:
            case RunFileOption(flag="--simulator", key=key):
                keys.append(key)
            case PhysicalCheckOption(flag=flag, window=window):
                checks[flag] = window
    assert [key.removeprefix("environment.") for key in keys] == ["simulator"]
    assert "simulator" in GraspSettings.model_fields
    assert checks == {"--pick": False, "--window": True}


def test_the_true_state_is_kept_for_critics() -> None:
    env = make_vector_env(1, simulator="fast", privileged=True)
    env.close()
    assert env.privileged == set(env.single_observation_space) - {"depth"}
