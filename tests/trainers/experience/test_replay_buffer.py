"""The replay buffer against a model that keeps every transition as it came, and by hand."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given
from hypothesis import strategies as st

from encoders.spaces import DepthImage
from trainers.common.errors import UserError
from trainers.experience.env_runner import Step
from trainers.experience.replay_buffer import ReplayBuffer
from trainers.networks.observations import Observations
from trainers.saving.serialization import flatten, unflatten

CPU = torch.device("cpu")
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")),
]
SIDE_PX = 2
SPACE = gymnasium.spaces.Dict(
    {
        "depth": DepthImage(SIDE_PX, SIDE_PX),
        "state": Box(-np.inf, np.inf, (2,), np.float32),
        "height": DepthImage(1, 1),
    }
)
NAMES = tuple(SPACE.spaces)
EVENTS = ("moves", "still", "terminated", "truncated", "truncated still", "both", "static")


@dataclass(frozen=True)
class Seen:
    """One observation: the number of its picture, and that of its state."""

    picture: int
    state: int


@dataclass(frozen=True)
class Kept:
    """One transition; `after` is what the action led to, before any reset."""

    before: Seen
    action: float
    reward: float
    terminated: bool
    done: bool
    after: Seen


def raw(seen: list[Seen]) -> dict[str, np.ndarray]:
    pictures = np.array([one.picture for one in seen], np.uint16)[:, None, None, None]
    states = np.array([[one.state, -one.state] for one in seen], np.float32)
    return {
        "depth": pictures.repeat(SIDE_PX, 1).repeat(SIDE_PX, 2),
        "state": states,
        "height": pictures + 7,
    }


def as_seen(observations: Observations) -> list[Seen]:
    assert observations.frame_index is None
    depth, height = (observations.frames[name].cpu().numpy() for name in ("depth", "height"))
    assert (depth == height - 7).all()
    state = observations.vectors["state"].cpu().numpy()
    assert (state[:, 0] == -state[:, 1]).all()
    return [Seen(int(p), int(s)) for p, s in zip(depth[:, 0, 0, 0], state[:, 0], strict=True)]


class World:
    """N environments that do what they are told; every picture and state has its own number."""

    def __init__(self, num_envs: int, steps: int):
        self.num_envs, self.steps = num_envs, steps
        self.numbers = iter(range(30_000, 90_000))
        self.now = [self.new() for _ in range(num_envs)]
        self.histories: list[list[Kept]] = [[] for _ in range(num_envs)]

    def new(self) -> Seen:
        return Seen(next(self.numbers) % 2**16, next(self.numbers))

    def step(self, buffer: ReplayBuffer, events: list[str]) -> None:
        before, then, final, same = list(self.now), [], [], []
        numbers = [float(next(self.numbers)) for _ in events]
        for env, event in enumerate(events):
            still = event in ("still", "truncated still", "static")
            after = Seen(before[env].picture, next(self.numbers)) if still else self.new()
            terminated, done = event in ("terminated", "both"), event not in ("moves", "still")
            final.append(after)
            then.append(self.new() if done else after)
            if event == "static":
                then[-1] = Seen(before[env].picture, next(self.numbers))
            same.append(event in ("still", "static"))
            kept = Kept(before[env], numbers[env], -numbers[env], terminated, done, after)
            self.histories[env] = [*self.histories[env], kept][-self.steps :]
        self.now = then
        truncated = ["truncated" in event or event in ("both", "static") for event in events]
        terminated = [event in ("terminated", "both") for event in events]
        step = Step(
            reward=-np.array(numbers),
            terminated=np.array(terminated),
            truncated=np.array(truncated),
            same_frame=np.array(same),
            final_observations=raw(final) if any(truncated) or any(terminated) else None,
        )
        buffer.add(raw(before), np.array(numbers, np.float32)[:, None], step, raw(then))

    def frames(self) -> int:
        """How many pictures there are to keep."""
        kept = set()
        for env, history in enumerate(self.histories):
            kept.add(self.now[env].picture)
            for one in history:
                kept.add(one.before.picture)
                if one.done and not one.terminated:
                    kept.add(one.after.picture)
        return len(kept)


def n_step(history: list[Kept], first: int, gamma: float, steps: int) -> tuple[float, float, Kept]:
    total, power = 0.0, 0
    for one in history[first : first + steps]:
        total += gamma**power * one.reward
        power += 1
        if one.done:
            break
    return total, 0.0 if one.terminated else gamma**power, one


def places_of(buffer: ReplayBuffer, device: torch.device = CPU) -> torch.Tensor:
    """Every place that can be drawn, found by drawing; in order of age after a full ring."""
    generator = torch.Generator(device).manual_seed(0)
    return buffer.sample((60 * len(buffer),), generator).unique()


def check(
    buffer: ReplayBuffer, world: World, gamma: float, steps: int, device: torch.device = CPU
) -> None:
    expected = {
        one.action: (history, number)
        for history in world.histories
        for number, one in enumerate(history)
    }
    assert len(buffer) == len(expected)
    indices = places_of(buffer, device)
    actions = buffer.actions(indices)[:, 0].tolist()
    assert sorted(actions) == sorted(expected)
    before = as_seen(buffer.observations(indices, NAMES))
    after = as_seen(buffer.next_observations(indices, NAMES))
    rewards = buffer.rewards(indices).tolist()
    totals, discounts, last = buffer.returns(indices, gamma, steps)
    assert totals.dtype == discounts.dtype == torch.float32
    led_to = as_seen(buffer.next_observations(last, NAMES))
    for i, action in enumerate(actions):
        history, number = expected[action]
        one = history[number]
        assert before[i] == one.before
        assert rewards[i] == one.reward
        assert one.terminated or after[i] == one.after
        total, discount, final = n_step(history, number, gamma, steps)
        assert totals[i].item() == pytest.approx(total, rel=1e-5)
        assert discounts[i].item() == pytest.approx(discount, rel=1e-6)
        assert final.terminated or led_to[i] == final.after
    kept = buffer.state_dict()["frames"]
    assert len(kept["entries"]["depth"]) - len(kept["free"]) == world.frames()


@st.composite
def scripts(draw: st.DrawFn) -> tuple[int, int, list[list[str]]]:
    num_envs, steps = draw(st.integers(1, 3)), draw(st.integers(1, 6))
    moment = st.lists(st.sampled_from(EVENTS), min_size=num_envs, max_size=num_envs)
    return num_envs, steps, draw(st.lists(moment, min_size=1, max_size=25))


@pytest.mark.parametrize("device", DEVICES)
@given(scripts(), st.floats(0.0, 1.0), st.integers(1, 4), st.integers(0, 25))
def test_what_is_drawn_is_what_went_in(
    device: str, script: tuple[int, int, list[list[str]]], gamma: float, n: int, moved_at: int
) -> None:
    num_envs, steps, moments = script
    world = World(num_envs, steps)
    size = (num_envs, steps * num_envs, torch.device(device))
    buffer = ReplayBuffer(SPACE, 1, *size)
    for number, events in enumerate(moments):
        if number == moved_at:  # into another buffer, which has a past of its own
            state = buffer.state_dict()
            buffer = ReplayBuffer(SPACE, 1, *size)
            elsewhere = World(num_envs, steps)
            for _ in range(8):  # that takes more images than most
                elsewhere.step(buffer, ["truncated"] * num_envs)
            buffer.load_state_dict(unflatten(*flatten(state)))
        world.step(buffer, events)
        check(buffer, world, gamma, n, torch.device(device))


def test_only_what_is_asked_for_is_fetched() -> None:
    world, buffer = World(1, 4), ReplayBuffer(SPACE, 1, 1, 4, CPU)
    for event in ("moves", "truncated"):
        world.step(buffer, [event])
    for fetch in (buffer.observations, buffer.next_observations):
        part = fetch(torch.tensor([1]), ["state"])
        assert (set(part.vectors), part.frames, part.frame_index) == ({"state"}, {}, None)
        part = fetch(torch.tensor([1]), ["height"])
        assert (part.vectors, set(part.frames)) == ({}, {"height"})


def test_transitions_are_drawn_alike_wherever_they_lie_in_the_ring() -> None:
    world, buffer = World(2, 3), ReplayBuffer(SPACE, 1, 2, 6, CPU)
    for _ in range(8):
        world.step(buffer, ["moves", "moves"])
    drawn = buffer.sample((2_000, 3), torch.Generator().manual_seed(1))
    counts = np.unique(drawn.numpy(), return_counts=True)[1]
    assert len(counts) == 6
    # Chi squared with 5 degrees of freedom: over 20.5 once in a thousand seeds.
    assert ((counts - 1_000) ** 2 / 1_000).sum() < 20.5


# -- by hand -------------------------------------------------------------------------------------

LINE = gymnasium.spaces.Dict({"x": Box(-np.inf, np.inf, (1,), np.float32)})


def line_of(
    ends: str, rewards: list[float], *, final: float = 99.0, capacity: int = 9
) -> ReplayBuffer:
    """One environment at x = 0, 1, 2, ...: `ends` says `-`, `t`erminated or `c`ut off per step."""
    buffer = ReplayBuffer(LINE, 1, 1, capacity, CPU)
    for number, (end, reward) in enumerate(zip(ends, rewards, strict=True)):
        step = Step(
            reward=np.array([reward]),
            terminated=np.array([end == "t"]),
            truncated=np.array([end == "c"]),
            same_frame=np.zeros(1, bool),
            final_observations=None if end == "-" else {"x": np.array([[final]], np.float32)},
        )
        x = np.array([[number]], np.float32)
        buffer.add({"x": x}, np.zeros((1, 1), np.float32), step, {"x": x + 1})
    return buffer


def estimates(buffer: ReplayBuffer, steps: int) -> list[tuple[float, float, float]]:
    """Return, discount and where the return leads to, of every transition, with gamma 0.5."""
    returns, discounts, last = buffer.returns(torch.arange(len(buffer)), 0.5, steps)
    x = buffer.next_observations(last, ["x"]).vectors["x"][:, 0]
    return list(zip(returns.tolist(), discounts.tolist(), x.tolist(), strict=True))


def test_one_step_ahead() -> None:
    buffer = line_of("-tc-", [1.0, 2.0, 4.0, 8.0])
    ahead = estimates(buffer, 1)
    assert ahead[0] == (1.0, 0.5, 1.0)
    assert ahead[1][:2] == (2.0, 0.0)  # nothing follows a terminal state
    assert ahead[2] == (4.0, 0.5, 99.0)  # what was cut off is worth what it truly led to
    assert ahead[3] == (8.0, 0.5, 4.0)  # the present observation


def test_three_steps_ahead_end_with_the_episode_and_with_what_is_known() -> None:
    buffer = line_of("---c-t-----", [1.0] * 11, capacity=11)
    ahead = estimates(buffer, 3)
    assert ahead[0] == (1.75, 0.125, 3.0)
    assert ahead[1] == (1.75, 0.125, 99.0)  # its third step is the one that was cut off
    assert ahead[2] == (1.5, 0.25, 99.0)
    assert ahead[3] == (1.0, 0.5, 99.0)
    assert [one[:2] for one in ahead[4:6]] == [(1.5, 0.0), (1.0, 0.0)]
    assert ahead[6:9] == [(1.75, 0.125, 9.0), (1.75, 0.125, 10.0), (1.75, 0.125, 11.0)]
    assert ahead[9:] == [(1.5, 0.25, 11.0), (1.0, 0.5, 11.0)]


def test_environments_do_not_see_each_others_rewards() -> None:
    buffer = ReplayBuffer(LINE, 1, 2, 8, CPU)
    for number in range(3):
        step = Step(
            np.array([1.0, 100.0]), np.zeros(2, bool), np.zeros(2, bool), np.zeros(2, bool), None
        )
        x = np.array([[number], [10.0 + number]], np.float32)
        buffer.add({"x": x}, np.zeros((2, 1), np.float32), step, {"x": x + 1})
    returns, _, last = buffer.returns(torch.arange(2), 1.0, 3)
    assert returns.tolist() == [3.0, 300.0]
    assert buffer.next_observations(last, ["x"]).vectors["x"][:, 0].tolist() == [3.0, 13.0]


# -- memory, types, mistakes ---------------------------------------------------------------------


def frames_in_use(space: gymnasium.spaces.Dict, events: list[str], transitions: int) -> float:
    """Bytes of the images' memory that was ever touched, per transition and image."""
    image = np.zeros((4, *space["depth"].shape), np.uint16)  # type: ignore[misc]
    buffer = ReplayBuffer(space, 1, 4, transitions, CPU)
    for number in range(3 * transitions // 4):
        event = events[number % len(events)]
        cut = np.full(4, event == "truncated")
        step = Step(np.zeros(4), np.zeros(4, bool), cut, np.full(4, event == "still"), None)
        if cut.any():
            step = Step(step.reward, step.terminated, cut, step.same_frame, {"depth": image})
        buffer.add({"depth": image}, np.zeros((4, 1), np.float32), step, {"depth": image})
    touched = buffer.state_dict()["frames"]["entries"]["depth"]
    return float(touched.nbytes / image[0].nbytes / transitions)


def test_a_frame_of_a_whole_episode_is_kept_once() -> None:
    space = gymnasium.spaces.Dict({"depth": DepthImage(8, 8)})
    episode = ["still"] * 9 + ["truncated"]  # whose last image is the same, too
    assert frames_in_use(space, episode, 400) < 0.12


def test_a_stream_is_kept_once() -> None:
    space = gymnasium.spaces.Dict({"depth": DepthImage(8, 8)})
    assert frames_in_use(space, ["moves"], 400) < 1.02


def test_vectors_keep_their_type_and_images_are_not_looked_for() -> None:
    space = gymnasium.spaces.Dict({"x": Box(-1.0, 1.0, (1,), np.float64)})
    buffer = ReplayBuffer(space, 1, 1, 4, CPU)
    nothing = np.zeros(1, bool)
    x = np.array([[0.1]])
    buffer.add(
        {"x": x},
        np.zeros((1, 1), np.float32),
        Step(np.zeros(1), nothing, nothing, nothing, None),
        {"x": x},
    )
    observations = buffer.observations(torch.tensor([0, 0]), ["x"])
    assert observations.vectors["x"].dtype == torch.float64
    assert observations.frames == {}
    assert observations.frame_index is None


def test_what_was_added_is_not_changed_when_the_environment_writes_over_it() -> None:
    world, buffer = World(1, 4), ReplayBuffer(SPACE, 1, 1, 4, CPU)
    shown = raw([Seen(1, 2)])
    nothing = np.zeros(1, bool)
    buffer.add(
        shown,
        np.zeros((1, 1), np.float32),
        Step(np.zeros(1), nothing, nothing, nothing, None),
        raw([world.new()]),
    )
    for array in shown.values():
        array[:] = 0
    assert as_seen(buffer.observations(torch.tensor([0]), NAMES)) == [Seen(1, 2)]


def test_a_state_is_no_copy() -> None:
    world, buffer = World(1, 4), ReplayBuffer(SPACE, 1, 1, 4, CPU)
    world.step(buffer, ["moves"])
    first, second = (buffer.state_dict()["frames"]["entries"]["depth"] for _ in range(2))
    assert np.shares_memory(first, second)


def test_a_buffer_larger_than_any_memory_is_the_users_mistake() -> None:
    with pytest.raises(
        UserError, match=r"buffer_size: to keep 10(,0{3}){4} transitions needs .* GB, .* lower it$"
    ):
        ReplayBuffer(LINE, 1, 1, 10**13, CPU)


def test_the_state_of_a_buffer_of_another_size_is_refused() -> None:
    state: Any = copy.deepcopy(line_of("--", [0.0, 0.0], capacity=4).state_dict())
    with pytest.raises(ValueError, match="buffer_size must stay as it was"):
        ReplayBuffer(LINE, 1, 1, 5, CPU).load_state_dict(state)
