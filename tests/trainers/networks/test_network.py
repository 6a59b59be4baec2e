"""Encoders and a trunk, put together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from encoders.conv import Conv
from encoders.spaces import PointCloud, RgbImage
from encoders.vector import Vector
from trainers.common.errors import UserError
from trainers.networks.factory import NetworkFactory
from trainers.networks.network import Network, NetworkSettings, head
from trainers.networks.observations import Observations
from trainers.runfile.settings import Component

MakeFactory = Callable[..., NetworkFactory]
SPACES = {
    "left": RgbImage(4, 4),
    "joints": Box(-9.0, 9.0, (2,), np.float32),
    "right": RgbImage(4, 4),
}
BARE = NetworkSettings(num_layers=0)


class Mean(nn.Module):
    """An encoder whose features are known: a factor times the image's mean."""

    features_dim = 1

    def __init__(self, factor: float):
        super().__init__()
        self.factor, self.rows_seen = factor, 0

    def forward(self, raw: Tensor) -> Tensor:
        self.rows_seen += len(raw)
        return self.factor * raw.float().mean(dim=(1, 2, 3))[:, None]


def bare_network() -> Network:
    vector = Vector(SPACES["joints"], Vector.Settings())
    return Network({"left": Mean(1.0), "joints": vector, "right": Mean(10.0)}, SPACES, BARE)


def flat_images(*values: int) -> Tensor:
    return torch.tensor(values, dtype=torch.uint8)[:, None, None, None].expand(-1, 4, 4, 3)


def test_features_of_all_observations_stand_side_by_side() -> None:
    network = bare_network()
    vectors = {"joints": torch.tensor([[7.0, 8.0], [5.0, 6.0]])}
    frames = {"left": flat_images(1, 2), "right": flat_images(3, 4)}
    hidden = network(Observations(frames, vectors))
    assert hidden.tolist() == [[1.0, 30.0, 7.0, 8.0], [2.0, 40.0, 5.0, 6.0]]
    assert network.features_dim == 4


def test_shared_frames_are_encoded_once_and_handed_to_whom_they_belong() -> None:
    network = bare_network()
    vectors = {"joints": torch.zeros(4, 2)}
    frames = {"left": flat_images(1, 2), "right": flat_images(3, 4)}
    index = torch.tensor([1, 0, 0, 1])
    hidden = network(Observations(frames, vectors, index))
    assert hidden[:, :2].tolist() == [[2.0, 40.0], [1.0, 30.0], [1.0, 30.0], [2.0, 40.0]]
    assert [encoder.rows_seen for encoder in network.frame_encoders.values()] == [2, 2]


def test_known_features_are_taken_without_asking_the_encoders() -> None:
    network = bare_network()
    known = torch.tensor([[5.0, 6.0]])
    hidden = network(Observations({}, {"joints": torch.zeros(1, 2)}), known)
    assert hidden.tolist() == [[5.0, 6.0, 0.0, 0.0]]
    assert [encoder.rows_seen for encoder in network.frame_encoders.values()] == [0, 0]


def test_a_network_without_cameras_has_no_frame_features() -> None:
    vector = Vector(SPACES["joints"], Vector.Settings())
    network = Network({"joints": vector}, {"joints": SPACES["joints"]}, BARE)
    assert network.encode_frames({}) is None


@given(st.lists(st.text() | st.sampled_from(["type", "values", "a.b", "a%2Eb", "="]), unique=True))
def test_observations_may_have_any_names(names: list[str]) -> None:
    encoders = {name: Mean(float(place)) for place, name in enumerate(names)}
    network = Network(encoders, dict.fromkeys(names, SPACES["left"]), BARE)
    assert list(network.frame_encoders) == list(network.frame_encoders.keys()) == names
    assert dict(network.frame_encoders.items()) == encoders
    assert all(network.frame_encoders[name] is encoders[name] for name in names)
    assert "none of them" not in network.frame_encoders


def test_weights_of_observations_are_named_after_them_where_torch_lets_them() -> None:
    names = ["wrist-cam", "hand.depth", "type", "50% left"]
    joints = SPACES["joints"]
    encoders = {name: Vector(joints, Vector.Settings(normalize=True)) for name in names}
    network = Network(encoders, dict.fromkeys(names, joints), BARE)
    modules = ["wrist-cam", "=hand%2Edepth", "=type", "50% left"]
    keys = [key.removeprefix("vector_encoders.") for key in network.state_dict()]
    assert list(dict.fromkeys(key.split(".")[0] for key in keys)) == modules


