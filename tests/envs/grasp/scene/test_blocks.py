from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.grasp.scene.blocks import (
    DISC_RADIUS_M,
    L_SHAPE,
    MAX_BAR_SHARE,
    MIN_BAR_M,
    PARALLELEPIPED,
    U_SHAPE,
    build_block,
)

SHAPES = [PARALLELEPIPED, L_SHAPE, U_SHAPE]
BOX_COUNTS = {PARALLELEPIPED: 1, L_SHAPE: 2, U_SHAPE: 3}
PIXEL_M = 0.0005
TOLERANCE_M = 1.5 * PIXEL_M
MARGIN_PX = 4


@dataclass(frozen=True)
class Blocks:
    """Built blocks: boxes (n, 3, 3), grasp points (n, 2) and size (n, 3)."""

    center_m: np.ndarray
    half_m: np.ndarray
    disc_m: np.ndarray
    centroid_m: np.ndarray
    size_m: np.ndarray


def block(
    shape: int,
    *,
    width: float = 0.2,
    height: float = 0.2,
    depth: float = 0.1,
    bar: float = 0.1,
    leg_share: float = 0.5,
    on_left: bool = True,
) -> Blocks:
    center, half, size = np.ones((3, 3)), np.ones((3, 3)), np.array([depth, width, height])
    points = build_block(shape, size, bar, leg_share, on_left, center, half)
    return Blocks(
        center[None], half[None], *np.array([points[:2], points[2:]])[:, None], size[None]
    )


def random_blocks(shape: int, count: int, seed: int = 0) -> Blocks:
    rng = np.random.default_rng(seed)
    built = []
    for _ in range(count):
        width, height = rng.uniform(0.12, 0.24, 2)
        built.append(
            block(
                shape,
                width=width,
                height=height,
                depth=rng.uniform(0.08, 0.12),
                bar=rng.uniform(MIN_BAR_M, max(MIN_BAR_M, MAX_BAR_SHARE * height)),
                leg_share=rng.random(),
                on_left=rng.random() < 0.5,
            )
        )
    return Blocks(
        *(np.concatenate([getattr(one, field.name) for one in built]) for field in fields(Blocks))
    )


