"""Toy environments for the learner, and short ways to build a run on them.

The helpers are handed out by fixtures, because a `conftest` can't be imported reliably.
"""

from __future__ import annotations

import importlib.metadata
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from gymnasium.vector.utils import batch_space
from pydantic import BaseModel

from encoders.spaces import DepthImage
from envs.environment import Environment
from envs.evaluation import (
    Evaluator,
    PhysicalCheckOption,
    RunFileOption,
    Unanswerable,
    Use,
    error,
    rate,
)
from rewards.reward import RewardTerm
from trainers import evaluation
from trainers import run as run_module
from trainers.algorithms.ppo import PPO
from trainers.algorithms.trpo import TRPO
from trainers.common.command import DONE
from trainers.export import main as export
from trainers.hookspecs import hookimpl
from trainers.inference.construction import network_factory
from trainers.learn import main
from trainers.networks.factory import NetworkFactory
from trainers.runfile.registry import BUILT_IN_PLUGINS, Registries, load_registries, plugin_manager
from trainers.runfile.settings import Component, RunSettings, load_run
from trainers.session import Session

PICTURE_SIDE_PX = 8
POLICIES = Path(__file__).parents[1] / "policies"


class ToySettings(BaseModel, frozen=True, extra="forbid"):
    num_envs: int = 4
    episode_steps: int = 4
    privileged: bool = False


