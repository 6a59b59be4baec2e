"""The space of point clouds."""

import numpy as np
import pytest

from encoders.inputs import image_input, vector_input
from encoders.spaces import NOTHING_SEEN_RGB, PointCloud, RgbImage

# Four points of a square, the nearest at the top left, and a row without a point.
SQUARE = np.float32([[0, 0, 1, 1], [1, 0, 2, 1], [0, 1, 3, 1], [1, 1, 4, 1], [0, 0, 0, 0]])


def test_clouds_are_in_the_space_and_other_arrays_are_not():
    space = PointCloud(5)
    assert space.shape == (5, 4)
    assert space.contains(SQUARE)
    assert space.contains(space.sample())
    assert not space.contains(SQUARE[:4])
    assert not space.contains(SQUARE * 2)  # the last number is 1 or 0


def test_spaces_are_equal_when_their_numbers_mean_the_same():
    space = PointCloud(5, "base", (1.0, 0.0, 0.5))
    assert space == PointCloud(5, "base", (1, 0, 0.5))
    assert hash(space) == hash(PointCloud(5, "base", (1, 0, 0.5)))
    others = PointCloud(6, "base", (1, 0, 0.5)), PointCloud(5, "camera", (1, 0, 0.5))
    assert space not in (*others, PointCloud(5, "base"), RgbImage(5, 4))
    assert repr(space) == "PointCloud(5, 'base', middle_m=(1.0, 0.0, 0.5))"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "at least one point, not for 0"),
        ((5, "world"), "'world' of a cloud is unknown: use 'camera' or 'base'"),
        ((5, "base", (0.0, np.nan, 0.0)), "three finite numbers"),
        ((5, "base", (0.0, 0.0)), "three finite numbers"),
    ],
)
def test_what_is_no_space_of_clouds_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        PointCloud(*arguments)


def corners(picture):
    return [picture[row, column].tolist() for row in (0, -1) for column in (0, -1)]


def test_a_picture_shows_points_as_the_camera_sees_them():
    picture = PointCloud(5).picture(SQUARE)
    assert (picture != NOTHING_SEEN_RGB).any(axis=2).sum() == 4
    nearest, _, _, farthest = corners(picture)
    assert nearest[0] > nearest[2]  # warm
    assert farthest[2] > farthest[0]  # cold
    assert len({tuple(corner) for corner in corners(picture)}) == 4


def test_a_picture_of_the_base_is_from_above_with_forward_up():
    # Seen from above, x forward is up and y left is left: the highest is at x = 1, y = 1.
    camera, base = (corners(PointCloud(5, frame).picture(SQUARE)) for frame in ("camera", "base"))
    upside_down = [4 + 1 - z for z in (4, 2, 3, 1)]  # as far as the camera's are, corner by corner
    assert base == [camera[z - 1] for z in upside_down]


def test_the_nearer_of_two_points_hides_the_other():
    far, near = np.float32([0, 0, 2, 1]), np.float32([0, 0, 1, 1])
    other = np.float32([1, 1, 2, 1])
    for cloud in ([far, near, other], [near, far, other]):
        picture = PointCloud(3).picture(np.stack(cloud))
        assert (picture[0, 0] != picture[-1, -1]).any()


def test_a_picture_of_no_points_is_gray():
    assert (PointCloud(5).picture(np.zeros((5, 4), np.float32)) == NOTHING_SEEN_RGB).all()


def test_encoders_of_images_and_vectors_point_to_that_of_clouds():
    for build in (image_input, vector_input):
        with pytest.raises(ValueError, match="use the encoder 'pointnet'"):
            build(PointCloud(5))
