from __future__ import annotations

import json
import math
from collections import OrderedDict
from enum import IntEnum
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trainers.saving.serialization import flatten, mismatch, snapshot, unflatten

TORCH_DTYPES = [
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.float8_e4m3fn),
    *(torch.bool, torch.uint8, torch.int8, torch.uint16, torch.int16, torch.int32, torch.int64),
    *(torch.uint32, torch.uint64, torch.complex64, torch.complex128),
]
NUMPY_DTYPES = [
    *("bool", "uint8", "int8", "uint16", "int32", "uint64", "int64", ">i4", ">f8"),
    *("float16", "float32", "float64", "complex64", "complex128"),
]


def through_files(state: Any) -> Any:
    """Flatten, go through the very bytes that a file would hold, and come back."""
    skeleton, arrays = flatten(state)
    text = json.dumps(skeleton, allow_nan=False)
    return unflatten(json.loads(text), safetensors.numpy.load(safetensors.numpy.save(arrays)))


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert list(a) == list(b)  # the order too
        assert [type(key) for key in a] == [type(key) for key in b]
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, torch.Tensor):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        assert bytes(a.contiguous().untyped_storage()) == bytes(b.contiguous().untyped_storage())
    elif isinstance(a, (np.ndarray, np.generic)):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, float):
        assert a.hex() == b.hex()  # tells -0.0 from 0.0 and takes nan for equal
    else:
        assert a == b


def tensors() -> st.SearchStrategy[torch.Tensor]:
    def build(dtype: torch.dtype, shape: tuple[int, ...], seed: int) -> torch.Tensor:
        size = torch.empty(shape, dtype=dtype).nbytes
        if dtype == torch.bool:
            return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < 0.5
        raw = np.random.default_rng(seed).bytes(size)
        if size == 0:
            return torch.empty(shape, dtype=dtype)
        return torch.frombuffer(bytearray(raw), dtype=dtype).reshape(shape)

    shapes = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)
    return st.builds(build, st.sampled_from(TORCH_DTYPES), shapes, st.integers(0, 99))


def arrays() -> st.SearchStrategy[np.ndarray]:
    shapes = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)
    return st.sampled_from(NUMPY_DTYPES).flatmap(lambda dtype: hnp.arrays(dtype, shapes))


LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(2**64, 2**128),
    st.floats(),
    st.text(),
    tensors(),
    arrays(),
    arrays().filter(lambda array: array.ndim == 0).map(lambda array: array[()]),
)
KEYS = st.one_of(st.text(), st.integers())
STATES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.lists(inner, max_size=4).map(tuple),
        st.dictionaries(KEYS, inner, max_size=4),
        st.dictionaries(KEYS, inner, max_size=4).map(OrderedDict),
    ),
    max_leaves=12,
)


@settings(max_examples=200, deadline=None)
@given(STATES)
def test_everything_comes_back_as_it_was(state: Any) -> None:
    assert_same(through_files(state), state)