class ToyEnvironment(Environment):
    """Draws a target per episode, shows it, and rewards actions that are near it."""

    Settings = ToySettings
    parameter_names = frozenset({"scale", "shift"})

    def __init__(self, settings: ToySettings, rewards: Sequence[RewardTerm], seed: int):
        self._settings = settings
        self.num_envs = settings.num_envs
        self.single_action_space = self.actions()
        spaces: dict[str, gymnasium.Space[Any]] = dict(self.spaces())
        if settings.privileged:
            spaces["privileged"] = Box(-np.inf, np.inf, (1,), np.float32)
            self.privileged = frozenset({"privileged"})
        self.single_observation_space = gymnasium.spaces.Dict(spaces)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.parameters: Mapping[str, Any] = {}
        self.closings = 0
        self._rng = np.random.default_rng(seed)
        self._target = self.draw(self._rng, self.num_envs)
        self._steps = np.zeros(self.num_envs, int)

    @abstractmethod
    def actions(self) -> gymnasium.Space[Any]: ...

    @abstractmethod
    def spaces(self) -> dict[str, gymnasium.Space[Any]]: ...

    @abstractmethod
    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray: ...

    @abstractmethod
    def show(self, target: np.ndarray) -> dict[str, np.ndarray]: ...

    @abstractmethod
    def distance(self, actions: np.ndarray, target: np.ndarray) -> np.ndarray: ...

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, Any], dict]:
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self._begin(np.ones(self.num_envs, bool))
        return self._observations(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        assert self.action_space.contains(np.asarray(actions, self.action_space.dtype))
        distance = self.distance(actions, self._target)
        self._steps = self._steps + 1
        truncated = self._steps >= self._settings.episode_steps
        infos: dict[str, Any] = {
            "reward_terms": {"near": -distance},
            "episode_metrics": {"success": distance < 0.1, "distance_m": distance},
            "same_frame": ~truncated,
        }
        observations = self._observations()
        if truncated.any():
            infos["final_obs"], infos["_final_obs"] = observations, truncated
            self._begin(truncated)
            observations = self._observations()
        return observations, -distance, np.zeros(self.num_envs, bool), truncated, infos

    def set_parameters(self, parameters: Mapping[str, Any]) -> None:
        super().set_parameters(parameters)
        self.parameters = dict(parameters)

    def state_dict(self) -> dict[str, Any]:
        return {
            "rng": self._rng.bit_generator.state,
            "target": self._target,
            "steps": self._steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> dict[str, Any]:
        self._rng.bit_generator.state = state["rng"]
        self._target, self._steps = state["target"], state["steps"]
        return self._observations()

    def close_extras(self, **kwargs: Any) -> None:
        self.closings += 1

    def _begin(self, mask: np.ndarray) -> None:
        fresh = self.draw(self._rng, self.num_envs)
        self._target = np.where(mask.reshape(-1, *[1] * (fresh.ndim - 1)), fresh, self._target)
        self._steps = np.where(mask, 0, self._steps)

    def _observations(self) -> dict[str, Any]:
        observations = self.show(self._target)
        if self._settings.privileged:
            left = self._settings.episode_steps - self._steps
            observations["privileged"] = left[:, None].astype(np.float32)
        return observations


class TargetEnvironment(ToyEnvironment):
    """Continuous actions: hit the point that a vector names."""

    def actions(self) -> Box:
        return Box(-1.0, 1.0, (2,), np.float32)

    def spaces(self) -> dict[str, Any]:
        return {"goal": Box(-1.0, 1.0, (2,), np.float32)}

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return rng.uniform(-0.8, 0.8, (count, 2))

    def show(self, target: np.ndarray) -> dict[str, np.ndarray]:
        return {"goal": target.astype(np.float32)}

    def distance(self, actions: np.ndarray, target: np.ndarray) -> np.ndarray:
        return np.linalg.norm(actions - target, axis=1)


class DartsEnvironment(TargetEnvironment):
    """Hit the point, and be judged as a third party's environment may be: by all there is."""

    evaluation_episodes = 10
    evaluation_options = (
        RunFileOption("--darts", "how many (100% of them thrown)", "environment.episode_steps"),
        PhysicalCheckOption("--throw", "throw real darts"),
        PhysicalCheckOption("--watch", "throw them before your eyes", window=True),
    )

    @classmethod
    def harder(cls, settings: Any) -> dict[str, Any]:
        none = settings.model_copy(update={"episode_steps": 0})
        return {"one throw": settings.model_copy(update={"episode_steps": 1}), "no throw": none}

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        near = self._settings.episode_steps == 2
        return super().draw(rng, count) * (0.75 if near else 1.0)

    def reset(self, **options: Any) -> tuple[Any, ...]:
        if self._settings.episode_steps == 0:
            raise ValueError("nobody may throw")
        return super().reset(**options)

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        *results, infos = super().step(actions)
        metrics = infos["episode_metrics"]
        metrics["inside"] = metrics["distance_m"] < 1.0
        return *results, infos

    def evaluator(self) -> DartsEvaluator:
        return DartsEvaluator()


class DartsEvaluator(Evaluator):
    figures = (
        rate("inside", "darts on the board", key="inside_rate"),
        error("distance_m", "distance", "cm", 100.0),
    )
    judges_first_action = True
    check_name = "throw"
    answer_limits: Mapping[str, float] = {"distance_m": 0.7}

    def unanswerable(self, count: int, seed: int) -> Iterator[Unanswerable]:
        rng = np.random.default_rng(seed)
        uses: tuple[tuple[str, Use], ...] = (
            ("off the board", "refuse"),
            ("on the wall", "learn"),
            ("elsewhere", "measure"),
        )
        for kind, use in uses:
            goal = rng.uniform(5.0, 9.0, (count, 2)) * rng.choice([-1.0, 1.0], (count, 2))
            yield Unanswerable(kind, {"goal": goal.astype(np.float32)}, use)

    def physical_check(self, *, window: bool = False) -> Throw:
        if window:
            raise ValueError("it is too dark to see anything")
        return Throw()

    def pictures(self) -> Board:
        return Board()


class Throw:
    """Darts to the right stick, others fall off."""

    def __call__(self, actions: np.ndarray) -> dict[str, np.ndarray]:
        right = actions[:, 0] > 0.0
        return {"success": right, "fell_off": ~right}

    def close(self) -> None:
        pass


class Board:
    """Draws the number of darts, and how many stuck."""

    file_names = ("board.txt",)

    def __init__(self) -> None:
        self.darts = self.stuck = 0

    def add(self, actions: np.ndarray, outcomes: Mapping[str, np.ndarray]) -> None:
        self.darts += len(actions)
        self.stuck += int(sum(outcomes.get("success", [])))

    def files(self) -> Iterator[tuple[str, bytes]]:
        yield "board.txt", f"{self.stuck} of {self.darts}".encode()


class ChoiceEnvironment(ToyEnvironment):
    """Discrete actions: choose what the signal says; any other choice is at distance 1."""

    def actions(self) -> Discrete:
        return Discrete(3)

    def spaces(self) -> dict[str, Any]:
        return {"signal": Box(0.0, 1.0, (3,), np.float32)}

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return rng.integers(3, size=count)

    def show(self, target: np.ndarray) -> dict[str, np.ndarray]:
        return {"signal": np.eye(3, dtype=np.float32)[target]}

    def distance(self, actions: np.ndarray, target: np.ndarray) -> np.ndarray:
        return (actions != target).astype(float)


class ChoicesEnvironment(ToyEnvironment):
    """Two choices at once, counted from 5 and from 0; the distance is the share of wrong ones."""

    def actions(self) -> MultiDiscrete:
        return MultiDiscrete([3, 2], start=[5, 0])

    def spaces(self) -> dict[str, Any]:
        return {"signal": Box(0.0, 1.0, (5,), np.float32)}

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return rng.integers([3, 2], size=(count, 2))

    def show(self, target: np.ndarray) -> dict[str, np.ndarray]:
        first, second = (np.eye(n, dtype=np.float32)[target[:, i]] for i, n in enumerate((3, 2)))
        return {"signal": np.concatenate([first, second], axis=1)}

    def distance(self, actions: np.ndarray, target: np.ndarray) -> np.ndarray:
        return (actions != target + np.array([5, 0])).mean(axis=1)


class RecallEnvironment(ChoiceEnvironment):
    """The signal is shown at the first step of an episode alone, and holds for all of them."""

    def show(self, target: np.ndarray) -> dict[str, np.ndarray]:
        shown = super().show(target)["signal"]
        return {"signal": np.where(self._steps[:, None] == 0, shown, np.float32(0.0))}


class PictureEnvironment(ToyEnvironment):
    """Depth images: say where the near bar stands, from -1 at the left to 1 at the right."""

    def actions(self) -> Box:
        return Box(-1.0, 1.0, (1,), np.float32)

    def spaces(self) -> dict[str, Any]:
        return {"camera": DepthImage(PICTURE_SIDE_PX, PICTURE_SIDE_PX, (0.5, 40.0))}

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return rng.integers(PICTURE_SIDE_PX, size=count)

    def show(self, target: np.ndarray) -> dict[str, np.ndarray]:
        bar = np.arange(PICTURE_SIDE_PX) == target[:, None]
        rows = np.where(bar, 1_000, 40_000).astype(np.uint16)  # millimetres; most beyond int16
        return {"camera": np.repeat(rows[:, None, :, None], PICTURE_SIDE_PX, axis=1)}

    def distance(self, actions: np.ndarray, target: np.ndarray) -> np.ndarray:
        return np.abs(actions[:, 0] - (2.0 * target / (PICTURE_SIDE_PX - 1) - 1.0))


class ScriptedEnvironment(Environment):
    """Plays a script, whatever the actions are.

    Args:
        space: of one environment's observations.
        observations: by name, (T + 1, N, ...).
        reward: (T, N).
        terminated: (T, N); none by default.
        truncated: (T, N); none by default.
        final: by name, (T, N, ...): what an ended episode showed last; required where one ends.
        same_frame: (T, N); absent from the infos by default, as are the two that follow.
        terms: by name, (T, N).
        episode_metrics: by name, (T, N).
    """

    def __init__(
        self,
        space: gymnasium.spaces.Dict,
        observations: Mapping[str, Any],
        reward: Any,
        *,
        terminated: Any = None,
        truncated: Any = None,
        final: Mapping[str, Any] | None = None,
        same_frame: Any = None,
        terms: Mapping[str, Any] | None = None,
        episode_metrics: Mapping[str, Any] | None = None,
    ):
        self.reward = np.asarray(reward, np.float64)
        self.num_envs = self.reward.shape[1]
        never = np.zeros(self.reward.shape, bool)
        self.terminated = never if terminated is None else np.asarray(terminated, bool)
        self.truncated = never if truncated is None else np.asarray(truncated, bool)
        self.single_observation_space = space
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.script = {name: np.asarray(v, space[name].dtype) for name, v in observations.items()}
        self.final = {name: np.asarray(v, space[name].dtype) for name, v in (final or {}).items()}
        self.same_frame = same_frame
        self.terms = {name: np.asarray(v, np.float64) for name, v in (terms or {}).items()}
        self.episode_metrics = {name: np.asarray(v) for name, v in (episode_metrics or {}).items()}
        self.actions_taken: list[np.ndarray] = []
        self.time = 0

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, Any], dict]:
        self.time = 0
        return self._observations(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        t, self.time = self.time, self.time + 1
        self.actions_taken.append(actions)
        done = self.terminated[t] | self.truncated[t]
        infos: dict[str, Any] = {}
        if self.terms:
            infos["reward_terms"] = {name: values[t] for name, values in self.terms.items()}
        if self.episode_metrics:
            infos["episode_metrics"] = {
                name: values[t] for name, values in self.episode_metrics.items()
            }
        if self.same_frame is not None:
            infos["same_frame"] = np.asarray(self.same_frame, bool)[t]
        if done.any():
            infos["final_obs"] = {name: values[t] for name, values in self.final.items()}
            infos["_final_obs"] = done
        return self._observations(), self.reward[t], self.terminated[t], self.truncated[t], infos

    def state_dict(self) -> dict[str, Any]:
        return {"time": self.time}

    def load_state_dict(self, state: dict[str, Any]) -> dict[str, Any]:
        self.time = state["time"]
        return self._observations()

    def _observations(self) -> dict[str, Any]:
        return {name: values[self.time] for name, values in self.script.items()}


class NanReward:
    """A reward that breaks: NaN from its third call on."""

    class Settings(BaseModel, frozen=True, extra="forbid"):
        good_calls: int = 2

    def __init__(self, settings: Settings):
        self._left = settings.good_calls

    def __call__(self, transition: Any) -> np.ndarray:
        self._left -= 1
        return np.full(len(transition.tooltip_m), 0.0 if self._left >= 0 else np.nan)


class ToyPlugin:
    """Brings the toys into the registries, through the hooks that any plugin has."""

    @hookimpl
    def ventosa_environments(self) -> dict[str, type]:
        return {
            "target": TargetEnvironment,
            "darts": DartsEnvironment,
            "choice": ChoiceEnvironment,
            "choices": ChoicesEnvironment,
            "recall": RecallEnvironment,
            "picture": PictureEnvironment,
        }

    @hookimpl
    def ventosa_rewards(self) -> dict[str, type]:
        return {"breaking": NanReward}


@pytest.fixture
def install_plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str, str], Path]]:
    """Lays out a module as pip would, as a plugin called `own`: `install_plugin(module, source)`.

    Returns the folder that it is in, which other processes need on their path.
    """
    folder = tmp_path / "site"
    modules = []

    def install(module: str, source: str) -> Path:
        info = folder / f"{module}-1.2.dist-info"
        info.mkdir(parents=True)
        name = module.replace("_", "-")
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(f"[ventosa]\nown = {module}\n")
        (folder / f"{module}.py").write_text(source)
        monkeypatch.syspath_prepend(str(folder))
        modules.append(module)
        return folder

    yield install
    for module in modules:
        sys.modules.pop(module, None)


