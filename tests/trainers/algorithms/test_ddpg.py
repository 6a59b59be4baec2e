"""DDPG: its targets by hand, its settings by their effect, and that it learns."""

from __future__ import annotations

import copy
import math
import weakref
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from pydantic import ValidationError
from torch import Tensor

from trainers.algorithms.ddpg import DDPG, DDPGHyperparameters, DDPGSettings
from trainers.common.errors import NonFiniteError, UserError
from trainers.experience.env_runner import EnvRunner
from trainers.experience.episodes import concatenate
from trainers.inference.policy import Policy
from trainers.networks.deterministic import DeterministicPolicy, DeterministicSettings
from trainers.networks.factory import NetworkFactory
from trainers.networks.frame_features import FrameFeatures
from trainers.networks.observations import Observations, to_tensors
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings
from trainers.session import Session

MakeDDPG = Callable[..., DDPG]
CAMERA = {"camera": {"type": "conv", "layers": [[8, 8, 1]]}}


@pytest.fixture
def make_ddpg(make_session: Callable[..., Session]) -> MakeDDPG:
    """DDPG on a toy, with 16 transitions a collection: `make_ddpg("target", {"gamma": 0.0})`."""

    def make(
        environment: Any = "target",
        hyperparameters: Any = None,
        network: Any = None,
        time_horizon: int = 4,
        **rest: Any,
    ) -> DDPG:
        trainer = {
            "trainer_type": "ddpg",
            "time_horizon": time_horizon,
            "hyperparameters": hyperparameters or {},
            "network_settings": network or {},
        }
        algorithm = make_session(environment, trainer, **rest).algorithm
        assert isinstance(algorithm, DDPG)
        return algorithm

    return make


def one_round(algorithm: DDPG, progress: float = 0.0) -> dict[str, float]:
    algorithm.collect()
    return dict(algorithm.update(progress))


def snapshot(tensors: Iterable[Tensor]) -> list[Tensor]:
    return [tensor.detach().clone() for tensor in tensors]


def changed(before: list[Tensor], tensors: Iterable[Tensor]) -> bool:
    return any(not torch.equal(a, b) for a, b in zip(before, tensors, strict=True))


# -- targets -------------------------------------------------------------------------------------

LINE = gymnasium.spaces.Dict({"x": Box(-99.0, 99.0, (1,), np.float32)})


def on_a_line(
    scripted: Any, make_factory: Callable[..., NetworkFactory], **hyperparameters: Any
) -> DDPG:
    """Four steps of two environments at x = 0 to 4 and 10 to 14: an end of each kind.

    The first is terminated at its second step, the second is cut off there, at x = 50.
    """
    second = np.array([[0, 0], [1, 1], [0, 0], [0, 0]])
    x = np.arange(5.0)[:, None, None] + np.array([[[0.0], [10.0]]])
    env = scripted(
        LINE,
        {"x": x},
        reward=[[1.0, 2.0], [4.0, 8.0], [16.0, 32.0], [64.0, 128.0]],
        terminated=second * [1, 0],
        truncated=second * [0, 1],
        final={"x": np.full((4, 2, 1), 50.0)},
    )
    env_runner = EnvRunner(env)
    env_runner.reset()
    hyper = {"batch_size": 1, "buffer_size": 8, "buffer_init_steps": 8, **hyperparameters}
    settings = DDPGSettings(
        time_horizon=4, hyperparameters=hyper, network_settings={"hidden_units": 4}
    )
    generator = torch.Generator().manual_seed(0)
    factory = make_factory(LINE.spaces)
    return DDPG(factory, settings, env_runner, generator, torch.device("cpu"))


def targets_of(algorithm: DDPG, monkeypatch: pytest.MonkeyPatch) -> list[list[float]]:
    """The targets of all transitions, (T, N), where Q'(s, a) is 100 x + a and mu'(s) is 0.5."""
    target = algorithm.policy.target
    monkeypatch.setattr(target, "act", lambda seen: torch.full((len(seen.vectors["x"]), 1), 0.5))
    monkeypatch.setattr(
        target, "value", lambda seen, actions: (100.0 * seen.vectors["x"] + actions).squeeze(1)
    )
    algorithm.collect()
    algorithm.update(0.0)
    indices = torch.arange(8)  # time by time, as long as the ring has not come round
    found: list[list[float]] = algorithm._targets(indices).reshape(4, 2).tolist()
    return found


