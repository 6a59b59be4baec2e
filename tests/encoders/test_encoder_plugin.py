"""The built-in encoders keep the contract that plugins are held to."""

import pluggy
import pytest
from gymnasium.spaces import Box
from pydantic import BaseModel, ValidationError
from torch import nn

from encoders import plugin
from encoders.cameras import Pinhole
from encoders.spaces import DepthImage, PointCloud
from trainers import hookspecs


def registered():
    manager = pluggy.PluginManager(hookspecs.PROJECT_NAME)
    manager.add_hookspecs(hookspecs)
    manager.register(plugin)
    (encoders,) = manager.hook.ventosa_encoders()
    return encoders


def test_all_built_in_encoders_are_registered():
    assert set(registered()) == {
        "conv",
        "paper",
        "simple",
        "nature_cnn",
        "resnet",
        "fully_connected",
        "keypoints",
        "second_look",
        "pointnet",
        "vector",
    }


@pytest.mark.parametrize("name", registered())
def test_contract(name):
    encoder = registered()[name]
    required = {"layers": [[4, 8, 4]]} if name == "conv" else {}
    settings = encoder.Settings(**required)
    assert isinstance(settings, BaseModel)
    for field, info in encoder.Settings.model_fields.items():
        assert info.description, field
        assert info.description.endswith("."), field
        with pytest.raises(ValidationError, match="frozen"):
            setattr(settings, field, 1)
    with pytest.raises(ValidationError, match="extra"):
        encoder.Settings(**required, no_such_setting=1)
    image = DepthImage(80, 80, pinhole=Pinhole(99.0, 99.0, 40.0, 40.0))
    others = {"vector": Box(-1, 1, (6,)), "pointnet": PointCloud(9)}
    built = encoder(others.get(name, image), settings)
    assert isinstance(built, nn.Module)
    assert isinstance(built.features_dim, int)