@pytest.fixture(scope="session")
def registries() -> Registries:
    """What is built in, and the toys."""
    return load_registries(plugin_manager((*BUILT_IN_PLUGINS, ToyPlugin())))


@pytest.fixture(scope="session")
def built_in() -> Registries:
    """What is built in alone, whatever else is installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.metadata, "entry_points", lambda **_: ())
        return load_registries()


@pytest.fixture(scope="session")
def scripted() -> type[ScriptedEnvironment]:
    return ScriptedEnvironment


@pytest.fixture(scope="session")
def make_factory(registries: Registries) -> Callable[..., NetworkFactory]:
    """Builds a `NetworkFactory`; vectors need no encoder, images do."""

    def make(
        space: Mapping[str, gymnasium.Space[Any]],
        encoders: Mapping[str, Component] | None = None,
        action_space: gymnasium.Space[Any] | None = None,
    ) -> NetworkFactory:
        return network_factory(
            gymnasium.spaces.Dict(dict(space)),
            action_space or Box(-1.0, 1.0, (1,), np.float32),
            frozenset({"privileged"}),
            encoders or {},
            registries.encoders,
        )

    return make


def sections(environment: Any, trainer: Mapping[str, Any], rest: Mapping[str, Any]) -> dict:
    """A run file's data: a toy by its name, and a small trainer."""
    name = trainer.get("trainer_type", "ppo")
    small = {
        "trainer_type": name,
        "max_steps": 64,
        "summary_freq": 16,
        "checkpoint_interval": 32,
        "hyperparameters": {"batch_size": 8, "buffer_size": 16, "num_epoch": 1},
        "network_settings": {"hidden_units": 8, "num_layers": 1},
    }
    if name in ("ddpg", "sac"):
        memory = {"batch_size": 8, "buffer_size": 64, "buffer_init_steps": 16}
        small |= {"time_horizon": 4, "hyperparameters": memory}
    merged = {**small, **trainer}
    for key in ("hyperparameters", "network_settings"):
        merged[key] = {**small[key], **trainer.get(key, {})}  # type: ignore[dict-item]
    named = {"type": environment} if isinstance(environment, str) else environment
    return {"environment": named, "trainer": merged, **rest}