@pytest.mark.parametrize("dtype", TORCH_DTYPES, ids=str)
@pytest.mark.parametrize("shape", [(), (3,), (2, 0)])
def test_tensors_of_every_type_and_shape(dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    assert_same(through_files(torch.ones(shape, dtype=dtype)), torch.ones(shape, dtype=dtype))


@pytest.mark.parametrize("scalar", [np.float64(0.1), np.float32("nan"), np.uint16(7), np.bool_(1)])
def test_numpy_scalars_stay_numpy_scalars(scalar: np.generic) -> None:
    assert_same(through_files({"x": scalar}), {"x": scalar})


def test_random_generators_go_on_where_they_were() -> None:
    rng, generator = np.random.default_rng(5), torch.Generator().manual_seed(5)
    state = through_files({"numpy": rng.bit_generator.state, "torch": generator.get_state()})
    expected = rng.random(4), torch.rand(4, generator=generator)
    restored, other = np.random.default_rng(0), torch.Generator()
    restored.bit_generator.state = state["numpy"]
    other.set_state(state["torch"])
    assert np.array_equal(restored.random(4), expected[0])
    assert torch.equal(torch.rand(4, generator=other), expected[1])


def test_keys_that_read_alike_stay_apart() -> None:
    state = {0: torch.zeros(1), "0": torch.ones(1), "a.b": np.ones(2), "a": {"b": np.zeros(2)}}
    assert_same(through_files(state), state)


def test_dicts_that_look_like_the_skeleton_itself() -> None:
    state = {"tensor": "0", "dtype": "float32", "shape": [1], "x": {"dict": {"tuple": [1]}}}
    assert_same(through_files(state), state)


def test_views_and_other_layouts_come_back_as_the_same_values() -> None:
    tensor, array = torch.arange(6).reshape(2, 3).T, np.asfortranarray(np.arange(6).reshape(2, 3))
    back = through_files([tensor, array, tensor[1:, 0], torch.nn.Parameter(torch.ones(2))])
    assert back[0].tolist() == [[0, 3], [1, 4], [2, 5]]
    assert back[1].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert back[2].tolist() == [1, 2]
    assert type(back[3]) is torch.Tensor
    assert not back[3].requires_grad


def test_restored_arrays_can_be_written_and_do_not_share_memory() -> None:
    array = np.zeros(3)
    back = through_files([array, torch.zeros(3)])
    back[0][0] = back[1][0] = 1
    assert back[0].tolist() == back[1].tolist() == [1, 0, 0]
    assert array.tolist() == [0, 0, 0]


def test_the_skeleton_is_readable_json() -> None:
    skeleton, arrays = flatten({"step": 3, "rewards": [0.5, math.nan], "rng": (np.zeros(2),)})
    assert skeleton == {
        "dict": {
            "step": 3,
            "rewards": [0.5, {"float": "nan"}],
            "rng": {"tuple": [{"array": "0", "dtype": "<f8", "shape": [2]}]},
        }
    }
    assert list(arrays) == ["0"]


class Color(IntEnum):
    RED = 1


@pytest.mark.parametrize(
    ("value", "path"),
    [
        ({"a": [1, {2: object()}]}, r"state\.a\[1\]\.2: .*object"),
        ({"a": (Color.RED,)}, r"state\.a\[0\]: .*Color"),
        ({"a": {1, 2}}, r"state\.a: .*set"),
        ({"a": b"x"}, r"state\.a: .*bytes"),
        ({"a": np.array(["x"])}, r"state\.a: .*<U1"),
        ({"a": np.array([None])}, r"state\.a: .*object"),
        ({"a": np.datetime64(0, "s")}, r"state\.a: .*datetime"),
        ({"a": np.ma.masked_array([1])}, r"state\.a: .*MaskedArray"),
        ({"a": torch.eye(2).to_sparse()}, r"state\.a: .*sparse"),
        ({"a": {(1, 2): 3}}, r"state\.a: the key \(1, 2\)"),
        ({"a": {True: 3}}, r"state\.a: the key True"),
    ],
)
def test_anything_else_is_refused_with_its_path(value: Any, path: str) -> None:
    with pytest.raises(TypeError, match=path):
        flatten(value)


def test_a_snapshot_stays_as_it_is_and_is_not_taken_of_too_much() -> None:
    state = {"weights": torch.ones(2), "more": [np.ones(2, np.float32)], "step": 3}
    taken = snapshot(state, 16)
    state["weights"].fill_(9.0)  # type: ignore[attr-defined]
    state["more"][0][:] = 9.0  # type: ignore[index]
    assert taken["step"] == 3
    assert taken["weights"].tolist() == [1.0, 1.0]
    assert taken["more"][0].tolist() == [1.0, 1.0]
    assert snapshot(state, 15) is None


def test_a_skeleton_of_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown kind"):
        unflatten({"pickle": "gASVAAAA"}, {})


@pytest.mark.parametrize("shape", [[3], [-1], [2.0], [True, 2], "2"])
def test_an_array_of_another_size_is_refused(shape: Any) -> None:
    with pytest.raises(ValueError, match=r"can't have the shape|unknown kind"):
        unflatten({"array": "0", "dtype": "<f8", "shape": shape}, {"0": np.zeros(2)})


OWN = {
    "step": 3,
    "on": False,
    "best": None,
    "rng": {"state": 2**127, "left": 0},
    "betas": (0.9, 0.99),
    "groups": [{"lr": 0.1}],
    "reward": np.zeros(2),
    "weights": torch.zeros(2, 3),
}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"step": 4.0, "best": 0.5, "more": 1, "groups": [], "reward": np.zeros(5)}, None),
        ({"rng": {"state": 2**126, "left": 2**62}, "weights": torch.ones(9, 9)}, None),
        ([], "state is a list, not a mapping"),
        ({"step": "3"}, "state.step is str, not a number"),
        ({"step": None}, "state.step is NoneType, not a number"),
        ({"step": True}, "state.step is true or false, not a number"),
        ({"step": 2**63}, "state.step is a number beyond 64 bits, not a number"),
        ({"on": 0}, "state.on is a number, not true or false"),
        ({"rng": {"state": 7}}, "state.rng.state is a number, not a number beyond 64 bits"),
        ({"betas": (0.9,)}, "state.betas is a tuple of 1, not a tuple of 2"),
        ({"betas": (0.9, None)}, "state.betas.1 is NoneType, not a number"),
        ({"groups": [{"lr": []}]}, "state.groups.0.lr is a list, not a number"),
        (
            {"reward": np.zeros((2, 1))},
            "state.reward is an array of 2 axes of float64, not an array of 1 axis of float64",
        ),
        (
            {"weights": torch.zeros(2, 3).double()},
            "state.weights is an array of 2 axes of float64, not an array of 2 axes of float32",
        ),
    ],
)
def test_a_state_of_another_kind_is_told_from_ones_own(given: Any, expected: str | None) -> None:
    assert mismatch(given, OWN) == expected
