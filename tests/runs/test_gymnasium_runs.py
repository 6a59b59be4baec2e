"""Whole runs in gymnasium's environments: learned, stopped and gone on with, refused."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, Tuple

from encoders.cameras import Pinhole
from encoders.spaces import DepthImage
from envs.environment import EnvironmentFailure
from envs.gym.vector_env import GymEnvironment
from trainers import evaluation
from trainers.algorithms.ppo import PPO
from trainers.common.stopping import StopRequested
from trainers.evaluation import evaluate
from trainers.inference.policy import Policy
from trainers.runfile.registry import BUILT_IN_PLUGINS, load_registries, plugin_manager
from trainers.runfile.settings import load_run
from trainers.saving.checkpoint import Checkpoints, Loaded
from trainers.session import Session

REPOSITORY = Path(__file__).parents[2]
Learn = Callable[..., Any]
WriteRun = Callable[..., Path]
PENDULUM = {"type": "gymnasium", "id": "Pendulum-v1", "num_envs": 2, "max_episode_steps": 25}
NORMALIZED = {
    "max_steps": 384,
    "hyperparameters": {
        "buffer_size": 64,
        "batch_size": 32,
        "normalize_rewards": True,
        "learning_rate_schedule": "constant",
        "beta_schedule": "constant",
    },
    "network_settings": {"normalize": True},
}


def latest(results: Path, run_id: str) -> Loaded:
    return Checkpoints(results / run_id / "checkpoints", keep=9).load_latest()


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_a_run_taken_up_again_ends_exactly_as_one_that_was_not_stopped(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch, vectorization: str
) -> None:
    config = write_run({**PENDULUM, "vectorization": vectorization}, NORMALIZED)
    assert learn(config, "--run-id", "whole").code == 0
    with monkeypatch.context() as patch:
        stop_in_step(patch, 100)  # in the middle of an episode and of a collection
        assert learn(config, "--run-id", "halves").results.is_dir()
    results = learn(config, "--run-id", "halves", "--resume").results
    whole, halves = latest(results, "whole"), latest(results, "halves")
    assert whole.step == halves.step == 384
    for name in ("weights.safetensors", "state.safetensors", "state.json"):
        assert (halves.path / name).read_bytes() == (whole.path / name).read_bytes(), name


def stop_in_step(patch: pytest.MonkeyPatch, number: int) -> None:
    count = 0
    step = GymEnvironment.step

    def counted(self: GymEnvironment, actions: Any) -> Any:
        nonlocal count
        count += 1
        if count == number:
            raise StopRequested
        return step(self, actions)

    patch.setattr(GymEnvironment, "step", counted)


def test_what_is_reported_are_the_environments_own_rewards(
    make_session: Callable[..., Session],
) -> None:
    session = make_session(PENDULUM, NORMALIZED)
    session.algorithm.collect()
    session.algorithm.update(0.0)
    returns = session.env_runner.pop_finished().rewards
    assert len(returns) == 2
    assert np.all(returns < -20)  # swinging about at random costs some 5 a step


def test_rewards_are_taken_as_the_documentation_shows(write_run: WriteRun) -> None:
    page = (REPOSITORY / "docs/gymnasium.md").read_text()
    (code,) = re.findall(r"```python\n(# my_rewards.py\n.*?)```", page, re.DOTALL)
    (listed,) = re.findall(r"```yaml\n(rewards:\n.*?)```", page, re.DOTALL)
    plugin = ModuleType("my_rewards")
    exec(code, vars(plugin))
    registries = load_registries(plugin_manager((*BUILT_IN_PLUGINS, plugin)))
    config = write_run(PENDULUM, NORMALIZED, **yaml.safe_load(listed))
    session = Session(load_run(config, [], registries), registries)
    session.reset()
    session.algorithm.collect()
    episodes = session.env_runner.pop_finished()
    assert episodes.terms.keys() == {"environment", "effort"}
    assert np.all(episodes.terms["environment"] < -20)
    assert np.all(episodes.terms["effort"] < 0)
    np.testing.assert_allclose(episodes.rewards, sum(episodes.terms.values()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"environment": {"id": "Pendulm-v1"}}, r"environment \(gymnasium\): id: .*'Pendulum-v1'"),
        ({"environment": {"kwargs": {"gg": 1.0}}}, r"environment \(gymnasium\): .*argument 'gg'"),
        ({"environment": {"ids": "x"}}, "environment.ids: unknown key; did you mean 'id'"),
        (
            {"rewards": [{"type": "touch"}]},
            r"environment \(gymnasium\): .*'touch' is computed",
        ),
        (
            {"environment_parameters": {"gravity": 1.0}},
            "environment_parameters: the environment has no parameter 'gravity'",
        ),
    ],
)
def test_mistakes_are_told_before_anything_starts(
    learn: Learn, write_run: WriteRun, change: dict[str, Any], message: str
) -> None:
    environment = {**PENDULUM, **change.pop("environment", {})}
    told = learn(write_run(environment, **change))
    assert told.code == 2
    assert not told.results.exists()
    assert re.search(message, told.errors)


def test_an_evaluation_without_an_end_ends_with_what_to_set(
    learn: Learn, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = learn(write_run(PENDULUM)).results
    monkeypatch.setattr(evaluation, "EPISODE_STEP_LIMIT", 60)
    endless = ["environment.max_episode_steps=1000000"]
    with pytest.raises(EnvironmentFailure, match=r"in 60 steps: set a limit, .*max_episode_steps="):
        evaluate(str(results / "toy"), episodes=2, overrides=endless)


class Cameras(gymnasium.Env[Any, Any]):
    """A depth camera, and vectors, with names that are no attributes of modules."""

    observation_space = Dict(
        {
            "hand.depth": DepthImage(16, 16, pinhole=Pinhole(20.0, 20.0, 8.0, 8.0)),
            "type": Box(-1.0, 1.0, (2,), np.float32),
            "values": Discrete(3),
        }
    )
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {"is_success": True}


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_own_cameras_are_seen_as_those_of_the_grasp_task(
    learn: Learn, write_run: WriteRun, vectorization: str
) -> None:
    gymnasium.register("ventosa_tests/Cameras-v0", entry_point=Cameras)
    environment = {"id": "ventosa_tests/Cameras-v0", "vectorization": vectorization}
    encoders = {"hand.depth": {"type": "keypoints", "keypoints": 2}}
    try:
        learned = learn(write_run({**PENDULUM, **environment}, encoders=encoders))
        assert learned.code == 0, learned.errors
        policy = Policy.load(str(learned.results / "toy"))
        assert policy.observation_space["hand.depth"] == Cameras.observation_space["hand.depth"]
        report = evaluate(str(learned.results / "toy"), episodes=2).report
    finally:
        del gymnasium.registry["ventosa_tests/Cameras-v0"]
    assert report["success"] == 1.0


class Switches(gymnasium.Env[Any, Any]):
    """Nested observations of what was just done; each switch that is on pays, where it was off."""

    observation_space = Dict({"was": Tuple([MultiBinary(3), Dict({"steps": Discrete(9)})])})
    action_space = MultiBinary(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps, self.on = 0, self.np_random.integers(2, size=3, dtype=np.int8)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self.steps += 1
        reward = float((action != self.on).mean())
        self.on = action.copy()
        return self._observation(), reward, False, self.steps == 8, {}

    def _observation(self) -> dict[str, Any]:
        return {"was": (self.on, {"steps": self.steps})}


@pytest.fixture
def switches() -> Iterator[dict[str, Any]]:
    name = "ventosa_tests/Switches-v0"
    gymnasium.register(name, entry_point=Switches)
    yield {"type": "gymnasium", "id": name, "num_envs": 8}
    del gymnasium.registry[name]


def test_nested_observations_of_several_steps_and_switches_are_learned(
    switches: dict[str, Any], learn: Learn, write_run: WriteRun
) -> None:
    hyper = {"buffer_size": 256, "batch_size": 64, "learning_rate": 1e-2, "num_epoch": 4}
    trainer = {
        "max_steps": 4096,
        "hyperparameters": {**hyper, "gamma": 0.0, "beta": 0.0},
        "network_settings": {"hidden_units": 32},
    }
    learned = learn(write_run({**switches, "frame_stack": 2}, trainer))
    assert learned.code == 0, learned.errors
    policy = Policy.load(str(learned.results / "toy"))
    assert policy.action_space == MultiBinary(3)
    assert {k: s.shape for k, s in policy.observation_space.spaces.items()} == {
        "was.0": (6,),
        "was.1.steps": (18,),
    }
    report = evaluate(str(learned.results / "toy"), episodes=4).report
    assert report["reward"] > 7.0  # of 8; 4 by chance


def test_who_can_not_act_in_a_space_says_so(
    switches: dict[str, Any], learn: Learn, write_run: WriteRun
) -> None:
    told = learn(write_run(switches, {"trainer_type": "ddpg"}))
    assert told.code == 2
    assert "this environment's are MultiBinary(3); use trainer_type: ppo" in told.errors


def test_it_learns_to_balance_a_pole(make_session: Callable[..., Session]) -> None:
    cart_pole = {"type": "gymnasium", "id": "CartPole-v1", "num_envs": 8}
    hyper = {"buffer_size": 256, "batch_size": 256, "num_epoch": 20, "learning_rate": 1e-3}
    hyper |= {"gamma": 0.98, "lambd": 0.8, "beta": 0.0}
    network = {"hidden_units": 64, "num_layers": 2, "activation": "tanh", "critic": "separate"}
    trainer = {"hyperparameters": hyper, "network_settings": network}
    algorithm = make_session(cart_pole, trainer).algorithm
    assert isinstance(algorithm, PPO)
    for _ in range(40):
        algorithm.collect()
        algorithm.update(0.0)
    lengths = algorithm._env_runner.pop_finished().lengths
    assert lengths[:20].mean() < 40
    assert lengths[-10:].mean() > 80
