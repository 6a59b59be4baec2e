"""Environment parameters: what each may be, and what is said where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from curricula.samplers import (
    GaussianParameters,
    GaussianSampler,
    ParameterValue,
    UniformParameters,
    UniformSampler,
)
from envs.grasp.parameters import parameter_ranges
from envs.grasp.settings import Goal, GraspSettings
from envs.grasp.vector_env import GraspVectorEnv

SETTINGS = GraspSettings(goal=Goal(gap_min_m=0.01, gap_limit_m=0.02))
RANGES = parameter_ranges(SETTINGS)
WILD = GaussianSampler(
    sampler_type="gaussian", sampler_parameters=GaussianParameters(mean=0.0, st_dev=1e3)
)


def uniform(low: float, high: float) -> UniformSampler:
    parameters = UniformParameters(min_value=low, max_value=high)
    return UniformSampler(sampler_type="uniform", sampler_parameters=parameters)


def test_every_parameter_has_a_range() -> None:
    assert RANGES.keys() == GraspVectorEnv.parameter_names


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (
            "gap_limit_m",
            0.005,
            r"0\.005: .*over the smallest one, 0\.01 \(environment\.goal",
        ),
        ("gap_limit_m", 0.01, r"0\.01: "),
        ("gap_limit_m", uniform(0.005, 0.05), r"0\.005 to 0\.05: "),
        ("lateral_limit_m", 0.0, "0: a limit is over 0"),
        ("vertical_limit_m", -0.01, r"-0\.01: a limit is over 0"),
        ("yaw_limit_deg", uniform(-1.0, 1.0), "-1 to 1: a limit is over 0"),
        ("lateral_limit_m", 1e300, r"1e\+300: a limit is over 0 and at most 100 m"),
        ("gap_limit_m", uniform(0.02, 101.0), "0.02 to 101: .*at most 100 m"),
        ("yaw_limit_deg", 361.0, "361: a limit is over 0 and at most 360 deg"),
        ("noise_sigma_m", -1.0, "-1: a sigma is within 0 and 1 m"),
        ("noise_sigma_m", 1.5, r"1\.5: "),
        ("missing_fraction", 2.0, "2: a probability is within 0 and 1"),
        ("missing_fraction", uniform(-0.1, 0.5), r"-0\.1 to 0\.5: "),
        ("missing_fraction", float("nan"), "nan: "),
        ("sensor_strength", -0.5, r"-0\.5: a strength is within 0 and 10"),
        ("sensor_strength", uniform(0.0, 11.0), "0 to 11: "),
    ],
)
def test_values_that_mean_nothing_are_refused(name: str, value: ParameterValue, words: str) -> None:
    with pytest.raises(ValueError, match=f"^environment parameter {name} {words}"):
        RANGES[name].check(name, value)
    env = GraspVectorEnv(GraspSettings(num_envs=1, simulator="fast"), [])
    with pytest.raises(ValueError, match=f"^environment parameter {name} {words}"):
        env.set_parameters({name: value})
    env.close()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gap_limit_m", 0.0101),
        ("lateral_limit_m", 1e-9),
        ("noise_sigma_m", uniform(0.0, 1.0)),
        ("missing_fraction", uniform(0.0, 1.0)),
        ("sensor_strength", uniform(0.0, 10.0)),
        *((name, WILD) for name in RANGES),
    ],
)
def test_values_up_to_the_ends_are_taken(name: str, value: ParameterValue) -> None:
    RANGES[name].check(name, value)


@pytest.mark.parametrize("name", RANGES)
def test_what_a_gaussian_draws_is_brought_into_the_range(name: str) -> None:
    drawn = WILD.sample(np.random.default_rng(0), 1000)
    clipped = RANGES[name].clip(drawn)
    for value in clipped:
        RANGES[name].check(name, float(value))
    inside = (drawn >= RANGES[name].low) & (drawn <= RANGES[name].high)
    np.testing.assert_array_equal(clipped[inside], drawn[inside])
