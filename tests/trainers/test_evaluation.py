"""What an evaluation says of a policy, whatever the environment reports."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor

from trainers.evaluate import main
from trainers.inference.metadata import FILE as METADATA
from trainers.networks.actor_critic import ActorCritic
from trainers.networks.observations import Observations
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings, dump_yaml
from trainers.saving.checkpoint import Checkpoints
from trainers.saving.run_folder import CONFIGURATION, begin
from trainers.session import Session

LENGTHS = (2, 4)
GYMNASIUM = {"type": "gymnasium", "id": "ventosa_tests/Square-v0", "num_envs": 2}
GRASP = {
    "type": "grasp",
    "num_envs": 2,
    "workers": 0,
    "episode_steps": 3,
    "cameras": {"depth": {"type": "depth", "width": 36, "height": 36}},
}
REWARDS = [{"type": "approach"}, {"type": "facing"}]
ENCODERS = {"depth": {"type": "paper", "size": 32}}


class Square(gymnasium.Env[Any, Any]):
    """Every step is worth the square of its action; episodes have one of two lengths."""

    observation_space = Box(-1.0, 1.0, (1,), np.float32)
    action_space = Box(-4.0, 4.0, (1,), np.float32)
    seeds: list[int] = []  # noqa: RUF012

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        assert seed is not None
        self.seeds.append(seed)
        self.left = LENGTHS[self.np_random.integers(2)]
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        return np.zeros(1, np.float32), float(action[0]) ** 2, self.left == 0, False, {}


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gymnasium.register("ventosa_tests/Square-v0", entry_point=Square)
    yield
    del gymnasium.registry["ventosa_tests/Square-v0"]


@pytest.fixture
def saved(
    tmp_path: Path, make_run: Callable[..., RunSettings], registries: Registries
) -> Callable[..., Path]:
    """Saves a run whose policy's best action is 3 of 4, give or take its deviation."""

    def save(environment: Any, **rest: Any) -> Path:
        run = make_run(environment, **rest)
        session = Session(run, registries)
        weights = session.weights()
        weights["action_head.weight"].zero_()
        weights["action_head.bias"].fill_(0.75)
        session.close()
        files = {CONFIGURATION: dump_yaml(run), METADATA: session.metadata.to_json()}
        begin(tmp_path / "run", files, resume=False)
        Checkpoints(tmp_path / "run/checkpoints", keep=1).save(1, weights, {}, None)
        return tmp_path / "run"

    return save


def report(run: Path, *arguments: str) -> dict[str, Any]:
    path = run.parent / "evaluation.json"
    assert main([str(run), "--json", str(path), *arguments]) == 0
    said: dict[str, Any] = json.loads(path.read_text())
    return said


def test_episodes_of_gymnasium_are_played_by_the_deterministic_policy(
    saved: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    said = report(saved(GYMNASIUM), "--episodes", "30")
    assert said.keys() == {"episodes", "seed", "reward", "reward_std", "episode_length"}
    assert said["episodes"] == 30
    length = said["episode_length"]
    assert 2 < length < 4
    assert said["reward"] == pytest.approx(9 * length)
    # Of a number that is a with probability p and b else: |a - b| sqrt(p (1 - p)).
    share = (length - 2) / 2
    assert said["reward_std"] == pytest.approx(18 * (share * (1 - share)) ** 0.5)
    printed = " ".join(capsys.readouterr().out.split())
    for fact in (f"{said['reward']:.3f}", "reward std", f"{said['reward_std']:.3f}", "30 episodes"):
        assert fact in printed


def test_episodes_are_repeatable_and_their_seeds_are_not_the_runs(
    saved: Callable[..., Path], make_session: Callable[..., Session]
) -> None:
    Square.seeds.clear()
    make_session(GYMNASIUM).close()
    run = saved(GYMNASIUM)
    trained = set(Square.seeds)
    evaluated = []
    for arguments in ([], [], ["--seed", "1"]):
        Square.seeds.clear()
        report(run, "--episodes", "10", *arguments)
        evaluated.append(set(Square.seeds))
    assert trained
    assert evaluated[0] == evaluated[1]
    assert evaluated[0].isdisjoint(trained | evaluated[2])


@pytest.fixture
def ages(monkeypatch: pytest.MonkeyPatch) -> list[list[float]]:
    """What a policy that counts its steps remembers, at each of its actions."""
    ages: list[list[float]] = []

    def count_steps(
        policy: ActorCritic, observations: Observations, *, deterministic: bool, generator: Any
    ) -> tuple[Tensor, Tensor]:
        assert observations.sequences is not None
        state = observations.sequences.hidden_state
        ages.append(state.flatten().tolist())
        return torch.zeros(len(state), *policy.action_head.bias.shape), state + 1.0

    monkeypatch.setattr(ActorCritic, "initial_state", lambda policy, count: torch.zeros(count, 1))
    monkeypatch.setattr(ActorCritic, "act", count_steps)
    one = property(lambda policy: 1, lambda policy, size: None)
    monkeypatch.setattr(ActorCritic, "state_size", one, raising=False)
    return ages


def test_what_is_remembered_ends_with_its_episode(
    saved: Callable[..., Path], ages: list[list[float]]
) -> None:
    report(saved(GYMNASIUM), "--episodes", "40")
    for column in np.array(ages).T:
        begins = np.flatnonzero(column == 0.0)
        lengths = np.diff(begins)
        assert set(lengths) == set(LENGTHS)
        np.testing.assert_array_equal(
            column[: begins[-1]], np.concatenate([np.arange(length) for length in lengths])
        )


def test_nothing_is_remembered_at_a_first_action(
    saved: Callable[..., Path], ages: list[list[float]]
) -> None:
    report(saved(GRASP, rewards=REWARDS, encoders=ENCODERS), "--episodes", "6")
    assert ages[:3] == [[0.0, 0.0]] * 3  # six scenes for two environments
    assert ages[3:5] == [[0.0, 0.0], [1.0, 1.0]]  # whole episodes


def test_the_environment_says_how_many_episodes_it_is_judged_by(
    saved: Callable[..., Path],
) -> None:
    assert report(saved(GYMNASIUM))["episodes"] == 100


def test_grasping_is_judged_by_the_first_action_and_by_episodes_as_in_training(
    saved: Callable[..., Path],
) -> None:
    said = report(saved(GRASP, rewards=REWARDS, encoders=ENCODERS), "--episodes", "3")
    facts = {"episodes", "seed"}
    first_actions = {"first_action_success", "first_action_collision_rate"}
    axes = {f"position_error_{axis}_m" for axis in "xyz"}
    errors = {"position_error_m", *axes, "yaw_error_deg"}
    episodes = {"success", "collision_rate", "reward", "reward_std", "episode_length"}
    assert said.keys() == facts | first_actions | errors | episodes


def test_a_setting_that_the_environment_lacks_is_the_users_mistake(
    saved: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(saved(GYMNASIUM)), "environment.simulator=fast"]) == 2
    assert "environment.simulator: unknown key" in capsys.readouterr().err
