"""ONNX files say what torch says, whatever the policy is made of."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete

from encoders.cameras import Pinhole, Sampling
from encoders.conv import Conv, Paper
from encoders.keypoints import Keypoints
from encoders.ml_agents import FullyConnected, NatureCnn, ResNet, Simple
from encoders.pointnet import PointNet
from encoders.second_look import SecondLook
from encoders.spaces import DepthImage, PointCloud, RgbImage
from encoders.vector import Vector
from envs.deployment import Deployment
from trainers.common.errors import UserError
from trainers.inference.fitting import fit
from trainers.inference.metadata import Metadata, Need
from trainers.inference.onnx_check import (
    LARGEST_DIFFERENCE,
    LARGEST_ON_NOISE,
    differences,
    drawn_inputs,
)
from trainers.inference.onnx_export import Card, to_onnx
from trainers.inference.onnx_policy import OnnxPolicy
from trainers.inference.policy import Policy
from trainers.inference.raw_policy import RawPolicy
from trainers.networks.actor_critic import ActorCritic, PolicySettings
from trainers.networks.factory import NetworkFactory
from trainers.runfile.settings import Component

SENSOR = Sampling(90, 80, 4, 2, 40, 38, 2)
DEPTH = DepthImage(38, 40, (0.4, 2.0), pinhole=Pinhole(40.0, 41.0, 20.0, 19.0), sampling=SENSOR)
CODED = DepthImage(38, 40, (0.4, 2.0), "uint8", sampling=SENSOR)
COLOR = RgbImage(38, 40, SENSOR)
EVERYTHING = {
    "paper": (DEPTH, Paper, {"validity_channel": True}),
    "keypoints": (DEPTH, Keypoints, {"keypoints": 3, "precision": "float32"}),
    "second_look": (DEPTH, SecondLook, {"first_keypoints": 3, "second_keypoints": 3}),
    "pointnet": (PointCloud(50, "base", (0.1, 0.2, 0.3)), PointNet, {"layers": (6, 5)}),
    "conv": (COLOR, Conv, {"layers": [(4, 8, 4)]}),
    "simple": (CODED, Simple, {"features": 5}),
    "nature_cnn": (COLOR, NatureCnn, {"features": 5}),
    "resnet": (DEPTH, ResNet, {"features": 5}),
    "fully_connected": (CODED, FullyConnected, {"hidden_units": 5}),
    "vector": (Box(-np.inf, np.inf, (3,), np.float32), Vector, {"normalize": True}),
}
NEED = Need(name="ppo", distribution="built-in")

MakeFactory = Callable[..., NetworkFactory]


def policy_of(
    make_factory: MakeFactory, parts: Mapping[str, Any], actions: Any, **settings: Any
) -> Policy:
    torch.manual_seed(0)
    spaces = {name: space for name, (space, *_) in parts.items()}
    encoders = {
        name: Component(name, cls, cls.Settings(**options))
        for name, (_, cls, options) in parts.items()
    }
    small = PolicySettings(hidden_units=8, num_layers=1, **settings)
    network = ActorCritic(make_factory(spaces, encoders, actions), small).eval()
    for _ in range(20):  # the normaliser's moments
        network.update_statistics(
            {"vector": 3.0 + 2.0 * torch.randn(4, 3)} if "vector" in parts else {}
        )
    torch.nn.init.normal_(network.action_head.weight)  # larger than at a beginning
    return Policy(network, Dict(spaces), actions)


def exported(policy: Policy, raw: RawPolicy) -> tuple[bytes, OnnxPolicy]:
    space = policy.observation_space
    metadata = Metadata(space, policy.action_space, frozenset(), {}, NEED, Deployment())
    content = to_onnx(raw, Card(metadata.to_json(), "seed: 0\n", "abc"))
    return content, OnnxPolicy(content, "policy.onnx")


@pytest.fixture(scope="module")
def everything(make_factory: MakeFactory) -> tuple[Policy, RawPolicy, bytes, OnnxPolicy]:
    """A policy with memory, and with an encoder of every kind."""
    actions = Box(np.array([-2.0, 0.0], np.float32), np.array([1.0, 5.0], np.float32))
    memory = {"type": "lstm", "memory_size": 4}
    policy = policy_of(make_factory, EVERYTHING, actions, memory=memory, critic="separate")
    raw = fit(policy, Deployment())
    return policy, raw, *exported(policy, raw)


def test_every_encoder_and_memory_say_what_they_say_in_torch(everything: Any) -> None:
    _, raw, _, file = everything
    rng = np.random.default_rng(0)
    inputs = [drawn_inputs(raw, rng) for _ in range(20)]
    off = differences(raw, file, inputs, LARGEST_ON_NOISE)
    assert list(off) == ["action", "next_hidden_state", "unbounded_action"]
    actions = np.concatenate([file.run(one)["action"] for one in inputs])
    assert actions.std(axis=0).min() > 0.01  # it is no constant that they agree on
    assert (actions >= raw.action_space.low).all()
    assert (actions <= raw.action_space.high).all()


def test_it_acts_in_episodes_as_the_policy_does(everything: Any) -> None:
    policy, _, _, file = everything
    assert file.observation_space == policy.observation_space
    assert file.action_space == policy.action_space
    rng = np.random.default_rng(1)
    state = file_state = None
    for _ in range(3):
        seen = {
            name: rng.integers(0, 200, (2, *space.shape)).astype(space.dtype)
            for name, space in policy.observation_space.spaces.items()
        }
        actions, state = policy.predict(seen, state)
        told, file_state = file.predict(seen, file_state)
        np.testing.assert_allclose(told, actions, atol=1e-3)
        np.testing.assert_allclose(file_state[:, :8], state[:, :8], atol=1e-3)
    one = {name: values[0] for name, values in seen.items()}
    assert file.predict(one)[0].shape == (2,)


def test_drawn_actions_are_drawn_as_the_policy_draws_them(everything: Any) -> None:
    policy, _, content, _ = everything
    space = policy.observation_space
    seen = {name: np.zeros((500, *part.shape), part.dtype) for name, part in space.spaces.items()}
    network, low, high = policy.network, policy.action_space.low, policy.action_space.high
    drawn, _ = Policy(network, space, policy.action_space, seed=3).predict(seen, None, False)
    told, _ = OnnxPolicy(content, "", seed=3).predict(seen, None, False)
    np.testing.assert_allclose(told, drawn, atol=1e-3)
    assert (np.ptp(drawn, axis=0) == high - low).any()  # and held to the bounds


def test_the_file_says_what_it_is_and_needs_nothing_of_ours(everything: Any) -> None:
    _, raw, content, _ = everything
    model = onnx.load_from_string(content)
    onnx.checker.check_model(model, full_check=True)
    assert {one.domain for one in model.opset_import} <= {"", "ai.onnx"}
    session = onnxruntime.InferenceSession(content)
    shapes = {one.name: (one.type, one.shape) for one in session.get_inputs()}
    assert shapes["paper"] == ("tensor(uint16)", [1, 80, 90])
    assert shapes["conv"] == ("tensor(uint8)", [1, 80, 90, 3])
    assert shapes["pointnet"] == ("tensor(float)", [1, 50, 4])
    assert shapes["vector"] == ("tensor(float)", [1, 3])
    assert shapes["hidden_state"] == ("tensor(float)", [1, raw.state_size])
    properties = session.get_modelmeta().custom_metadata_map
    assert properties["weights_sha256"] == "abc"
    assert properties["configuration"] == "seed: 0\n"
    assert properties["torch"] == torch.__version__
    assert '"range_m": [0.4, 2.0]' in properties["inputs"]
    assert '"sensor_width": 90' in properties["views"]
    assert '"fx": 80.0' in properties["views"]  # in the sensor's pixels


@pytest.fixture(scope="module")
def chooser(make_factory: MakeFactory) -> tuple[Policy, RawPolicy, bytes, OnnxPolicy]:
    """A policy that chooses, with a GRU."""
    parts = {"vector": EVERYTHING["vector"]}
    memory = {"type": "gru", "memory_size": 4}
    policy = policy_of(make_factory, parts, Discrete(5, start=2), memory=memory)
    raw = fit(policy, Deployment())
    return policy, raw, *exported(policy, raw)


def test_choices_are_the_same(chooser: Any) -> None:
    policy, raw, _, file = chooser
    rng = np.random.default_rng(0)
    differences(raw, file, [drawn_inputs(raw, rng) for _ in range(50)], LARGEST_DIFFERENCE)
    vectors = 5.0 * rng.standard_normal((50, 3)).astype(np.float32)
    told, _ = file.predict(vectors)
    np.testing.assert_array_equal(told, policy.predict(vectors)[0])
    assert len(set(told.tolist())) > 1
    assert set(told.tolist()) <= {2, 3, 4, 5, 6}
    with pytest.raises(UserError, match="how its actions were drawn"):
        file.predict(vectors, deterministic=False)


@pytest.mark.parametrize(
    ("actions", "settings"),
    [
        (Box(-400.0, 100.0, (2,)), {"squash": "tanh", "state_dependent_std": True}),
        (MultiDiscrete([3, 2], start=[5, 0]), {}),
    ],
)
def test_other_actions_are_the_same(
    make_factory: MakeFactory, actions: Any, settings: dict[str, Any]
) -> None:
    policy = policy_of(make_factory, {"vector": EVERYTHING["vector"]}, actions, **settings)
    raw = fit(policy, Deployment())
    _, file = exported(policy, raw)
    rng = np.random.default_rng(0)
    differences(raw, file, [drawn_inputs(raw, rng) for _ in range(50)], LARGEST_DIFFERENCE)
    vectors = 5.0 * rng.standard_normal((50, 3)).astype(np.float32)
    told, _ = file.predict(vectors)
    np.testing.assert_allclose(told, policy.predict(vectors)[0], rtol=1e-4, atol=1e-3)
    assert (np.ptp(told, axis=0) > 0).all()
    assert all(actions.contains(row) for row in told.astype(actions.dtype))
    with pytest.raises(UserError, match="how its actions were drawn"):
        file.predict(vectors, deterministic=False)


def test_a_file_that_differs_is_refused(chooser: Any) -> None:
    _, raw, _, file = chooser

    class Other:
        def run(self, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {name: out + (name == "action") for name, out in file.run(inputs).items()}

    inputs = [drawn_inputs(raw, np.random.default_rng(0))]
    with pytest.raises(UserError, match=r"of no use, please report it: action is \d"):
        differences(raw, Other(), inputs, LARGEST_DIFFERENCE)
    assert differences(raw, Other(), inputs)["action"] == 1.0


def test_what_is_no_file_of_ours_is_named(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    with pytest.raises(UserError, match=r"policy\.onnx: can't be read: No such file"):
        OnnxPolicy.load(path)
    path.write_bytes(b"hello")
    with pytest.raises(UserError, match=r"policy\.onnx: no ONNX file"):
        OnnxPolicy.load(path)
    one = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    two = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])
    node = onnx.helper.make_node("Neg", ["x"], ["y"])
    graph = onnx.helper.make_graph([node], "foreign", [one], [two])
    opsets = [onnx.helper.make_opsetid("", 17)]
    model = onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8)
    path.write_bytes(model.SerializeToString())
    with pytest.raises(UserError, match=r"policy\.onnx: an ONNX file, and none of ventosa's"):
        OnnxPolicy.load(path)
    onnx.helper.set_model_props(model, {"ventosa": "0.0.1"})
    path.write_bytes(model.SerializeToString())
    with pytest.raises(UserError, match=r"of another version of ventosa \(0\.0\.1\)"):
        OnnxPolicy.load(path)


def test_without_the_packages_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    gone = lambda name: None if name == "onnxruntime" else find(name)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", gone)
    with pytest.raises(UserError, match=r"need onnxruntime, .*pip install -e '\.\[onnx\]'"):
        OnnxPolicy(b"", "policy.onnx")