def test_what_is_cut_off_is_worth_its_last_observation_and_what_terminated_nothing(
    scripted: Any, make_factory: Callable[..., NetworkFactory], monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = on_a_line(scripted, make_factory, gamma=0.1)
    assert np.array(targets_of(algorithm, monkeypatch)) == pytest.approx(
        np.array(
            [
                [1.0 + 0.1 * 100.5, 2.0 + 0.1 * 1100.5],
                [4.0, 8.0 + 0.1 * 5000.5],
                [16.0 + 0.1 * 300.5, 32.0 + 0.1 * 1300.5],
                [64.0 + 0.1 * 400.5, 128.0 + 0.1 * 1400.5],
            ]
        ),
        rel=1e-5,
    )


def test_returns_of_two_steps_stay_within_their_episode(
    scripted: Any, make_factory: Callable[..., NetworkFactory], monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = on_a_line(scripted, make_factory, gamma=0.1, n_step=2)
    assert np.array(targets_of(algorithm, monkeypatch)) == pytest.approx(
        np.array(
            [
                [1.0 + 0.4, 2.0 + 0.8 + 0.01 * 5000.5],
                [4.0, 8.0 + 0.1 * 5000.5],
                [16.0 + 6.4 + 0.01 * 400.5, 32.0 + 12.8 + 0.01 * 1400.5],
                [64.0 + 0.1 * 400.5, 128.0 + 0.1 * 1400.5],
            ]
        ),
        rel=1e-5,
    )


def test_without_a_future_nobody_asks_the_targets(
    scripted: Any, make_factory: Callable[..., NetworkFactory], monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = on_a_line(scripted, make_factory, gamma=0.0)
    for name in ("act", "value"):
        monkeypatch.setattr(algorithm.policy.target, name, None)
    one_round(algorithm)
    assert algorithm._targets(torch.arange(4)).tolist() == [1.0, 2.0, 4.0, 8.0]


# -- networks ------------------------------------------------------------------------------------


def test_targets_begin_alike_and_follow_by_tau(make_factory: Callable[..., NetworkFactory]) -> None:
    settings = DeterministicSettings(hidden_units=3)
    policy = DeterministicPolicy(make_factory(LINE.spaces), settings, tau=0.25)
    online, target = list(policy.online.parameters()), list(policy.target.parameters())
    assert not changed(online, target)
    assert not any(parameter.requires_grad for parameter in target)
    with torch.no_grad():
        for mine, theirs in zip(online, target, strict=True):
            mine.fill_(8.0)
            theirs.fill_(0.0)
    for expected in (2.0, 3.5, 4.625):
        policy.update_targets()
        assert all((parameter == expected).all() for parameter in target)
    assert all((parameter == 8.0).all() for parameter in online)


def test_actions_are_scaled_to_the_space(make_factory: Callable[..., NetworkFactory]) -> None:
    space = Box(np.array([-2.0, 0.0], np.float32), np.array([4.0, 0.5], np.float32))
    factory = make_factory(LINE.spaces, action_space=space)
    policy = DeterministicPolicy(factory, DeterministicSettings(hidden_units=3), tau=0.1)
    scaled = policy.scale(torch.tensor([[-1.0, -1.0], [0.0, 0.0], [1.0, 0.5]]))
    assert scaled.tolist() == [[-2.0, 0.0], [1.0, 0.25], [4.0, 0.375]]


def test_the_policys_loss_moves_the_actor_alone(make_ddpg: MakeDDPG) -> None:
    for rates, moved in (
        ({"learning_rate": 1e-30, "critic_learning_rate": 1e-2}, [False, True]),
        ({"learning_rate": 1e-2, "critic_learning_rate": 1e-30}, [True, False]),
    ):
        algorithm = make_ddpg("picture", rates, encoders=CAMERA)
        online = algorithm.policy.online
        with torch.no_grad():  # a zero moves however small the step is
            for parameter in online.parameters():
                parameter.add_(0.01)
        actor, critic = snapshot(online.actor_parameters()), snapshot(online.critic_parameters())
        one_round(algorithm)
        now = [
            changed(actor, online.actor_parameters()),
            changed(critic, online.critic_parameters()),
        ]
        assert now == moved
        assert len(actor) + len(critic) == len(list(online.parameters()))


def test_shared_encoders_learn_from_the_critic_alone(make_ddpg: MakeDDPG) -> None:
    rates = {"learning_rate": 1e-2, "critic_learning_rate": 1e-30}
    algorithm = make_ddpg("picture", rates, {"critic": "shared"}, encoders=CAMERA)
    online = algorithm.policy.online
    assert online.actor_encoder is None
    with torch.no_grad():
        for parameter in online.parameters():
            parameter.add_(0.01)
    encoder, actor = (
        snapshot(online.critic_encoder.parameters()),
        snapshot(online.actor.parameters()),
    )
    one_round(algorithm)
    assert not changed(encoder, online.critic_encoder.parameters())
    assert changed(actor, online.actor.parameters())


def test_a_privileged_critic_guides_a_policy_that_sees_less(make_ddpg: MakeDDPG) -> None:
    network = {"critic_observations": ["privileged"]}
    environment = {"type": "target", "privileged": True}
    online = make_ddpg(environment, None, network).policy.online
    goal, privileged = (torch.rand(3, size, requires_grad=True) for size in (2, 1))
    observations = Observations({}, {"goal": goal, "privileged": privileged})
    actions = online.act(observations)
    seen = torch.autograd.grad(actions.sum(), [goal, privileged], allow_unused=True)
    assert seen[0] is not None
    assert seen[1] is None
    value = online.value(observations, actions.detach()).sum()
    seen = torch.autograd.grad(value, [goal, privileged], allow_unused=True)
    assert seen[0] is None
    assert seen[1] is not None


def test_observations_are_standardised_alike_for_everyone(make_ddpg: MakeDDPG) -> None:
    algorithm = make_ddpg("target", {"updates_per_step": 0.1}, {"normalize": True})
    one_round(algorithm)
    one_round(algorithm)
    buffers = dict(algorithm.policy.named_buffers())
    counts = [tensor.item() for name, tensor in buffers.items() if name.endswith("count")]
    assert counts == [32.0] * 4  # actor and critic, and their targets
    means = [tensor for name, tensor in buffers.items() if name.endswith("mean")]
    goal = algorithm._buffer.observations(torch.arange(32), ["goal"]).vectors["goal"]
    for mean in means:
        torch.testing.assert_close(mean, goal.double().mean(0))


@pytest.mark.parametrize("critic", ["separate", "shared"])
def test_a_frozen_encoder_stays_as_it_is_and_the_rest_learns(
    make_ddpg: MakeDDPG, critic: str
) -> None:
    algorithm = make_ddpg("picture", {}, {"critic": critic}, encoders=CAMERA)
    online = algorithm.policy.online
    encoders = [online.critic_encoder, *filter(None, [online.actor_encoder])]
    frozen = [p for encoder in encoders for p in encoder.requires_grad_(False).parameters()]
    before, heads = snapshot(frozen), (online.actor, online.critic)
    before_heads = [snapshot(part.parameters()) for part in heads]
    one_round(algorithm)
    assert frozen
    assert not changed(before, frozen)
    for earlier, part in zip(before_heads, heads, strict=True):
        assert changed(earlier, part.parameters())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU: DDPG on CUDA")
def test_it_learns_and_goes_back_on_cuda(make_ddpg: MakeDDPG) -> None:
    algorithm = make_ddpg("target", {}, {"normalize": True}, device="cuda")
    before = snapshot(algorithm.policy.online.parameters())
    assert all(math.isfinite(value) for value in one_round(algorithm).values())
    assert changed(before, algorithm.policy.online.parameters())
    online, target = algorithm.policy.online.buffers(), algorithm.policy.target.buffers()
    assert not changed(list(online), target)
    env = algorithm._env_runner.env
    policy = Policy(algorithm.policy, env.single_observation_space, env.single_action_space)
    actions, _ = policy.predict(algorithm._env_runner.observations)
    weights = {k: v.clone() for k, v in algorithm.policy.state_dict().items()}
    algorithm.load_state_dict(weights, copy.deepcopy(algorithm.state_dict()))
    again, _ = policy.predict(algorithm._env_runner.observations)
    np.testing.assert_array_equal(actions, again)
    assert all(math.isfinite(value) for value in one_round(algorithm).values())


# -- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["batch_size", "buffer_init_steps"])
def test_what_does_not_fit_into_the_buffer_is_refused(name: str) -> None:
    sizes = {"batch_size": 8, "buffer_init_steps": 8, "buffer_size": 32, name: 64}
    with pytest.raises(ValidationError, match=f"{name} 64 is over buffer_size 32: lower {name}"):
        DDPGHyperparameters(**sizes)


def test_a_critic_on_shared_encoders_sees_what_the_actor_sees() -> None:
    with pytest.raises(ValidationError, match="critic_observations needs critic: separate"):
        DeterministicSettings(critic="shared", critic_observations=("privileged",))


def test_choices_are_refused_before_anything_starts(
    make_run: Callable[..., RunSettings], registries: Registries
) -> None:
    with pytest.raises(UserError, match=r"^trainer: .* are Discrete\(3\); use trainer_type: ppo$"):
        Session(make_run("choice", {"trainer_type": "ddpg"}), registries)


def test_actions_without_bounds_are_refused(make_factory: Callable[..., NetworkFactory]) -> None:
    factory = make_factory(LINE.spaces, action_space=Box(-np.inf, 1.0, (2,), np.float32))
    with pytest.raises(UserError, match="within bounds"):
        DeterministicPolicy(factory, DeterministicSettings(), tau=0.1)


def test_updates_come_as_often_as_asked_for(
    make_ddpg: MakeDDPG, monkeypatch: pytest.MonkeyPatch
) -> None:
    hyper = {"buffer_init_steps": 32, "updates_per_step": 0.3, "policy_delay": 2}
    algorithm = make_ddpg("target", hyper)
    calls = {"_improve_critic": 0, "_improve_actor": 0}
    for name in calls:
        method = getattr(algorithm, name)

        def counted(indices: Any, name: str = name, method: Any = method) -> Any:
            calls[name] += 1
            return method(indices)

        monkeypatch.setattr(algorithm, name, counted)
    followed: list[tuple[int, int]] = []
    for _ in range(4):
        one_round(algorithm)
        followed.append((calls["_improve_critic"], calls["_improve_actor"]))
    # 16 transitions a round: 4.8 updates each from the second round on, made two by two.
    assert followed == [(0, 0), (4, 2), (8, 4), (14, 7)]


def test_the_warm_up_is_uniform_and_changes_no_weights(make_ddpg: MakeDDPG) -> None:
    environment = {"type": "target", "num_envs": 64}
    hyper = {"buffer_init_steps": 512, "buffer_size": 4096, "noise": {"type": "gaussian"}}
    algorithm = make_ddpg(environment, hyper, time_horizon=4)
    before = snapshot(algorithm.policy.parameters())
    statistics = one_round(algorithm)
    assert "Losses/Value Loss" not in statistics
    assert not changed(before, algorithm.policy.parameters())
    drawn = algorithm._buffer.actions(np.arange(256)).flatten()
    assert drawn.min() >= -1.0
    assert drawn.max() <= 1.0
    counts = torch.histc(drawn, bins=4, min=-1.0, max=1.0)
    # Chi squared with 3 degrees of freedom: over 16.3 once in a thousand seeds.
    assert ((counts - 128.0).square() / 128.0).sum() < 16.3
    one_round(algorithm)  # the 512th transition is there
    assert changed(before, algorithm.policy.parameters())


def test_noise_and_random_actions_explore(make_ddpg: MakeDDPG) -> None:
    environment = {"type": "target", "num_envs": 256}

    def explored(**hyperparameters: Any) -> Tensor:
        hyper = {"buffer_init_steps": 0, "buffer_size": 4096, "updates_per_step": 1e-9}
        algorithm = make_ddpg(environment, hyper | hyperparameters, time_horizon=8)
        with torch.no_grad():
            for parameter in algorithm.policy.online.actor_parameters():
                parameter.zero_()
        one_round(algorithm)
        return algorithm._buffer.actions(np.arange(8 * 256))

    quiet = explored(noise={"type": "gaussian", "sigma": 0.0})
    assert (quiet == 0.0).all()
    assert explored(noise={"type": "gaussian", "sigma": 0.3}).std() == pytest.approx(0.3, abs=0.01)
    mixed = explored(noise={"type": "gaussian", "sigma": 0.0}, random_actions=0.25)
    random = (mixed != 0.0).all(dim=1)
    assert ((mixed != 0.0).any(dim=1) == random).all()  # whole actions
    assert random.float().mean() == pytest.approx(0.25, abs=0.05)
    assert mixed[random].std() == pytest.approx(1.0 / math.sqrt(3.0), abs=0.05)
    drift = explored(noise={"type": "ornstein_uhlenbeck", "sigma": 0.1})
    steps = drift.reshape(2, 4, 512).std(dim=2)
    assert (steps.diff(dim=1) > 0.0).all()  # it builds up within an episode of four steps
    assert steps[1] == pytest.approx(steps[0], rel=0.15)  # and anew in the next one
    assert explored(noise={"type": "gaussian", "sigma": 9.0}).abs().max() == 1.0


def acted(
    algorithm: DDPG, observations: Observations, *, deterministic: bool
) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        return algorithm.policy.act(observations, deterministic=deterministic, generator=generator)


def test_noise_falls_along_its_schedule(make_ddpg: MakeDDPG) -> None:
    noise = {"type": "gaussian", "sigma": 0.4, "schedule": "linear"}
    algorithm = make_ddpg("target", {"noise": noise, "buffer_init_steps": 0})
    with torch.no_grad():
        for parameter in algorithm.policy.online.actor_parameters():
            parameter.zero_()
    observations = Observations({}, {"goal": torch.zeros(5_000, 2)})
    assert one_round(algorithm, 0.25)["Policy/Noise"] == pytest.approx(0.3)
    assert algorithm._hyperparameters.sigma(0.5) == pytest.approx(0.2)
    # Evaluation draws with the noise of the run's end, of which nothing is left here.
    drawn, hidden_state = acted(algorithm, observations, deterministic=False)
    assert torch.equal(drawn, acted(algorithm, observations, deterministic=True)[0])
    assert hidden_state.shape == algorithm.policy.initial_state(5_000).shape == (5_000, 0)


def test_evaluation_draws_with_noise_only_where_it_is_asked_to(make_ddpg: MakeDDPG) -> None:
    noise = {"type": "gaussian", "sigma": 0.2}
    algorithm = make_ddpg("target", {"noise": noise, "random_actions": 0.5})
    observations = Observations({}, {"goal": torch.zeros(5_000, 2)})
    best, _ = acted(algorithm, observations, deterministic=True)
    assert torch.equal(best, acted(algorithm, observations, deterministic=True)[0])
    drawn, _ = acted(algorithm, observations, deterministic=False)
    assert (drawn - best).std() == pytest.approx(0.2, abs=0.01)
    assert drawn.abs().max() <= 1.0


def test_learning_rates_follow_their_schedule(make_ddpg: MakeDDPG) -> None:
    rates = {"learning_rate": 4e-3, "critic_learning_rate": 8e-3}
    algorithm = make_ddpg("target", {**rates, "learning_rate_schedule": "linear"})
    statistics = one_round(algorithm, 0.75)
    assert statistics["Policy/Learning Rate"] == pytest.approx(1e-3)
    assert statistics["Policy/Critic Learning Rate"] == pytest.approx(2e-3)
    assert algorithm._optimizers["actor"].param_groups[0]["lr"] == pytest.approx(1e-3)
    assert algorithm._optimizers["critic"].param_groups[0]["lr"] == pytest.approx(2e-3)


# -- one round -----------------------------------------------------------------------------------


def test_statistics_name_everything_there_is_to_watch(make_ddpg: MakeDDPG) -> None:
    statistics = one_round(make_ddpg())
    assert set(statistics) == {
        "Losses/Policy Loss",
        "Losses/Value Loss",
        "Policy/Q Value",
        "Policy/Learning Rate",
        "Policy/Critic Learning Rate",
        "Policy/Noise",
    }
    assert all(type(value) is float and math.isfinite(value) for value in statistics.values())


def test_update_needs_a_collection_of_its_own(make_ddpg: MakeDDPG) -> None:
    algorithm = make_ddpg()
    with pytest.raises(RuntimeError, match="after collect"):
        algorithm.update(0.0)
    one_round(algorithm)
    with pytest.raises(RuntimeError, match="after collect"):
        algorithm.update(0.0)


def test_a_collection_is_given_back_before_the_updates(
    make_ddpg: MakeDDPG, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its images would take up memory beside those in the buffer."""
    algorithm = make_ddpg()
    algorithm.collect()
    steps = [weakref.ref(step) for step in algorithm._collected]
    left: list[int] = []
    improve_critic = algorithm._improve_critic

    def improve(indices: Tensor) -> dict[str, Tensor]:
        left.append(sum(step() is not None for step in steps))
        return improve_critic(indices)

    monkeypatch.setattr(algorithm, "_improve_critic", improve)
    algorithm.update(0.0)
    assert len(steps) == 4
    assert left == [0] * 16


def test_a_collection_that_is_begun_again_is_learned_from_once(make_ddpg: MakeDDPG) -> None:
    algorithm = make_ddpg()
    algorithm.collect()
    one_round(algorithm)
    assert len(algorithm._buffer) == 16


def test_a_loss_that_is_not_finite_stops_the_run_and_leaves_the_critic_as_it_is(
    make_ddpg: MakeDDPG,
) -> None:
    algorithm = make_ddpg()
    env = algorithm._env_runner.env
    step = env.step

    def huge(actions: np.ndarray) -> Any:
        observations, reward, *rest = step(actions)
        return observations, np.full_like(reward, 1e30), *rest  # its square is no float32

    env.step = huge  # type: ignore[method-assign]
    critic = snapshot(algorithm.policy.online.critic_parameters())
    algorithm.collect()
    with pytest.raises(NonFiniteError, match=r"step 16: the loss is (inf|nan), its gradient's"):
        algorithm.update(0.0)
    assert not changed(critic, algorithm.policy.online.critic_parameters())


def test_a_frame_is_encoded_once_as_long_as_it_is_in_view(
    make_ddpg: MakeDDPG, monkeypatch: pytest.MonkeyPatch
) -> None:
    hyper = {"buffer_init_steps": 0, "noise": {"type": "gaussian", "sigma": 0.0}}
    algorithm = make_ddpg("picture", hyper, time_horizon=9, encoders=CAMERA)
    online, encoded = algorithm.policy.online, []
    encode = online.encode_frames

    def counting(frames: dict[str, Tensor]) -> FrameFeatures:
        encoded.append(len(frames["camera"]))
        return encode(frames)

    monkeypatch.setattr(online, "encode_frames", counting)
    algorithm.collect()
    collected = algorithm._collected
    ended = [int(step.step.done.sum()) for step in collected[:-1]]
    assert sum(ended) > 0
    assert encoded == [len(collected[0].acted.actions), *filter(None, ended)]
    space = algorithm._env_runner.env.single_observation_space
    for step in collected:
        seen = to_tensors(step.observations, space, torch.device("cpu"))
        torch.testing.assert_close(step.acted.output, online.act(seen))


def test_a_collection_leaves_the_state_before_it_as_it_was(make_ddpg: MakeDDPG) -> None:
    """A run that is stopped in the middle of one is saved as of its beginning, without a copy."""
    noise = {"type": "ornstein_uhlenbeck"}
    algorithm = make_ddpg("picture", {"save_replay_buffer": True, "noise": noise}, encoders=CAMERA)
    for _ in range(3):
        one_round(algorithm)
    state = algorithm.state_dict()
    frames = state["replay_buffer"]["frames"]["entries"]["camera"]
    assert np.shares_memory(
        frames, algorithm.state_dict()["replay_buffer"]["frames"]["entries"]["camera"]
    )
    before = copy.deepcopy(state)
    algorithm.collect()
    for name in ("generator", "noise"):
        assert torch.equal(state[name], before[name])
    np.testing.assert_equal(state["replay_buffer"], before["replay_buffer"])


def test_going_back_to_a_state_repeats_everything(make_ddpg: MakeDDPG) -> None:
    hyper = {"save_replay_buffer": True, "noise": {"type": "ornstein_uhlenbeck"}}
    algorithm = make_ddpg("picture", {**hyper, "random_shift_px": 1}, encoders=CAMERA)
    for _ in range(6):  # the buffer of 64 transitions has come round
        one_round(algorithm)
    weights = {name: t.clone() for name, t in algorithm.policy.state_dict().items()}
    state = copy.deepcopy(algorithm.state_dict())
    world = copy.deepcopy(algorithm._env_runner.state_dict())
    one_round(algorithm)
    after = snapshot(algorithm.policy.parameters())
    algorithm.load_state_dict(weights, state)
    algorithm._env_runner.load_state_dict(world)
    assert changed(after, algorithm.policy.parameters())
    one_round(algorithm)
    assert not changed(after, algorithm.policy.parameters())


def test_a_run_resumed_without_its_buffer_fills_it_with_its_policy_first(
    make_ddpg: MakeDDPG,
) -> None:
    hyper = {"buffer_init_steps": 32, "noise": {"type": "gaussian", "sigma": 0.0}}
    algorithm = make_ddpg("target", hyper)
    for _ in range(3):
        one_round(algorithm)
    assert algorithm.state_dict()["replay_buffer"] is None
    other = make_ddpg("target", hyper, seed=1)
    other.load_state_dict(dict(algorithm.policy.state_dict()), algorithm.state_dict())
    other._env_runner.load_state_dict(copy.deepcopy(algorithm._env_runner.state_dict()))
    before = snapshot(other.policy.online.parameters())
    one_round(other)
    assert not changed(before, other.policy.online.parameters())
    # As many rows at a time as it acted on: others may be rounded otherwise by some processors.
    for rows in np.arange(16).reshape(-1, other._env_runner.num_envs):
        goal = other._buffer.observations(rows, ["goal"])
        assert torch.equal(other.policy.online.act(goal), other._buffer.actions(rows))
    one_round(other)
    assert changed(before, other.policy.online.parameters())


# -- learning ------------------------------------------------------------------------------------


def learned(algorithm: DDPG, rounds: int) -> tuple[float, float]:
    """Mean reward per step of the first and of the last five rounds."""
    parts = []
    for number in range(rounds):
        algorithm.collect()
        algorithm.update(number / rounds)
        parts.append(algorithm._env_runner.pop_finished())
    first, last = concatenate(parts[:5]), concatenate(parts[-5:])
    return float((first.rewards / first.lengths).mean()), float(
        (last.rewards / last.lengths).mean()
    )


BIG = {
    "batch_size": 64,
    "buffer_size": 4096,
    "buffer_init_steps": 256,
    "updates_per_step": 0.1,
    "learning_rate": 3e-3,
    "noise": {"type": "gaussian", "sigma": 0.1},
}


@pytest.mark.parametrize("gamma", [0.0, 0.9])
@pytest.mark.parametrize("privileged", [False, True])
def test_it_learns_to_hit_a_point(make_ddpg: MakeDDPG, gamma: float, privileged: bool) -> None:
    network = {"hidden_units": 32, "num_layers": 2, "normalize": True}
    if privileged:
        network["critic_observations"] = ["goal", "privileged"]
    environment = {"type": "target", "num_envs": 16, "privileged": privileged}
    first, last = learned(make_ddpg(environment, {**BIG, "gamma": gamma}, network), 60)
    assert first < -0.6
    assert last > -0.25


@pytest.mark.parametrize(("critic", "rate"), [("shared", 3e-3), ("separate", 1e-3)])
def test_it_learns_from_images(make_ddpg: MakeDDPG, critic: str, rate: float) -> None:
    environment = {"type": "picture", "num_envs": 16}
    # An actor with encoders of its own has to be slower than the critic that guides it.
    rates = {"learning_rate": rate, "critic_learning_rate": 3e-3}
    algorithm = make_ddpg(
        environment,
        {**BIG, **rates, "gamma": 0.5, "n_step": 2},
        {"hidden_units": 32, "num_layers": 2, "critic": critic},
        encoders=CAMERA,
    )
    first, last = learned(algorithm, 60)
    assert first < -0.5
    assert last > -0.25
