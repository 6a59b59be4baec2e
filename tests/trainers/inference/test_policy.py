"""A policy by itself: what it answers, and what it does not need."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from gymnasium.spaces import Box, Dict, Discrete
from pydantic import BaseModel

from envs.deployment import Deployment, Meaning, Quantity
from trainers.common.errors import UserError
from trainers.inference.metadata import FILE
from trainers.inference.policy import Policy, complete_metadata, find_metadata
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import to_tensors
from trainers.networks.recurrent import Sequences
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings, dump_yaml
from trainers.saving.checkpoint import Checkpoints
from trainers.saving.run_folder import CONFIGURATION, begin
from trainers.session import Session

REPOSITORY = Path(__file__).parents[3]
MEMORY = {"network_settings": {"memory": {"type": "lstm", "memory_size": 4}}}
CPU = torch.device("cpu")
CAMERA = {"camera": {"type": "conv", "layers": [[4, 4, 2]]}}
CRITIC = {"network_settings": {"critic": "separate", "critic_observations": ["privileged"]}}
SHIPPED = REPOSITORY / "policies" / "grasp"

Save = Callable[..., tuple[Path, Session]]


@pytest.fixture
def saved(make_run: Callable[..., RunSettings], registries: Registries, tmp_path: Path) -> Save:
    """Saves an untrained run; returns its folder, and the session it is of."""

    def save(
        environment: Any = "target", encoders: Any = None, **trainer: Any
    ) -> tuple[Path, Session]:
        run = make_run(environment, trainer, encoders=encoders)
        session, folder = Session(run, registries), tmp_path / "run"
        files = {CONFIGURATION: dump_yaml(run), FILE: session.metadata.to_json()}
        begin(folder, files, resume=False)
        Checkpoints(folder / "checkpoints", keep=1).save(1, session.weights(), {}, None)
        return folder, session

    return save


def observations_of(session: Session) -> Mapping[str, np.ndarray]:
    session.reset()
    return session.env_runner.observations


@pytest.mark.parametrize("trainer", [{"trainer_type": "ppo"}, {"trainer_type": "ddpg"}])
def test_it_acts_as_the_network_of_its_run(saved: Save, trainer: dict[str, Any]) -> None:
    folder, session = saved(**trainer)
    seen = observations_of(session)
    actions, state = Policy.load(folder).predict(seen)
    space = session.env_runner.env.single_observation_space
    tensors = to_tensors(seen, space, torch.device("cpu"))
    with torch.no_grad():
        expected, _ = session.algorithm.policy.act(
            tensors, deterministic=True, generator=torch.Generator()
        )
    np.testing.assert_array_equal(actions, expected.numpy().clip(-1.0, 1.0))
    assert state.shape == (len(actions), 0)


def test_one_observation_gets_one_action(saved: Save) -> None:
    folder, session = saved()
    batch = observations_of(session)
    policy = Policy.load(folder)
    assert not any(module.training for module in policy.network.modules())
    actions, _ = policy.predict(batch)
    for row in range(len(actions)):
        one, state = policy.predict({name: values[row] for name, values in batch.items()})
        np.testing.assert_allclose(one, actions[row], rtol=1e-5)
        assert state.shape == (0,)
        unnamed, _ = policy.predict(batch["goal"][row])
        np.testing.assert_array_equal(unnamed, one)


def test_images_and_discrete_actions(saved: Save) -> None:
    folder, session = saved("choice")
    actions, _ = Policy.load(folder).predict(observations_of(session))
    assert actions.dtype == np.int64
    folder, session = saved("picture", encoders=CAMERA)
    actions, _ = Policy.load(folder).predict(observations_of(session))
    assert actions.shape == (4, 1)


def test_choices_are_counted_from_where_the_space_begins(
    make_factory: Callable[..., NetworkFactory],
) -> None:
    seen, space = {"joints": Box(-1.0, 1.0, (3,), np.float32)}, Discrete(3, start=5)
    network = ActorCritic(make_factory(seen, action_space=space), PolicySettings())
    policy = Policy(network, Dict(seen), space)
    batch = {"joints": np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)).astype(np.float32)}
    chosen, _ = policy.predict(batch)
    logits = network.action_head(network.actor(to_tensors(batch, policy.observation_space, CPU)))
    assert chosen.tolist() == (5 + logits.argmax(1)).tolist()
    drawn, _ = policy.predict(batch, deterministic=False)
    assert set(drawn.tolist()) == {5, 6, 7}


def test_memory_is_carried_by_the_caller(saved: Save) -> None:
    folder, session = saved("recall", trainer_type="ppo", **MEMORY)
    policy, seen = Policy.load(folder), observations_of(session)
    assert policy.network.state_size == 8
    _, first = policy.predict(seen)
    _, second = policy.predict(seen, first)
    assert not np.allclose(first, second)
    np.testing.assert_array_equal(policy.predict(seen, np.zeros_like(first))[1], first)
    space = session.env_runner.env.single_observation_space
    tensors = to_tensors(seen, space, torch.device("cpu"))
    network = session.algorithm.policy
    hidden_state = network.initial_state(4)
    with torch.no_grad():
        for _ in range(2):
            sequences = Sequences.single(hidden_state)
            _, _, hidden_state = network.step(replace(tensors, sequences=sequences))
    np.testing.assert_allclose(second, hidden_state.numpy(), rtol=1e-6)
    one = {name: values[0] for name, values in seen.items()}
    np.testing.assert_allclose(policy.predict(one, first[0])[1], second[0], rtol=1e-5)
    with pytest.raises(ValueError, match=r"state: of shape \(3, 8\).*need \(4, 8\)"):
        policy.predict(seen, first[:3])


def test_what_a_critic_alone_sees_may_be_left_out(saved: Save) -> None:
    folder, session = saved({"type": "target", "privileged": True}, trainer_type="ppo", **CRITIC)
    seen, policy = observations_of(session), Policy.load(folder)
    assert list(policy.observation_space) == ["goal"]
    with_it, _ = policy.predict(seen)
    without, _ = policy.predict({"goal": seen["goal"]})
    np.testing.assert_array_equal(with_it, without)


def test_observations_are_in_the_order_in_which_the_network_sees_them(saved: Save) -> None:
    _, session = saved()
    network = session.algorithm.policy
    network.sees = ("second", "first")
    spaces = {name: Box(0.0, 1.0, (2,)) for name in ("first", "second")}
    policy = Policy(network, Dict(spaces), session.metadata.action_space)
    assert list(policy.observation_space) == ["second", "first"]


def test_drawn_actions_follow_the_seed(saved: Save) -> None:
    folder, session = saved()
    seen = observations_of(session)
    drawn = [Policy.load(folder, seed=s).predict(seen, deterministic=False)[0] for s in (1, 1, 2)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert (drawn[0] != drawn[2]).any()


def test_a_run_of_before_there_were_metadata_still_loads(
    saved: Save, monkeypatch: pytest.MonkeyPatch, registries: Registries
) -> None:
    folder, session = saved()
    seen = observations_of(session)
    expected, _ = Policy.load(folder).predict(seen)
    (folder / FILE).unlink()
    monkeypatch.setattr("trainers.inference.policy.load_registries", lambda *_: registries)
    actions, _ = Policy.load(folder).predict(seen)
    np.testing.assert_array_equal(actions, expected)


DECLARED = Deployment(
    meaning=Meaning(name="speed", quantities=(Quantity(name="v", low=0, high=2, label="v"),) * 2)
)


def test_what_an_environment_declares_is_saved_or_asked_for(
    saved: Save, monkeypatch: pytest.MonkeyPatch, registries: Registries
) -> None:
    target = registries.environments.get("target").cls
    monkeypatch.setattr(target, "deployment", classmethod(lambda cls, settings: DECLARED))
    folder, _ = saved()
    assert complete_metadata(folder).deployment == DECLARED
    content = json.loads((folder / FILE).read_text())
    del content["deployment"]  # as those of before have it
    (folder / FILE).write_text(json.dumps(content))
    assert find_metadata(folder).deployment is None
    monkeypatch.setattr("trainers.inference.policy.load_registries", lambda *_: registries)
    assert complete_metadata(folder).deployment == DECLARED
    monkeypatch.undo()  # the toy is not installed
    assert complete_metadata(folder).deployment == Deployment()


@pytest.mark.parametrize("trainer_type", ["ppo", "ddpg"])
def test_what_was_trained_in_bfloat16_may_calculate_in_float32(
    saved: Save, trainer_type: str
) -> None:
    lowered = {"precision": "bfloat16"}
    folder, session = saved(trainer_type=trainer_type, network_settings=lowered)
    seen = observations_of(session)
    exact, _ = Policy.load(folder, full_precision=True).predict(seen)
    rough, _ = Policy.load(folder).predict(seen)
    assert 0.0 < np.abs(exact - rough).max() < 0.05
    path = folder / CONFIGURATION
    path.write_text(path.read_text().replace("bfloat16", "float32"))
    np.testing.assert_array_equal(Policy.load(folder).predict(seen)[0], exact)


def test_an_environment_asked_for_its_spaces_need_not_count_itself(
    saved: Save, monkeypatch: pytest.MonkeyPatch, registries: Registries
) -> None:
    folder, session = saved()
    (folder / FILE).unlink()
    monkeypatch.setattr("trainers.inference.policy.load_registries", lambda *_: registries)
    environment = type(session.env_runner.env)
    monkeypatch.setattr(environment, "Settings", Countless)
    path = folder / CONFIGURATION
    settings = {**yaml.safe_load(path.read_text()), "environment": {"type": "target"}}
    path.write_text(yaml.safe_dump(settings))
    assert list(Policy.load(folder).observation_space) == ["goal"]

    def refuse(*_: Any) -> None:
        raise ValueError("it is too late in the day")

    monkeypatch.setattr(environment, "__init__", refuse)
    with pytest.raises(UserError, match=r"environment \(target\): it is too late in the day"):
        Policy.load(folder)


class Countless(BaseModel, frozen=True, extra="forbid"):
    """Settings of an environment whose number is no setting."""

    episode_steps: int = 4

    @property
    def num_envs(self) -> int:
        return 1

    @property
    def privileged(self) -> bool:
        return False


def test_a_device_that_is_not_there_is_the_users_mistake(saved: Save) -> None:
    folder, _ = saved()
    with pytest.raises(UserError, match=r"^device: 'cuda:77' can't be used"):
        Policy.load(folder, device="cuda:77")


def test_what_is_no_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="neither a run nor a checkpoint"):
        Policy.load(tmp_path)


def test_weights_that_do_not_fit_are_refused_with_torchs_reason(saved: Save) -> None:
    folder, _ = saved()
    path = folder / CONFIGURATION
    path.write_text(path.read_text().replace("hidden_units: ", "hidden_units: 1"))
    with pytest.raises(UserError, match="size mismatch for actor"):
        Policy.load(folder)


def test_a_plugin_that_is_not_installed_is_named(saved: Save) -> None:
    folder, _ = saved()
    path = folder / FILE
    content = (
        path.read_text().replace('"ppo"', '"unheard_of"').replace('"built-in"', '"theirs 1.2"')
    )
    path.write_text(content)
    with pytest.raises(
        UserError, match=r"trainer 'unheard_of' of theirs 1\.2, which is not installed"
    ):
        Policy.load(folder)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "Invalid JSON"),
        ("{}", "format: "),
        ('{"format": 2}', "observation_space: "),
        ("[1]", ""),
    ],
)
def test_damaged_metadata_are_refused(saved: Save, content: str, reason: str) -> None:
    folder, _ = saved()
    (folder / FILE).write_text(content)
    with pytest.raises(UserError, match=rf"policy\.json: can't be used: {reason}.*; export"):
        Policy.load(folder)


@pytest.mark.parametrize("device", ["gpu", "cuda:99"])
def test_a_device_that_is_not_there_is_named(saved: Save, device: str) -> None:
    folder, _ = saved()
    with pytest.raises(UserError, match=f"device: '{device}' can't be used: .*; use 'cpu'"):
        Policy.load(folder, device=device)


def test_the_shipped_policy_needs_neither_environment_nor_optimizer() -> None:
    program = f"""
import sys, numpy as np
from trainers.inference.policy import Policy
policy = Policy.load({str(SHIPPED)!r})
image = np.full(policy.observation_space["depth"].shape, 1000, np.uint16)
actions, _ = policy.predict(image)
assert actions.shape == (4,), actions
loaded = {{"pybullet", "numba", "envs.grasp.vector_env"}}
print(sorted(loaded & set(sys.modules)))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert done.stdout == "[]\n"
