from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pybullet
import pytest

from envs.grasp.robot.kinematics import forward
from envs.grasp.robot.urdf import KR16_URDF, Box, Cylinder, Robot, load_robot

# The data sheet, in the link's own frame (m).
ENVELOPES = {
    "base": ((-0.40, -0.27, 0.0), (0.28, 0.27, 0.40)),
    "link_1": ((-0.27, -0.27, -0.29), (0.39, 0.27, 0.17)),
    "link_2": ((-0.09, -0.28, -0.11), (0.77, -0.08, 0.11)),
    "link_3": ((-0.36, -0.12, -0.17), (0.40, 0.21, 0.12)),
    "link_4": ((-0.27, -0.06, -0.06), (0.06, 0.06, 0.06)),
    "link_5": ((-0.06, -0.09, -0.05), (0.15, 0.11, 0.05)),
    "link_6": ((0.146, -0.039, -0.039), (0.158, 0.039, 0.039)),
    "stem": ((-0.016, -0.016, 0.0), (0.016, 0.016, 0.09)),
    "cup": ((-0.03, -0.03, 0.0), (0.03, 0.03, 0.03)),
}


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot()


def corners(shape: Box | Cylinder) -> np.ndarray:
    """(8, 4) homogeneous corners of the shape's own bounding box, in the link's frame."""
    half = (
        shape.half_extents_m
        if isinstance(shape, Box)
        else np.array([shape.radius_m, shape.radius_m, shape.length_m / 2])
    )
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    return np.hstack([signs * half, np.ones((8, 1))]) @ shape.pose.T


def test_joints_are_those_of_the_data_sheet(robot: Robot) -> None:
    assert robot.joint_names == ("A1", "A2", "A3", "A4", "A5", "A6")
    np.testing.assert_array_equal(
        robot.joint_axes, [[0, 0, -1], [0, 1, 0], [0, 1, 0], [-1, 0, 0], [0, 1, 0], [-1, 0, 0]]
    )
    np.testing.assert_allclose(np.rad2deg(robot.lower_rad), [-185, -155, -130, -350, -130, -350])
    np.testing.assert_allclose(np.rad2deg(robot.upper_rad), [185, 35, 154, 350, 130, 350])
    np.testing.assert_allclose(
        np.rad2deg(robot.max_speed_rad_s), [156, 156, 156, 330, 330, 615], rtol=1e-12
    )
    moved = [link for link, joint in enumerate(robot.link_joints) if joint >= 0]
    np.testing.assert_array_equal(
        robot.link_origins[moved][:, :3, 3],
        [[0, 0, 0.675], [0.26, 0, 0], [0.68, 0, 0], [0.67, 0, -0.035], [0, 0, 0], [0, 0, 0]],
    )


