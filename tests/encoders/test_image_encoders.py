"""All encoders of images: sizes by hand, gradients, messages."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from torch import nn
from torch.nn import functional as F

from encoders.conv import Conv, Paper
from encoders.layers import convolutions, output_length, smallest_length
from encoders.ml_agents import FullyConnected, NatureCnn, ResidualBlock, ResNet, Simple
from encoders.spaces import DepthImage, RgbImage

VECTOR = Box(-1, 1, (7,))


def conv(space, layers, activation="relu"):
    return Conv(space, Conv.Settings(layers=layers, activation=activation))


def images(space, batch):
    rng = np.random.default_rng(0)
    high = 3000 if space.dtype == np.uint16 else 256
    return torch.from_numpy(rng.integers(0, high, (batch, *space.shape)).astype(space.dtype))


def _builder(cls, **settings):
    return lambda space, **more: cls(space, cls.Settings(**settings, **more))


ENCODERS = {
    "conv": _builder(Conv, layers=[[4, 8, 4], [6, 3, 1]]),
    "paper": _builder(Paper, size=80),
    "simple": _builder(Simple, features=12),
    "nature_cnn": _builder(NatureCnn, features=12),
    "resnet": _builder(ResNet, features=12),
    "fully_connected": _builder(FullyConnected, num_layers=2, hidden_units=12),
}
CONVOLUTIONAL = [name for name in ENCODERS if name != "fully_connected"]


@pytest.mark.parametrize(
    ("size", "side", "features"),
    [
        (32, 32, 8 * 4 * 4),  # 32 -> 8 -> 4
        (80, 80, 2048),  # 80 -> 19 -> 8, 32 filters
        (128, 128, 64 * 13 * 13),  # 128 -> 31 -> 14 -> 13
        (256, 256, 72 * 28 * 28),  # 256 -> 63 -> 30 -> 29 -> 28
        (80, 128, 32 * 14 * 14),
    ],
)
def test_the_papers_networks_have_the_sizes_worked_out_by_hand(size, side, features):
    space = DepthImage(side, side)
    encoder = Paper(space, Paper.Settings(size=size))
    assert encoder.features_dim == features
    assert encoder(images(space, 2)).shape == (2, features)


def test_the_larger_networks_of_the_paper_add_layers_to_the_smaller():
    def shapes(size):
        encoder = Paper(DepthImage(256, 256), Paper.Settings(size=size))
        return [tuple(p.shape) for p in encoder.parameters() if p.dim() == 4]

    assert shapes(80) == [(16, 1, 8, 8), (32, 16, 4, 4)]
    assert shapes(128) == [*shapes(80), (64, 32, 2, 2)]
    assert shapes(256) == [*shapes(128), (72, 64, 2, 2)]
    assert shapes(32) == [(4, 1, 2, 2), (8, 4, 1, 1)]


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize(
    "space",
    [
        DepthImage(40, 61),
        DepthImage(61, 40, encoding="uint8"),
        RgbImage(40, 50),
        Box(-1, 1, (44, 40, 5)),
    ],
    ids=["uint16", "uint8", "rgb", "float"],
)
def test_features_are_as_announced_and_gradients_reach_every_parameter(name, space):
    torch.manual_seed(0)
    encoder = ENCODERS[name](space)
    features = encoder(images(space, 3))
    assert features.dtype == torch.float32
    assert features.shape == (3, encoder.features_dim)
    assert torch.isfinite(features).all()
    features.square().sum().backward()
    for parameter in encoder.parameters():
        assert parameter.grad is not None
        assert parameter.grad.abs().sum() > 0


@pytest.mark.parametrize("name", ENCODERS)
def test_an_image_is_encoded_alike_alone_and_in_a_batch(name):
    space = DepthImage(40, 44)
    encoder = ENCODERS[name](space)
    batch = images(space, 3)
    together = encoder(batch)
    alone = torch.cat([encoder(batch[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(together[0], together[1])


@pytest.mark.parametrize("name", ENCODERS)
def test_real_cameras_need_no_preprocessing(name):
    """Whatever lies outside the range counts as nothing seen, for which 0 stands."""
    space = DepthImage(40, 40)
    raw = images(space, 1).to(torch.int32)
    raw[:, :9], raw[:, 9:18] = 399, 65535
    zeroed = torch.where((raw < 400) | (raw > 2000), 0, raw)
    encoder = ENCODERS[name](space)
    torch.testing.assert_close(
        encoder(raw.to(torch.uint16)), encoder(zeroed.to(torch.uint16)), rtol=0, atol=0
    )


@pytest.mark.parametrize("name", ENCODERS)
def test_with_its_validity_channel_an_encoder_tells_nothing_seen_from_the_far_end(name):
    space = DepthImage(40, 40)
    far, missing = torch.full((1, 40, 40, 1), 2000), torch.zeros(1, 40, 40, 1)
    encoders = {"off": ENCODERS[name](space), "on": ENCODERS[name](space, validity_channel=True)}
    differ = {}
    for channel, encoder in encoders.items():
        features = [encoder(image.to(torch.uint16)) for image in (far, missing)]
        differ[channel] = not torch.allclose(*features)
    assert differ == {"off": False, "on": True}


def test_a_vector_has_no_validity_channel():
    with pytest.raises(ValueError, match="validity_channel: a vector has no pixels"):
        FullyConnected(VECTOR, FullyConnected.Settings(validity_channel=True))


def test_conv_is_a_sum_over_windows_then_the_activation():
    encoder = conv(Box(-np.inf, np.inf, (2, 3, 1)), [[1, 2, 1]], "elu")
    layer = next(m for m in encoder.modules() if isinstance(m, nn.Conv2d))
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[[[1.0, 2.0], [3.0, 4.0]]]]))
        layer.bias.fill_(-10.0)
    image = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 2.0]]).reshape(1, 2, 3, 1)
    # windows: 1*1 + 4*1 - 10 = -5; 2*1 + 3*1 + 4*2 - 10 = 3
    assert encoder(image)[0].tolist() == pytest.approx([np.exp(-5) - 1, 3])


@pytest.mark.parametrize(
    ("activation", "of_minus_two"),
    [("relu", 0), ("leaky_relu", -0.02), ("tanh", -0.9640276), ("elu", -0.8646647)],
)
def test_activations(activation, of_minus_two):
    stack = convolutions(1, [(1, 1, 1)], activation)
    assert stack[1](torch.tensor(-2.0)).item() == pytest.approx(of_minus_two, abs=1e-6)


def test_initial_weights_keep_the_size_of_the_signal():
    torch.manual_seed(0)
    stack = convolutions(3, [(64, 5, 1)] * 4, "relu")
    # He et al.: the second moment of the pre-activations stays that of the input, times two at
    # the first layer, whose input is not halved by an activation.
    hidden = stack[:-1](torch.randn(8, 3, 32, 32))
    assert 1.0 < hidden.square().mean() < 4.0


@given(
    layers=st.lists(st.tuples(st.integers(1, 9), st.integers(1, 5)), min_size=1, max_size=4),
    extra=st.integers(0, 20),
)
def test_sizes_agree_with_torch(layers, extra):
    least = smallest_length(layers)
    signal = torch.zeros(1, 1, least + extra)
    for kernel, stride in layers:
        signal = F.max_pool1d(signal, kernel, stride)
    assert signal.shape[-1] == output_length(least + extra, layers)
    assert output_length(least, layers) == 1
    assert output_length(least - 1, layers) < 1


@pytest.mark.parametrize(
    ("name", "least"),
    [("conv", 16), ("paper", 20), ("simple", 20), ("nature_cnn", 36), ("resnet", 15)],
)
def test_an_image_too_small_is_refused_with_both_sizes(name, least):
    assert ENCODERS[name](DepthImage(least, least + 3)).features_dim > 0
    with pytest.raises(ValueError, match=f"{least + 3}x{least - 1} .*at least {least}x{least}"):
        ENCODERS[name](DepthImage(least - 1, least + 3))
    with pytest.raises(ValueError, match=f"{least - 1}x{least + 3} .*at least {least}x{least}"):
        ENCODERS[name](DepthImage(least + 3, least - 1))


def test_the_message_shows_the_layers_as_the_run_file_has_them():
    with pytest.raises(ValueError, match=r"layers \[\[16, 8, 4\], \[32, 4, 2\]\]: at least 20x20"):
        conv(DepthImage(19, 19), [[16, 8, 4], [32, 4, 2]])


@pytest.mark.parametrize("name", CONVOLUTIONAL)
def test_a_vector_is_refused_with_the_encoder_to_use(name):
    with pytest.raises(ValueError, match=r"\(7,\).*'vector'"):
        ENCODERS[name](VECTOR)


def test_fully_connected_takes_vectors():
    encoder = ENCODERS["fully_connected"](VECTOR)
    assert encoder(torch.rand(5, 7)).shape == (5, 12)
    weights = [tuple(p.shape) for p in encoder.parameters() if p.dim() == 2]
    assert weights == [(12, 7), (12, 12)]


def test_ml_agents_sizes():
    space = RgbImage(84, 84)

    def shapes(encoder):
        return [tuple(p.shape) for p in encoder.parameters() if p.dim() > 1]

    assert shapes(ENCODERS["simple"](space)) == [
        (16, 3, 8, 8),
        (32, 16, 4, 4),
        (12, 32 * 9 * 9),  # 84 -> 20 -> 9
    ]
    assert shapes(ENCODERS["nature_cnn"](space)) == [
        (32, 3, 8, 8),
        (64, 32, 4, 4),
        (64, 64, 3, 3),
        (12, 64 * 7 * 7),  # 84 -> 20 -> 9 -> 7
    ]
    # 84 -> 41 -> 20 -> 9; per stack one convolution and two blocks of two
    assert shapes(ENCODERS["resnet"](space)) == [
        (16, 3, 3, 3),
        *[(16, 16, 3, 3)] * 4,
        (32, 16, 3, 3),
        *[(32, 32, 3, 3)] * 4,
        (32, 32, 3, 3),
        *[(32, 32, 3, 3)] * 4,
        (12, 32 * 9 * 9),
    ]


def test_a_residual_block_of_zero_weights_changes_nothing():
    block = ResidualBlock(3)
    for parameter in block.parameters():
        nn.init.zeros_(parameter)
    inputs = torch.randn(2, 3, 4, 5)
    torch.testing.assert_close(block(inputs), inputs)


@pytest.mark.parametrize(
    "settings",
    [
        {"layers": []},
        {"layers": [[16, 8]]},
        {"layers": [[16, 8, 0]]},
        {"layers": [[16, -8, 4]]},
        {"layers": [[16, 8, 4]], "activation": "swish"},
        {"layers": [[16, 8, 4]], "features": 3},
    ],
)
def test_conv_refuses_wrong_settings(settings):
    with pytest.raises(ValidationError):
        Conv.Settings(**settings)


def test_paper_refuses_other_sizes():
    with pytest.raises(ValidationError):
        Paper.Settings(size=64)
