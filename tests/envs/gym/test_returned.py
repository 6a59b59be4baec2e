"""What an environment may return, and the words for what it may not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Tuple

from envs.gym.returned import WrongReturn, check_observation, checked_reset, checked_step

VECTOR = Box(-1.0, 1.0, (2,), np.float32)
BYTES = Box(0, 255, (1, 2, 3), np.uint8)
PAIR = Tuple([Discrete(3), VECTOR])
BOTH = Dict({"x": VECTOR, "door": Discrete(3, start=1)})


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (VECTOR, np.zeros(2)),  # float64 becomes float32, and bounds are not looked at
        (VECTOR, np.array([7, 8])),
        (VECTOR, [0.5, 1.0]),
        (BYTES, np.zeros((1, 2, 3), np.uint8)),
        (Box(-1.0, 1.0, ()), 0.5),
        (Discrete(3, start=1), np.int64(3)),
        (BOTH, {"x": np.zeros(2), "door": 1, "more": None}),
        (PAIR, (1, np.zeros(2))),
    ],
)
def test_what_becomes_an_observation_is_taken(space: Any, value: Any) -> None:
    check_observation(space, value)


@pytest.mark.parametrize(
    ("space", "value", "message"),
    [
        (VECTOR, np.zeros(3), "the observation is an array of float64 (3,), and should be an array "
                              "of float32 (2,)"),
        (BYTES, np.zeros((1, 2, 3)), "the observation is an array of float64 (1, 2, 3), and should "
                                     "be an array of uint8 (1, 2, 3)"),
        (VECTOR, None, "the observation is None (NoneType), and should be an array of float32 "
                       "(2,)"),
        (VECTOR, "x" * 99, f"the observation is '{'x' * 59}... (str), and should be an array of "
                           "float32 (2,)"),
        (BOTH, {"x": np.zeros(2)}, "the observation has the keys ['x'], and should have ['door', "
                                   "'x'], and 'door' is missing"),
        (BOTH, {"x": np.zeros(2), "door": 0}, "the observation 'door' is 0 (int), and should be of "
                                              "Discrete(3, start=1)"),
        (PAIR, (1, np.zeros(3)), "the observation 1 is an array of float64 (3,), and should be an "
                                 "array of float32 (2,)"),
        (PAIR, (1,), "the observation is a tuple of 1, and should be a tuple of 2"),
        (BOTH, 1.0, "the observation is 1.0 (float), and should be a dictionary with the keys "
                    "['door', 'x']"),
    ],
)  # fmt: skip
def test_what_does_not_is_named_with_what_was_expected(
    space: Any, value: Any, message: str
) -> None:
    with pytest.raises(WrongReturn) as refused:
        check_observation(space, value)
    assert str(refused.value) == message


@pytest.mark.parametrize("reward", [0, -1.5, True, np.float32(2), np.int8(3), np.array(4.0)])
@pytest.mark.parametrize("flag", [True, False, np.bool_(True), 0, 1, np.array(True)])
def test_numbers_and_flags_of_any_type_are_taken(reward: Any, flag: Any) -> None:
    *_, taken, terminated, truncated, info = checked_step(
        VECTOR, (np.zeros(2), reward, flag, False, {"a": 1})
    )
    assert taken is reward
    assert terminated is bool(flag)
    assert truncated is False
    assert info == {"a": 1}


@pytest.mark.parametrize("reward", ["1", None, np.zeros(1), [1.0], 1j, {}])
def test_other_rewards_are_refused(reward: Any) -> None:
    with pytest.raises(WrongReturn, match=r"^the reward is .*, and should be a number$"):
        checked_step(VECTOR, (np.zeros(2), reward, False, False, {}))


@pytest.mark.parametrize("flag", ["False", None, 2, np.zeros(2, bool), 0.5, []])
@pytest.mark.parametrize(("place", "name"), [(2, "terminated"), (3, "truncated")])
def test_other_flags_are_refused(flag: Any, place: int, name: str) -> None:
    returned = [np.zeros(2), 0.0, False, False, {}]
    returned[place] = flag
    with pytest.raises(WrongReturn, match=rf"^`{name}` is .*, and should be True or False$"):
        checked_step(VECTOR, tuple(returned))


def test_tuples_have_their_length_and_infos_are_dictionaries() -> None:
    good = np.zeros(2)
    for returned in (good, [good, {}], (good,), (good, {}, {})):
        with pytest.raises(WrongReturn, match=r"^what `reset` .* a tuple \(observation, info\)$"):
            checked_reset(VECTOR, returned)
    with pytest.raises(WrongReturn, match=r"^what `step` .* is a tuple of 4, .* a tuple \(obs"):
        checked_step(VECTOR, (good, 0.0, False, {}))
    with pytest.raises(WrongReturn, match=r"^the info is None \(NoneType\), .* a dictionary$"):
        checked_reset(VECTOR, (good, None))
