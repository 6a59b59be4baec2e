"""The encoders that come with ventosa, registered as any plugin's would be."""

from __future__ import annotations

from encoders.conv import Conv, Paper
from encoders.keypoints import Keypoints
from encoders.ml_agents import FullyConnected, NatureCnn, ResNet, Simple
from encoders.pointnet import PointNet
from encoders.second_look import SecondLook
from encoders.vector import Vector
from trainers.hookspecs import hookimpl


@hookimpl
def ventosa_encoders() -> dict[str, type]:
    """Encoders by the name a run file uses."""
    return {
        "conv": Conv,
        "paper": Paper,
        "simple": Simple,
        "nature_cnn": NatureCnn,
        "resnet": ResNet,
        "fully_connected": FullyConnected,
        "keypoints": Keypoints,
        "second_look": SecondLook,
        "pointnet": PointNet,
        "vector": Vector,
    }
