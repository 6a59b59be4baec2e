"""A short film of a policy's first actions, from outside: an animated GIF."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs.grasp.evaluation.pick import STEP_S, Attempt, Picker
from envs.grasp.evaluation.pose_errors import Sample
from envs.grasp.robot.arm import Arm
from envs.grasp.sensors.camera import overviews
from envs.grasp.settings import GraspSettings

WIDTH_PX, HEIGHT_PX, CAPTION_PX = 480, 360, 28
# GIF counts in hundredths of a second.
FRAME_MS = 80
LAST_FRAME_MS = 1200
STEPS_PER_FRAME = round(FRAME_MS / 1000.0 / STEP_S)
COLORS = 96
# The scenes' own light is drawn for the policy's cameras, and can be dim.
LIGHT = {
    "light_direction": np.array([[0.3, -0.6, 0.75]]),
    "light_intensity": np.array([0.55]),
}


def film(samples: Sequence[Sample], settings: GraspSettings, arm: Arm, pick: bool) -> bytes:
    """Films some commands one after the other, from the robot's home on.

    Args:
        samples: what to film, one or more.
        settings: the task.
        arm: carries them out.
        pick: go on to pick up the block; otherwise the film ends at the commanded pose.

    Returns:
        A GIF that runs for ever.
    """
    frames: list[Image.Image] = []
    durations: list[int] = []
    picker = Picker(arm, settings.support, settings.pick)
    try:
        for number, sample in enumerate(samples, 1):
            captured = _Camera(f"{number} of {len(samples)}   {sample.caption}")
            carry_out = picker.pick if pick else picker.reach
            carry_out(sample.scene.with_arrays(LIGHT), sample.tooltip_m, sample.yaw_rad, captured)
            frames += captured.frames
            durations += [FRAME_MS] * (len(captured.frames) - 1) + [LAST_FRAME_MS]
    finally:
        picker.close()
    file = io.BytesIO()
    frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0)
    return file.getvalue()


class _Camera:
    """Takes a frame now and then while an attempt goes on."""

    def __init__(self, text: str):
        self.frames: list[Image.Image] = []
        self._view = overviews(1, width=WIDTH_PX, height=HEIGHT_PX)
        self._text, self._font, self._steps = text, ImageFont.load_default(15), 0

    def __call__(self, attempt: Attempt) -> None:
        if self._steps % STEPS_PER_FRAME == 0:
            self.frames.append(self._framed(attempt.picture(self._view)))
        self._steps += 1

    def _framed(self, picture: np.ndarray) -> Image.Image:
        frame = Image.new("RGB", (WIDTH_PX, HEIGHT_PX + CAPTION_PX), "white")
        frame.paste(Image.fromarray(np.ascontiguousarray(picture, np.uint8)))
        ImageDraw.Draw(frame).text((10, HEIGHT_PX + 5), self._text, "black", self._font)
        return frame.quantize(COLORS, dither=Image.Dither.NONE)