def rectangles(blocks: Blocks, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corners (k, 2), y and z, of the boxes that a block has, on its face."""
    used = blocks.half_m[row, :, 0] > 0
    center, half = blocks.center_m[row, used, 1:], blocks.half_m[row, used, 1:]
    return center - half, center + half


def clearance_map(blocks: Blocks, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance (m) of every pixel's centre of the face to the nearest point off it.

    Brute force: the face is painted, and a distance transform measures it. Returns the map and the
    (y, z) of its first pixel.
    """
    low, high = rectangles(blocks, row)
    origin = low.min(0) - MARGIN_PX * PIXEL_M
    count = np.ceil((high.max(0) - origin) / PIXEL_M).astype(int) + MARGIN_PX
    y, z = (origin[axis] + PIXEL_M * (np.arange(count[axis]) + 0.5) for axis in (0, 1))
    inside = np.zeros((count[0], count[1]), np.uint8)
    for (y0, z0), (y1, z1) in zip(low, high, strict=True):
        inside |= ((y >= y0) & (y <= y1))[:, None] & ((z >= z0) & (z <= z1))
    return cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * PIXEL_M, origin


def check_disc(blocks: Blocks, row: int) -> float:
    """Asserts that no other disc on the face is larger; returns its radius."""
    clearance, origin = clearance_map(blocks, row)
    pixel = tuple(((blocks.disc_m[row] - origin) / PIXEL_M).astype(int))
    assert clearance[pixel] >= clearance.max() - TOLERANCE_M
    return float(clearance[pixel])


@pytest.mark.parametrize("shape", SHAPES)
def test_disc_is_the_largest_of_the_face_and_has_room_for_the_cup(shape: int) -> None:
    blocks = random_blocks(shape, 60)
    for row in range(60):
        assert check_disc(blocks, row) >= DISC_RADIUS_M - TOLERANCE_M


@settings(max_examples=60, deadline=None)
@given(
    shape=st.sampled_from([L_SHAPE, U_SHAPE]),
    width=st.floats(0.12, 0.24),
    height=st.floats(0.12, 0.24),
    bar_share=st.floats(0, 1),
    leg_share=st.floats(0, 1),
    on_left=st.booleans(),
)
def test_disc_is_the_largest_for_extreme_dimensions(
    *, shape: int, width: float, height: float, bar_share: float, leg_share: float, on_left: bool
) -> None:
    bar = 0.08 + bar_share * max(0.0, height / 2 - 0.08)
    blocks = block(shape, width=width, height=height, bar=bar, leg_share=leg_share, on_left=on_left)
    assert check_disc(blocks, 0) >= DISC_RADIUS_M - TOLERANCE_M


@pytest.mark.parametrize(
    ("shape", "width", "height", "bar", "leg_share"),
    [
        (L_SHAPE, 0.24, 0.12, 0.08, 1.0),  # the corner's disc would reach below the leg
        (L_SHAPE, 0.12, 0.24, 0.12, 0.0),  # and here over the bar's end
        (U_SHAPE, 0.12, 0.24, 0.12, 0.0),
    ],
)
def test_disc_stays_on_a_face_that_is_smaller_than_the_corners_disc(
    shape: int, width: float, height: float, bar: float, leg_share: float
) -> None:
    radius = check_disc(block(shape, width=width, height=height, bar=bar, leg_share=leg_share), 0)
    assert radius == pytest.approx(0.06, abs=TOLERANCE_M)


def test_discs_of_a_hand_computed_block() -> None:
    # Leg 0.1, bar 0.1: r = 0.2 - sqrt(0.02) = 0.058579, in the top corner on the leg's side.
    left = block(L_SHAPE, leg_share=0.0)
    np.testing.assert_allclose(left.disc_m, [[0.1 - 0.0585786, 0.2 - 0.0585786]], atol=1e-7)
    right = block(L_SHAPE, leg_share=0.0, on_left=False)
    np.testing.assert_allclose(right.disc_m, left.disc_m * [-1, 1], atol=1e-12)
    np.testing.assert_allclose(block(PARALLELEPIPED, height=0.14).disc_m, [[0.0, 0.07]])


@pytest.mark.parametrize("on_left", [True, False])
def test_of_a_us_two_discs_the_left_one_is_meant(on_left: bool) -> None:
    blocks = block(U_SHAPE, on_left=on_left)
    assert blocks.disc_m[0, 0] > 0.01
    clearance, origin = clearance_map(blocks, 0)
    mirrored = blocks.disc_m[0] * [-1, 1]
    here, there = (
        clearance[tuple(((point - origin) / PIXEL_M).astype(int))]
        for point in (blocks.disc_m[0], mirrored)
    )
    assert here == pytest.approx(there, abs=TOLERANCE_M)  # it is a tie indeed


@pytest.mark.parametrize("shape", SHAPES)
def test_boxes_are_disjoint_and_fill_the_blocks_outline(shape: int) -> None:
    blocks = random_blocks(shape, 200)
    depth, width, height = blocks.size_m.T
    for row in range(200):
        low, high = rectangles(blocks, row)
        assert len(low) == BOX_COUNTS[shape]
        for i in range(len(low)):
            for j in range(i):
                sides = np.minimum(high[i], high[j]) - np.maximum(low[i], low[j])
                assert sides.min() <= 1e-12
        np.testing.assert_allclose(low.min(0), [-width[row] / 2, 0.0], atol=1e-12)
        np.testing.assert_allclose(high.max(0), [width[row] / 2, height[row]], atol=1e-12)
        used = blocks.half_m[row, :, 0] > 0
        assert (blocks.half_m[row, used] > 0).all()
        assert not blocks.half_m[row, ~used].any()
        # all boxes reach from the face to the back
        x, half = blocks.center_m[row, used, 0], blocks.half_m[row, used, 0]
        np.testing.assert_allclose(x - half, 0.0, atol=1e-12)
        np.testing.assert_allclose(x + half, depth[row])


@settings(deadline=None)
@given(
    shape=st.sampled_from(SHAPES),
    width=st.floats(0.12, 0.24),
    height=st.floats(0.12, 0.24),
    bar_share=st.floats(0, 1),
    leg_share=st.floats(0, 1),
    on_left=st.booleans(),
)
def test_blocks_stand_by_themselves(
    *, shape: int, width: float, height: float, bar_share: float, leg_share: float, on_left: bool
) -> None:
    bar = 0.08 + bar_share * max(0.0, height / 2 - 0.08)
    blocks = block(shape, width=width, height=height, bar=bar, leg_share=leg_share, on_left=on_left)
    low, high = rectangles(blocks, 0)
    foot = low[:, 1] < 1e-9
    # All boxes are equally deep: the centre of mass is the centroid of the face.
    assert low[foot, 0].min() + 0.005 < blocks.centroid_m[0, 0] < high[foot, 0].max() - 0.005


def test_pieces_of_an_l_and_a_u() -> None:
    # L: leg in [0.5, 0.6] of the width; U: in [0.25, 0.35].
    low, high = rectangles(block(L_SHAPE, leg_share=1.0), 0)
    np.testing.assert_allclose(low, [[-0.1, 0.1], [-0.02, 0.0]], atol=1e-12)
    np.testing.assert_allclose(high, [[0.1, 0.2], [0.1, 0.1]], atol=1e-12)
    low, high = rectangles(block(L_SHAPE, leg_share=1.0, on_left=False), 0)
    np.testing.assert_allclose(low, [[-0.1, 0.1], [-0.1, 0.0]], atol=1e-12)
    low, high = rectangles(block(U_SHAPE, leg_share=0.0, on_left=False), 0)
    np.testing.assert_allclose(low, [[-0.1, 0.1], [0.05, 0.0], [-0.1, 0.0]], atol=1e-12)
    np.testing.assert_allclose(high, [[0.1, 0.2], [0.1, 0.1], [-0.05, 0.1]], atol=1e-12)


def test_centroids_of_hand_computed_blocks() -> None:
    np.testing.assert_allclose(block(PARALLELEPIPED, height=0.16).centroid_m, [[0.0, 0.08]])
    # L: bar 0.2 x 0.1 at (0, 0.15), leg 0.1 x 0.1 at (0.05, 0.05).
    np.testing.assert_allclose(block(L_SHAPE, leg_share=0.0).centroid_m, [[0.05 / 3, 0.35 / 3]])
    # U: the same bar, legs 0.06 x 0.1 at z = 0.05.
    np.testing.assert_allclose(
        block(U_SHAPE).centroid_m, [[0.0, (0.02 * 0.15 + 0.012 * 0.05) / 0.032]], atol=1e-12
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_centroid_agrees_with_random_points_of_the_face(shape: int) -> None:
    blocks, rng = random_blocks(shape, 5, seed=1), np.random.default_rng(0)
    for row in range(5):
        low, high = rectangles(blocks, row)
        points = rng.uniform(low.min(0), high.max(0), (200_000, 2))
        inside = ((points[:, None] >= low) & (points[:, None] <= high)).all(-1).any(-1)
        np.testing.assert_allclose(points[inside].mean(0), blocks.centroid_m[row], atol=8e-4)