@pytest.mark.parametrize("layers", [0, 1, 3])
def test_the_trunk_has_as_many_layers_as_asked_for(layers: int) -> None:
    settings = NetworkSettings(num_layers=layers, hidden_units=5, activation="tanh")
    vector = Vector(SPACES["joints"], Vector.Settings())
    network = Network({"joints": vector}, {"joints": SPACES["joints"]}, settings)
    assert [type(layer) for layer in network.trunk] == [nn.Linear, nn.Tanh] * layers
    hidden = network(Observations({}, {"joints": torch.zeros(3, 2)}))
    assert hidden.shape == (3, network.features_dim)
    assert network.features_dim == (5 if layers else 2)


def test_heads_are_orthogonal_with_their_gain() -> None:
    layer = head(8, 3, gain=0.01)
    squares = layer.weight @ layer.weight.T
    torch.testing.assert_close(squares, 1e-4 * torch.eye(3), atol=1e-9, rtol=1e-4)
    assert layer.bias.tolist() == [0.0, 0.0, 0.0]


def component(cls: Any, **settings: Any) -> Component:
    return Component(cls.__name__.lower(), cls, cls.Settings(**settings))


def test_normalize_reaches_vectors_without_an_encoder_of_their_own(
    make_factory: MakeFactory,
) -> None:
    space = {"joints": SPACES["joints"], "speeds": SPACES["joints"]}
    factory = make_factory(space, {"speeds": component(Vector, normalize=False)})
    network = factory.network(NetworkSettings(num_layers=0, normalize=True), ["joints", "speeds"])
    batch = torch.tensor([[1.0, 2.0], [3.0, 6.0]])
    network.update_statistics({"joints": batch, "speeds": batch})
    hidden = network(Observations({}, {"joints": batch, "speeds": batch}))
    torch.testing.assert_close(hidden, torch.tensor([[-1.0, -1.0, 1.0, 2.0], [1.0, 1.0, 3.0, 6.0]]))


def test_clouds_have_an_encoder_by_default(make_factory: MakeFactory) -> None:
    factory = make_factory({"joints": SPACES["joints"], "cloud": PointCloud(5)})
    network = factory.network(BARE, ["joints", "cloud"])
    clouds = torch.zeros(3, 5, 4)
    clouds[:, 1:3] = torch.tensor([0.3, 0.1, 0.9, 1.0])
    features = network(Observations({"cloud": clouds}, {"joints": torch.ones(3, 2)}))
    assert features.shape == (3, 2 + 128)
    swapped = Observations({"cloud": clouds.flip(1)}, {"joints": torch.ones(3, 2)})
    torch.testing.assert_close(network(swapped), features)


def test_statistics_pass_by_encoders_that_have_none(make_factory: MakeFactory) -> None:
    class Plain(nn.Module):
        features_dim = 2

        def __init__(self, space: Box, settings: Any):
            super().__init__()

    factory = make_factory(
        {"joints": SPACES["joints"]},
        {"joints": Component("plain", Plain, Vector.Settings())},
    )
    network = factory.network(BARE, ["joints"])
    network.update_statistics({"joints": torch.ones(2, 2)})
    assert not list(network.parameters())


def test_an_encoder_for_an_observation_that_is_not_there_names_the_nearest(
    make_factory: MakeFactory,
) -> None:
    with pytest.raises(UserError) as caught:
        make_factory({"depth": RgbImage(4, 4)}, {"dept": component(Conv, layers=[(4, 3, 1)])})
    assert str(caught.value) == (
        "encoders: the environment has no observation 'dept'; did you mean 'depth'?"
    )


def test_an_encoder_that_does_not_fit_names_its_key_and_the_sizes(
    make_factory: MakeFactory,
) -> None:
    factory = make_factory({"eye": RgbImage(4, 4)}, {"eye": component(Conv, layers=[(4, 8, 1)])})
    with pytest.raises(UserError, match=r"^encoders\.eye \(conv\): a 4x4 image .* 8x8"):
        factory.network(BARE, ["eye"])