@pytest.fixture
def write_run(tmp_path: Path) -> Callable[..., Path]:
    """Writes a run file: `write_run("target", {"max_steps": 64}, seed=1)`."""

    def write(environment: Any = "target", trainer: Any = None, **rest: Any) -> Path:
        path = tmp_path / "toy.yaml"
        path.write_text(yaml.safe_dump(sections(environment, trainer or {}, rest)))
        return path

    return write


@pytest.fixture
def make_run(write_run: Callable[..., Path], registries: Registries) -> Callable[..., RunSettings]:
    """The settings of a run; arguments as `write_run`'s."""

    def make(environment: Any = "target", trainer: Any = None, **rest: Any) -> RunSettings:
        return load_run(write_run(environment, trainer, **rest), [], registries)

    return make


@pytest.fixture
def make_session(
    make_run: Callable[..., RunSettings], registries: Registries
) -> Callable[..., Session]:
    """A session with its first episodes begun; arguments as `write_run`'s."""

    def make(environment: Any = "target", trainer: Any = None, **rest: Any) -> Session:
        session = Session(make_run(environment, trainer, **rest), registries)
        session.reset()
        return session

    return make


@pytest.fixture
def make_algorithm(make_session: Callable[..., Session]) -> Callable[..., Any]:
    """An algorithm on a toy: `make_algorithm("trpo", "target", {"gamma": 0.0}, {...})`."""

    def make(
        trainer_type: str,
        environment: Any = "target",
        hyperparameters: Mapping[str, Any] | None = None,
        network: Mapping[str, Any] | None = None,
        **rest: Any,
    ) -> Any:
        trainer = {
            "trainer_type": trainer_type,
            "hyperparameters": hyperparameters or {},
            "network_settings": network or {},
        }
        return make_session(environment, trainer, **rest).algorithm

    return make


