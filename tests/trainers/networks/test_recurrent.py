"""Recurrent layers against plain loops over cells, and what they are good for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from trainers import evaluation
from trainers.evaluation import evaluate
from trainers.experience.episodes import concatenate
from trainers.networks.recurrent import MemorySettings, Recurrent, Sequences, number_sequences
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings, SettingsError

INPUTS, UNITS = 3, 4
KINDS = ("lstm", "gru")
ragged = st.lists(st.integers(1, 6), min_size=1, max_size=8)
seeds = st.integers(0, 2**31)


def recurrent(kind: str, seed: int = 0) -> Recurrent:
    torch.manual_seed(seed)
    layer = Recurrent(INPUTS, MemorySettings(type=kind, memory_size=UNITS)).double()
    with torch.no_grad():  # biases begin with zeros, and would hide a mistake
        for parameter in layer.parameters():
            parameter.normal_()
    return layer


def some(layer: Recurrent, lengths: list[int], *, grad: bool = False) -> tuple[Tensor, Sequences]:
    vectors = torch.randn(sum(lengths), INPUTS, dtype=torch.float64, requires_grad=grad)
    state = torch.randn(len(lengths), layer.state_size, dtype=torch.float64, requires_grad=grad)
    return vectors, Sequences(torch.tensor(lengths), state)


def plain_loop(
    kind: str, layer: Recurrent, vectors: Tensor, sequences: Sequences
) -> tuple[Tensor, Tensor]:
    """One sequence after the other and step by step, with torch's cells."""
    cell = (nn.LSTMCell if kind == "lstm" else nn.GRUCell)(INPUTS, UNITS).double()
    weights = {name.removesuffix("_l0"): p for name, p in layer.layer.named_parameters()}
    outputs, states = [], []
    for part, state in zip(
        vectors.split(sequences.lengths.tolist()), sequences.hidden_state, strict=True
    ):
        hidden: Any = state[None] if kind == "gru" else (state[None, :UNITS], state[None, UNITS:])
        for vector in part:
            hidden = torch.func.functional_call(cell, weights, (vector[None], hidden))
            outputs.append(hidden if kind == "gru" else hidden[0])
        states.append(hidden if kind == "gru" else torch.cat(hidden, dim=1))
    return torch.cat(outputs), torch.cat(states)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None)
@given(lengths=ragged, seed=seeds)
def test_it_says_what_a_plain_loop_says_and_has_its_gradients(
    kind: str, lengths: list[int], seed: int
) -> None:
    layer = recurrent(kind, seed)
    vectors, sequences = some(layer, lengths, grad=True)
    leaves = [vectors, sequences.hidden_state, *layer.parameters()]
    answers = []
    for run in (layer, lambda *given: plain_loop(kind, layer, *given)):
        outputs, states = run(vectors, sequences)
        weighted = outputs @ torch.arange(1.0, UNITS + 1, dtype=torch.float64)
        loss = (weighted.cumsum(0) * weighted).sum() + states.square().sum()
        answers.append([outputs, states, *torch.autograd.grad(loss, leaves)])
    for answer, expected in zip(*answers, strict=True):
        torch.testing.assert_close(answer, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None)
@given(lengths=ragged, seed=seeds, data=st.data())
def test_a_sequence_cut_in_two_goes_on_from_its_state(
    kind: str, lengths: list[int], seed: int, data: st.DataObject
) -> None:
    layer = recurrent(kind, seed)
    vectors, sequences = some(layer, lengths)
    whole, after = layer(vectors, sequences)
    # Each sequence is cut after some of its steps; all first parts are run through, then the rest.
    cuts = [data.draw(st.integers(1, length)) for length in lengths]
    parts = list(zip(vectors.split(lengths), whole.split(lengths), cuts, strict=True))
    first, state = layer(
        torch.cat([part[:cut] for part, _, cut in parts]),
        Sequences(torch.tensor(cuts), sequences.hidden_state),
    )
    torch.testing.assert_close(first, torch.cat([out[:cut] for _, out, cut in parts]))
    left = torch.tensor(lengths) - torch.tensor(cuts)
    longer = left > 0
    torch.testing.assert_close(state[~longer], after[~longer])
    if longer.any():
        rest = torch.cat([part[cut:] for part, _, cut in parts])
        second, state = layer(rest, Sequences(left[longer], state[longer]))
        torch.testing.assert_close(second, torch.cat([out[cut:] for _, out, cut in parts]))
        torch.testing.assert_close(state, after[longer])


