"""Saved policies from raw values on, fitted to a real camera where it is not that of training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from encoders.raw_inputs import RayEncoder
from envs.deployment import Correction, Deployment, correction
from envs.views import CameraFile, View, trained_views
from trainers.common.errors import UserError
from trainers.inference.policy import Policy, complete_metadata
from trainers.inference.raw_policy import RawPolicy
from trainers.networks.network import Network
from trainers.networks.policy_network import PolicyNetwork
from trainers.saving.run_folder import find_run_folder

SAME_RAYS = 2e-5
"""In units of the focal length: a hundredth of a pixel of a sensor of some 600 columns."""


def load_raw_policy(
    name: str,
    results_dir: Path = Path("results"),
    file: CameraFile | None = None,
    unit_per_m: float | None = None,
    full_precision: bool = True,
) -> RawPolicy:
    """A saved policy, from raw values on.

    Args:
        name: see `Policy.load`.
        results_dir: the same.
        file: see `fit`.
        unit_per_m: the same.
        full_precision: calculate in float32, even if it was trained with bfloat16.

    Raises:
        UserError: see `Policy.load` and `fit`.
    """
    policy = Policy.load(name, results_dir=results_dir, full_precision=full_precision)
    metadata = complete_metadata(find_run_folder(name, results_dir))
    return fit(policy, metadata.deployment or Deployment(), file, unit_per_m)


def fit(
    policy: Policy,
    deployment: Deployment,
    file: CameraFile | None = None,
    unit_per_m: float | None = None,
) -> RawPolicy:
    """A policy with the images of a real camera.

    Args:
        policy: its network is changed, where it knows the rays of pixels.
        deployment: what its environment declares.
        file: of the real camera; None: it is as in training.
        unit_per_m: overrides that of the file.

    Raises:
        UserError: the policy has no such images, its encoder is not made for another camera, or
            something in the file does not fit.
    """
    views, moved = trained_views(policy.observation_space, deployment.mounts), None
    if file is not None:
        name = _whose(file, views)
        trained = views[name]
        try:
            views[name] = file.view(trained)
            rays = views[name].rays()
        except ValueError as error:
            raise UserError(f"--camera: {error}") from error
        if trained.pinhole is None or not np.allclose(rays, trained.rays(), atol=SAME_RAYS):
            _set_rays(policy.network, name, rays)
        if views[name].mount != trained.mount:
            moved = _correction(deployment, trained, views[name], len(views))
    if unit_per_m is not None:
        changed = {"unit_per_m": unit_per_m}
        views = {name: view.model_copy(update=changed) for name, view in views.items()}
    return RawPolicy(policy, deployment.meaning, views, moved)


def _whose(file: CameraFile, views: dict[str, View]) -> str:
    """The observation that a file is about."""
    if not views:
        raise UserError("--camera: the policy sees no camera's images, so that none can be fitted")
    name = file.observation or (next(iter(views)) if len(views) == 1 else "")
    if name not in views:
        raise UserError(
            f"--camera: observation: {name or 'missing'}, where the policy sees the images "
            f"{', '.join(views)}: name one of them in the file"
        )
    return name


def _set_rays(network: PolicyNetwork, name: str, rays: NDArray[np.float64]) -> None:
    """Tells all encoders of an observation's images where the rays of pixels go."""
    for part in network.modules():
        if not isinstance(part, Network) or name not in part.frame_encoders:
            continue
        encoder = part.frame_encoders[name]
        if not isinstance(encoder, RayEncoder):
            raise UserError(
                f"--camera: the encoder of {name!r} ({type(encoder).__name__}) knows no rays of "
                "pixels, so that it can't be fitted to other intrinsics than those of training: "
                "train with the real camera's intrinsics, or with the encoder keypoints or "
                "second_look"
            )
        encoder.set_rays(rays)


def _correction(deployment: Deployment, trained: View, real: View, cameras: int) -> Correction:
    """What becomes of places where the camera is elsewhere."""
    meaning = deployment.meaning
    if not (meaning and meaning.is_place and trained.mount and real.mount) or cameras > 1:
        raise UserError(
            "--camera: where a camera is makes a difference that can be worked out for policies of "
            "one camera alone, whose place in training is known and whose actions are places"
        )
    try:
        return correction(trained.mount, real.mount)
    except ValueError as error:
        raise UserError(f"--camera: {error}") from error