@pytest.fixture
def make_ppo(make_algorithm: Callable[..., Any]) -> Callable[..., PPO]:
    """PPO on a toy: `make_ppo("target", {"gamma": 0.0}, {"hidden_units": 4})`."""
    return partial(make_algorithm, "ppo")


@pytest.fixture
def make_trpo(make_algorithm: Callable[..., Any]) -> Callable[..., TRPO]:
    """TRPO on a toy: arguments as `make_ppo`'s."""
    return partial(make_algorithm, "trpo")


@dataclass
class Learned:
    """What came of a command line."""

    code: int
    output: str
    errors: str
    results: Path = field(repr=False)

    @property
    def step(self) -> int:
        return max(int(path.name.split("-")[1]) for path in self.checkpoints)

    @property
    def checkpoints(self) -> list[Path]:
        return sorted(self.results.glob("*/checkpoints/step-*"))


@pytest.fixture
def learn(
    tmp_path: Path,
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> Callable[..., Learned]:
    """Runs the command line in this process, with the toys in the registries."""
    monkeypatch.setattr(run_module, "load_registries", lambda: registries)
    results = tmp_path / "results"

    def run(*arguments: Any, results_dir: Path = results) -> Learned:
        capfd.readouterr()
        code = main([*map(str, arguments), "--results-dir", str(results_dir)])
        captured = capfd.readouterr()
        return Learned(code, captured.out, captured.err, results_dir)

    return run


@pytest.fixture(scope="session")
def shipped_onnx(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The policy in policies/grasp_gaussian, whose images are small, as an ONNX file."""
    return exported(tmp_path_factory, "grasp_gaussian")


@pytest.fixture(scope="session")
def structured_light_onnx(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The policy in policies/grasp as an ONNX file."""
    return exported(tmp_path_factory, "grasp")


def exported(tmp_path_factory: pytest.TempPathFactory, policy: str) -> Path:
    path = tmp_path_factory.mktemp("shipped") / "policy.onnx"
    assert export([str(POLICIES / policy), str(path)]) == DONE
    return path


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    """Toys are too small for two threads; and other tests may be running beside these."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def learned(
    learn: Callable[..., Any],
    write_run: Callable[..., Path],
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., Path]:
    """Learns a run `toy` that can be evaluated: `learned("target", trainer)`; the results."""
    monkeypatch.setattr(evaluation, "load_registries", lambda: registries)

    def results(environment: str, trainer: Any = None) -> Path:
        done = learn(write_run(environment, trainer))
        assert done.code == DONE, done.errors
        found: Path = done.results
        return found

    return results