@pytest.mark.parametrize("kind", KINDS)
def test_single_observations_are_sequences_of_one_step(kind: str) -> None:
    layer = recurrent(kind)
    vectors, sequences = some(layer, [1, 1, 1])
    outputs, state = layer(vectors, Sequences.single(sequences.hidden_state))
    expected, expected_state = plain_loop(kind, layer, vectors, sequences)
    torch.testing.assert_close(outputs, expected)
    torch.testing.assert_close(state, expected_state)
    assert outputs.shape == (3, layer.features_dim)
    assert state.shape == (3, layer.state_size)


@pytest.mark.parametrize("kind", KINDS)
def test_curvature_reaches_through_time(kind: str) -> None:
    layer = recurrent(kind)  # TRPO needs second derivatives
    vectors, sequences = some(layer, [3, 1, 2], grad=True)
    assert torch.autograd.gradgradcheck(lambda x: layer(x, sequences)[0], vectors)


def test_steps_are_numbered_by_episode_and_at_most_so_many_have_a_number() -> None:
    done = np.zeros((5, 3), bool)
    done[1, 0] = done[2, 1] = done[4, 2] = True
    whole = [[0, 1, 2], [0, 1, 2], [3, 1, 2], [3, 4, 2], [3, 4, 2]]
    assert number_sequences(done, 64).tolist() == whole
    assert number_sequences(done, 5).tolist() == whole
    in_twos = [[0, 1, 2], [0, 1, 2], [3, 4, 5], [3, 6, 5], [7, 6, 8]]
    assert number_sequences(done, 2).tolist() == in_twos
    assert number_sequences(done, 1).tolist() == np.arange(15).reshape(5, 3).tolist()


@given(st.integers(1, 9), st.integers(1, 4), st.integers(1, 10), seeds)
def test_sequences_are_as_long_as_they_can_be(
    steps: int, count: int, length: int, seed: int
) -> None:
    done = np.random.default_rng(seed).random((steps, count)) < 0.3
    numbers = number_sequences(done, length)
    assert sorted(set(numbers.ravel().tolist())) == list(range(numbers.max() + 1))
    assert all(len(set(np.nonzero(numbers == n)[1])) == 1 for n in range(numbers.max() + 1))
    for column, ends in zip(numbers.T.tolist(), done.T, strict=True):
        for t in range(1, steps):
            full = column[max(0, t - length) : t] == [column[t - 1]] * length
            assert (column[t] != column[t - 1]) == (ends[t - 1] or full)
            assert column[t] not in column[: t - 1] or column[t] == column[t - 1]


# -- settings ------------------------------------------------------------------------------------


def remembering(memory: Any, trainer_type: str = "ppo") -> dict[str, Any]:
    return {"trainer_type": trainer_type, "network_settings": {"memory": memory}}


def test_memory_has_ml_agents_defaults(make_run: Callable[..., RunSettings]) -> None:
    trainer: Any = make_run("target", remembering({})).trainer.settings
    memory = trainer.network_settings.memory
    assert (memory.type, memory.memory_size, memory.sequence_length) == ("lstm", 128, 64)
    trainer = make_run("target").trainer.settings
    assert trainer.network_settings.memory is None