def test_tool_points_out_of_the_flange(robot: Robot) -> None:
    # 0.158 m to the flange, 0.12 m of tool; tool x is down, tool z forward
    expected = [[0, 0, 1, 0.278], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(robot.tooltip, expected, atol=1e-15)


@pytest.mark.parametrize("name", ENVELOPES)
def test_shapes_stay_inside_the_links_envelope(robot: Robot, name: str) -> None:
    shapes = robot.link_primitives[robot.link_names.index(name)]
    points = np.concatenate([corners(shape) for shape in shapes])[:, :3]
    lower, upper = ENVELOPES[name]
    assert (points >= np.array(lower) - 1e-9).all()
    assert (points <= np.array(upper) + 1e-9).all()


def test_links_with_a_body_are_the_enveloped_ones(robot: Robot) -> None:
    bodies = {
        name for name, shapes in zip(robot.link_names, robot.link_primitives, strict=True) if shapes
    }
    assert bodies == set(ENVELOPES)


def test_front_of_link_5_is_slim(robot: Robot) -> None:
    shapes = robot.link_primitives[robot.link_names.index("link_5")]
    points = np.concatenate([corners(shape) for shape in shapes])
    front = points[points[:, 0] > 0.061]
    assert len(front) > 0
    assert np.hypot(front[:, 1], front[:, 2]).max() <= 0.04


def test_cup_has_60_mm_and_ends_at_the_tooltip(robot: Robot) -> None:
    (cup,) = robot.link_primitives[robot.link_names.index("cup")]
    assert isinstance(cup, Cylinder)
    assert cup.radius_m == 0.03
    to_tooltip = robot.link_origins[robot.tooltip_link]
    assert cup.pose[2, 3] + cup.length_m / 2 == pytest.approx(to_tooltip[2, 3])


def test_home_leaves_the_blocks_region_free(robot: Robot) -> None:
    frames = forward(robot, robot.home_rad)
    for frame, shapes in zip(frames, robot.link_primitives, strict=True):
        for shape in shapes:
            grid = _filled(corners(shape)) @ frame.T
            x, y, z = grid[:, :3].T
            assert not ((x > 0.6) & (np.abs(y) < 0.8) & (z > 0.5) & (z < 1.2)).any()
            assert not ((x > 0.5) & (z < 1.25)).any()


def _filled(box: np.ndarray) -> np.ndarray:
    """Points 1/20 of a side apart throughout the box with these corners, (n, 4)."""
    origin, edges = box[0], box[[4, 2, 1]] - box[0]
    part = np.linspace(0, 1, 21)
    weights = np.stack(np.meshgrid(part, part, part, indexing="ij"), axis=-1).reshape(-1, 3)
    return origin + weights @ edges


def test_home_is_within_the_limits(robot: Robot) -> None:
    home = robot.home_rad
    np.testing.assert_allclose(np.degrees(home), [0, -110, 100, 0, -60, 0])
    assert ((home > robot.lower_rad) & (home < robot.upper_rad)).all()


def test_shapes_agree_with_pybullets_reading_and_visuals_with_collisions(robot: Robot) -> None:
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(
            str(KR16_URDF),
            useFixedBase=True,
            flags=pybullet.URDF_USE_IMPLICIT_CYLINDER,  # else collision cylinders become hulls
            physicsClientId=client,
        )
        visuals = pybullet.getVisualShapeData(body, physicsClientId=client)
        names = ["base"] + [
            pybullet.getJointInfo(body, joint, physicsClientId=client)[12].decode()
            for joint in range(pybullet.getNumJoints(body, physicsClientId=client))
        ]
        seen = [_comparable(names[v[1] + 1], v[2], v[3]) for v in visuals]
        solid = [
            _comparable(name, c[2], c[3])
            for link, name in enumerate(names)
            for c in pybullet.getCollisionShapeData(body, link - 1, physicsClientId=client)
        ]
    finally:
        pybullet.disconnect(client)
    ours = [
        _comparable(name, *_as_pybullet(shape))
        for name, shapes in zip(robot.link_names, robot.link_primitives, strict=True)
        for shape in shapes
    ]
    assert sorted(seen) == sorted(solid) == sorted(ours)


def _as_pybullet(shape: Box | Cylinder) -> tuple[int, tuple[float, ...]]:
    if isinstance(shape, Box):
        return pybullet.GEOM_BOX, tuple(2 * shape.half_extents_m)
    return pybullet.GEOM_CYLINDER, (shape.length_m, shape.radius_m, 0.0)


def _comparable(name: str, kind: int, size: tuple[float, ...]) -> tuple[object, ...]:
    return name, kind, *(round(float(value), 6) for value in size[: 3 if kind == 3 else 2])


MINIMAL = """<robot name="r">
  <link name="base"/>
  <link name="{tip}"><collision><geometry>{shape}</geometry></collision></link>
  <joint name="A1" type="{kind}"><parent link="base"/><child link="{tip}"/>{more}</joint>
</robot>"""
GOOD = {
    "tip": "tooltip",
    "shape": '<box size="1 2 3"/>',
    "kind": "revolute",
    "more": '<axis xyz="0 0 2"/><limit lower="-1" upper="1" velocity="2"/>',
}


def write(tmp_path: Path, **changes: str) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(MINIMAL.format(**(GOOD | changes)), encoding="utf-8")
    return path


def test_reads_a_minimal_robot(tmp_path: Path) -> None:
    robot = load_robot(write(tmp_path))
    assert robot.link_names == ("base", "tooltip")
    np.testing.assert_array_equal(robot.joint_axes, [[0, 0, 1]])
    (box,) = robot.link_primitives[1]
    assert isinstance(box, Box)
    np.testing.assert_array_equal(box.half_extents_m, [0.5, 1.0, 1.5])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shape": '<mesh filename="a.stl"/>'}, ["link 'tooltip'", "'mesh'", "<box>"]),
        ({"shape": '<box size="1 2"/>'}, ["link 'tooltip'", "2 numbers instead of 3"]),
        ({"shape": '<cylinder radius="1"/>'}, ["link 'tooltip'", "'length'"]),
        ({"shape": '<box size="1 2 x"/>'}, ["'1 2 x'", "not a list of numbers"]),
        ({"kind": "prismatic"}, ["joint 'A1'", "'prismatic'", "revolute"]),
        ({"more": '<axis xyz="0 0 1"/>'}, ["joint 'A1'", "<limit>"]),
        ({"more": '<axis xyz="0 0 0"/><limit lower="0" upper="1" velocity="1"/>'}, ["no length"]),
        ({"tip": "tip"}, ["tooltip", "add an empty one"]),
        ({"shape": "<box>"}, ["not well-formed"]),
    ],
)
def test_errors_name_file_element_and_way_out(
    tmp_path: Path, changes: dict[str, str], words: list[str]
) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(ValueError, match=r"arm\.urdf") as caught:
        load_robot(path)
    for word in words:
        assert word in str(caught.value)


def test_refuses_joints_to_unknown_links_and_loose_links(tmp_path: Path) -> None:
    path = write(tmp_path)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('parent link="base"', 'parent link="bse"'), encoding="utf-8")
    with pytest.raises(ValueError, match="'bse', which does not exist"):
        load_robot(path)
    path.write_text(text.replace("</robot>", '<link name="loose"/></robot>'), encoding="utf-8")
    with pytest.raises(ValueError, match="exactly one link"):
        load_robot(path)
