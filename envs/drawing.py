"""Pictures of what a policy says, drawn over what it saw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.views import View

LEAST_WIDTH_PX = 480
TEXT_HEIGHT_PX = 24
INK, HALO = (255, 0, 255), (0, 0, 0)


def annotated(
    picture: NDArray[np.uint8],
    lines: list[NDArray[np.float64]],
    view: View | None,
    caption: str,
) -> NDArray[np.uint8]:
    """A picture with lines of the world in it, and a caption below.

    Args:
        picture: RGB (rows, columns, 3) of a sensor; small ones are drawn larger.
        lines: points (k, 3) each, in the frame of the view's mount; those that can't be placed are
            left out.
        view: how the picture was taken; None: the lines are left out.
        caption: one line.

    Returns:
        RGB (rows, columns, 3).
    """
    import cv2  # noqa: PLC0415

    factor = max(1, -(-LEAST_WIDTH_PX // picture.shape[1]))
    canvas = np.ascontiguousarray(picture.repeat(factor, 0).repeat(factor, 1))
    placed = [None if view is None else view.pixels(points) for points in lines]
    for color, thickness in ((HALO, 4), (INK, 2)):
        for pixels in placed:
            if pixels is not None:
                corners = np.rint(pixels * factor).astype(np.int32)
                cv2.polylines(canvas, [corners], False, color, thickness, cv2.LINE_AA)
    return captioned(canvas, caption)


def captioned(picture: NDArray[np.uint8], caption: str) -> NDArray[np.uint8]:
    """A picture (rows, columns, 3) with one line of text below; what is too long is cut off."""
    import cv2  # noqa: PLC0415

    band = np.full((TEXT_HEIGHT_PX, picture.shape[1], 3), 255, np.uint8)
    place, font = (6, TEXT_HEIGHT_PX - 8), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(band, caption, place, font, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([picture, band])