@pytest.mark.parametrize(
    ("memory", "key", "reason"),
    [
        ({"type": "rnn"}, "memory.type", "should be 'lstm' or 'gru'"),
        ({"memory_size": 0}, "memory.memory_size", "should be greater than or equal to 1"),
        ({"sequence_length": 0}, "memory.sequence_length", "should be greater than or equal to 1"),
        ({"sequence_lenght": 8}, "memory.sequence_lenght", "did you mean 'sequence_length'?"),
        ("lstm", "memory", "'lstm'"),
    ],
)
def test_wrong_settings_name_their_key_and_what_is_allowed(
    make_run: Callable[..., RunSettings], memory: Any, key: str, reason: str
) -> None:
    with pytest.raises(SettingsError) as caught:
        make_run("target", remembering(memory))
    assert f"trainer.network_settings.{key}: " in str(caught.value)
    assert reason in str(caught.value)


def test_ddpg_has_no_memory(make_run: Callable[..., RunSettings]) -> None:
    with pytest.raises(
        SettingsError, match=r"network_settings\.memory: ddpg has no memory.* ppo or trpo"
    ):
        make_run("target", remembering({}, "ddpg"))


# -- learning ------------------------------------------------------------------------------------

RECALL = {"type": "recall", "num_envs": 16}  # episodes of four steps, of which one shows the signal
# Right at the first step and guessing one of three at the others, the best that can be done without
# memory is a mean reward of -(0 + 3 * 2/3) / 4.
WITHOUT_MEMORY = -0.5
# The mean of 128 episodes lies further than this from its expectation once in 30,000 times:
# 4 standard deviations of sqrt(3 * 1/3 * 2/3 / 128) / 4.
CHANCE = 0.08
BIG = {"batch_size": 64, "buffer_size": 256, "gamma": 0.0}
FAST = {**BIG, "num_epoch": 4, "learning_rate": 1e-2, "beta": 0.0}


def small(kind: str, length: int = 8) -> dict[str, Any]:
    return {"memory": {"type": kind, "memory_size": 16, "sequence_length": length}}


def learned(algorithm: Any, rounds: int) -> float:
    """Mean reward of a step in the last two rounds, which are 128 episodes."""
    parts = []
    for number in range(rounds):
        algorithm.collect()
        algorithm.update(number / rounds)
        parts.append(algorithm._env_runner.pop_finished())
    last = concatenate(parts[-2:])
    assert len(last) == 128
    return float((last.rewards / last.lengths).mean())


@pytest.mark.parametrize(("kind", "critic"), [("lstm", "separate"), ("gru", "shared")])
def test_what_was_seen_before_can_be_acted_upon(
    make_ppo: Callable[..., Any], kind: str, critic: str
) -> None:
    network = {**small(kind), "critic": critic}
    assert learned(make_ppo(RECALL, FAST, network), 15) > -0.05


def test_a_separate_critic_remembers_what_it_alone_sees(make_ppo: Callable[..., Any]) -> None:
    environment = {**RECALL, "privileged": True}
    network = {**small("gru"), "critic": "separate", "critic_observations": ["privileged"]}
    assert learned(make_ppo(environment, FAST, network), 15) > -0.05


def test_without_memory_it_is_left_to_chance(make_ppo: Callable[..., Any]) -> None:
    assert learned(make_ppo(RECALL, FAST), 20) == pytest.approx(WITHOUT_MEMORY, abs=CHANCE)


def test_sequences_shorter_than_episodes_will_do(make_ppo: Callable[..., Any]) -> None:
    hyper = {**FAST, "batch_size": 50}  # batches cut them, too
    assert learned(make_ppo(RECALL, hyper, small("gru", 3)), 20) > -0.05


def test_trpo_remembers_too(make_trpo: Callable[..., Any]) -> None:
    assert learned(make_trpo(RECALL, {**BIG, "delta": 0.1}, small("gru")), 20) > -0.15


def test_an_evaluated_policy_remembers_within_an_episode(
    learn: Callable[..., Any],
    write_run: Callable[..., Any],
    registries: Registries,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(evaluation, "load_registries", lambda: registries)
    trainer = {"max_steps": 15 * 256, "hyperparameters": FAST, "network_settings": small("lstm")}
    ended = learn(write_run(RECALL, trainer), "--run-id", "recall")
    assert ended.code == 0, ended.errors
    report = evaluate(str(ended.results / "recall"), episodes=100).report
    assert report["success"] > 0.95  # at the last step of each; one of three by chance
