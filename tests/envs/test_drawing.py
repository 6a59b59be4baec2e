"""Pictures: lines where the view has them, in a picture that is large enough."""

from __future__ import annotations

import numpy as np

from encoders.cameras import Pinhole, Sampling
from envs.deployment import Mount
from envs.drawing import INK, TEXT_HEIGHT_PX, annotated
from envs.views import View

VIEW = View(
    sampling=Sampling.whole(80, 160),
    pinhole=Pinhole(100.0, 100.0, 80.0, 40.0),
    mount=Mount.of(np.zeros(3), np.eye(3)),
)
GRAY = np.full((80, 160, 3), 100, np.uint8)


def inked(picture: np.ndarray) -> np.ndarray:
    """Rows and columns (k, 2) of what is drawn."""
    return np.argwhere((picture == INK).all(axis=-1))


def test_a_line_is_drawn_where_it_is_seen() -> None:
    across = np.array([[-0.2, 0.1, 1.0], [0.3, 0.1, 1.0]])  # pixels (60, 50) to (110, 50)
    picture = annotated(GRAY, [across], VIEW, "")
    assert picture.shape == (240 + TEXT_HEIGHT_PX, 480, 3)
    rows, columns = inked(picture).T
    assert (abs(rows - 150) <= 2).all()
    assert abs(columns.min() - 180) <= 2
    assert abs(columns.max() - 330) <= 2


def test_what_has_no_place_is_left_out_and_the_caption_is_there() -> None:
    behind = np.array([[0.0, 0.0, -1.0], [0.3, 0.1, 1.0]])
    for view, lines in ((VIEW, [behind]), (None, [behind]), (VIEW, [])):
        picture = annotated(GRAY, lines, view, "x 1.00 mm")
        assert len(inked(picture)) == 0
        assert (picture[-TEXT_HEIGHT_PX:] == 0).any()
