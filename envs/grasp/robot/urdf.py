"""The robot as data: what its URDF says, in arrays that kinematics and simulators share."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

KR16_URDF = Path(__file__).with_name("kr16.urdf")

_TOOLTIP, _CUP, _HOME = "tooltip", "cup", "home"
_LIMIT_KEYS = ("lower", "upper", "velocity")


@dataclass(frozen=True, eq=False)
class Box:
    """A box: half extents (3,) in metres, and its pose (4, 4) in the link's frame."""

    half_extents_m: np.ndarray
    pose: np.ndarray

    @property
    def bounding_radius_m(self) -> float:
        """Radius of the ball about it."""
        return float(np.linalg.norm(self.half_extents_m))


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A cylinder along its own z axis, centred, with its pose (4, 4) in the link's frame."""

    radius_m: float
    length_m: float
    pose: np.ndarray

    @property
    def bounding_radius_m(self) -> float:
        """Radius of the ball about it, which goes through its rims."""
        return float(np.hypot(self.radius_m, self.length_m / 2.0))


Primitive = Box | Cylinder


@dataclass(frozen=True, eq=False)
class Robot:
    """A tree of J revolute joints and L links, parents before children; the base comes first.

    Attributes:
        path: The URDF it was read from.
        joint_names: The J moving joints.
        joint_axes: (J, 3) unit vectors in the joint's own frame.
        lower_rad: (J,) lower joint limits.
        upper_rad: (J,) upper joint limits.
        max_speed_rad_s: (J,) largest joint speeds.
        home_rad: (J,) where the robot waits: the file's <group_state name="home">, as SRDF writes
            it; zeros where it has none.
        link_names: The L links.
        link_parents: For each link the index of its parent; -1 for the base.
        link_joints: For each link the index of the joint that moves it; -1 where it is fixed.
        link_origins: (L, 4, 4) each link's frame in its parent's frame with all joints at zero.
        link_primitives: For each link its collision shapes, which are its visual shapes too.
        link_colors: (L, 3) red, green and blue in [0, 1] of each link's first visual shape; white
            where it has none.
    """

    path: Path
    joint_names: tuple[str, ...]
    joint_axes: np.ndarray
    lower_rad: np.ndarray
    upper_rad: np.ndarray
    max_speed_rad_s: np.ndarray
    home_rad: np.ndarray
    link_names: tuple[str, ...]
    link_parents: tuple[int, ...]
    link_joints: tuple[int, ...]
    link_origins: np.ndarray
    link_primitives: tuple[tuple[Primitive, ...], ...]
    link_colors: np.ndarray

    @property
    def tooltip_link(self) -> int:
        """Index of the tooltip's frame among the links."""
        return self.link_names.index(_TOOLTIP)

    @property
    def cup_link(self) -> int:
        """Index of the suction cup among the links; the cup is its only shape, a cylinder."""
        return self.link_names.index(_CUP)

    @property
    def cup_radius_m(self) -> float:
        """Radius of the cup's face."""
        (cup,) = self.link_primitives[self.cup_link]
        assert isinstance(cup, Cylinder)
        return cup.radius_m

    @property
    def tooltip(self) -> np.ndarray:
        """(4, 4) the tooltip's frame in the frame of the last link that a joint moves."""
        link, transform = self.tooltip_link, np.eye(4)
        while self.link_joints[link] < 0 <= self.link_parents[link]:
            transform = self.link_origins[link] @ transform
            link = self.link_parents[link]
        return transform


def load_robot(path: str | Path = KR16_URDF) -> Robot:
    """Reads a robot from its URDF.

    Args:
        path: A URDF of revolute and fixed joints whose collision shapes are boxes and cylinders,
            with a link called `tooltip`.

    Returns:
        The robot.

    Raises:
        ValueError: A joint or a shape is of another kind, a value is missing, or there is no
            tooltip; the message names the file and the element.
        OSError: The file can't be read.
    """
    path = Path(path)
    try:
        root = ET.parse(path).getroot()
    except ET.ParseError as error:
        raise ValueError(f"{path}: not well-formed XML: {error}") from error
    links = {_attribute(link, "name", str(path)): link for link in root.findall("link")}
    if _TOOLTIP not in links:
        raise ValueError(
            f"{path}: no link is called '{_TOOLTIP}'; add an empty one at the centre of the "
            "cup's face, its z axis pointing out of the cup"
        )
    joints = {child: joint for joint in root.findall("joint") for child in [_end(joint, path)[1]]}
    order = _parents_first(path, links, {c: _end(j, path)[0] for c, j in joints.items()})
    moving = [name for name in order if name in joints and _moves(joints[name], path)]
    limits = np.array([_limit(joints[name], path) for name in moving]).reshape(-1, 3)
    axes = np.array([_axis(joints[name], path) for name in moving]).reshape(-1, 3)
    joint_names = tuple(_attribute(joints[name], "name", str(path)) for name in moving)
    return Robot(
        path=path,
        joint_names=joint_names,
        joint_axes=axes,
        lower_rad=limits[:, 0],
        upper_rad=limits[:, 1],
        max_speed_rad_s=limits[:, 2],
        home_rad=_home(root, joint_names, path),
        link_names=tuple(order),
        link_parents=tuple(
            order.index(_end(joints[name], path)[0]) if name in joints else -1 for name in order
        ),
        link_joints=tuple(moving.index(name) if name in moving else -1 for name in order),
        link_origins=np.stack(
            [_origin(joints[name], str(path)) if name in joints else np.eye(4) for name in order]
        ),
        link_primitives=tuple(_primitives(links[name], path) for name in order),
        link_colors=np.array([_color(links[name], root, path) for name in order]),
    )


def _parents_first(path: Path, links: dict[str, ET.Element], parent: dict[str, str]) -> list[str]:
    """Link names from the root outwards, siblings in the file's order."""
    unknown = (set(parent) | set(parent.values())) - set(links)
    if unknown:
        raise ValueError(f"{path}: a joint names the link '{min(unknown)}', which does not exist")
    roots = [name for name in links if name not in parent]
    if len(roots) != 1:
        raise ValueError(f"{path}: needs exactly one link that is no joint's child, has {roots}")
    order = roots
    for name in order:  # grows while it is walked: breadth first
        order.extend(child for child in links if parent.get(child) == name)
    if len(order) != len(links):
        raise ValueError(f"{path}: the joints of {sorted(set(links) - set(order))} form a loop")
    return order


def _end(joint: ET.Element, path: Path) -> tuple[str, str]:
    """The parent's and the child's name."""
    where = f"{path}: joint '{joint.get('name')}'"
    return (
        _attribute(_child(joint, "parent", where), "link", where),
        _attribute(_child(joint, "child", where), "link", where),
    )


def _moves(joint: ET.Element, path: Path) -> bool:
    kind = joint.get("type")
    if kind not in {"revolute", "fixed"}:
        raise ValueError(
            f"{path}: joint '{joint.get('name')}' is of type '{kind}'; only revolute (with "
            "limits) and fixed joints are supported"
        )
    return kind == "revolute"


def _limit(joint: ET.Element, path: Path) -> list[float]:
    """Lower and upper limit (rad) and largest speed (rad/s)."""
    where = f"{path}: joint '{joint.get('name')}'"
    limit = _child(joint, "limit", where)
    return [_numbers(_attribute(limit, key, where), 1, where)[0] for key in _LIMIT_KEYS]


def _home(root: ET.Element, joint_names: tuple[str, ...], path: Path) -> np.ndarray:
    """(J,) the joint angles of the state called home; zeros where there is none."""
    where, home = f"{path}: group_state '{_HOME}'", np.zeros(len(joint_names))
    for joint in root.iterfind(f"group_state[@name='{_HOME}']/joint"):
        name = _attribute(joint, "name", where)
        if name not in joint_names:
            raise ValueError(f"{where}: no moving joint is called '{name}'")
        (home[joint_names.index(name)],) = _numbers(_attribute(joint, "value", where), 1, where)
    return home


def _axis(joint: ET.Element, path: Path) -> np.ndarray:
    where = f"{path}: joint '{joint.get('name')}'"
    axis = _numbers(_attribute(_child(joint, "axis", where), "xyz", where), 3, where)
    length = np.linalg.norm(axis)
    if length == 0.0:
        raise ValueError(f"{where}: its axis has no length")
    return axis / length


def _primitives(link: ET.Element, path: Path) -> tuple[Primitive, ...]:
    where = f"{path}: link '{link.get('name')}'"
    return tuple(_primitive(collision, where) for collision in link.findall("collision"))


def _color(link: ET.Element, root: ET.Element, path: Path) -> np.ndarray:
    """(3,) the color of a link's first visual shape, by the name of a material of the robot."""
    where = f"{path}: link '{link.get('name')}'"
    material = link.find("visual/material")
    if material is None:
        return np.ones(3)
    name = _attribute(material, "name", where)
    color = root.find(f"material[@name='{name}']/color")
    if color is None:
        raise ValueError(f"{where}: the robot has no <material name='{name}'> with a <color>")
    return _numbers(_attribute(color, "rgba", where), 4, where)[:3]


def _primitive(collision: ET.Element, where: str) -> Primitive:
    shapes = list(_child(collision, "geometry", where))
    tag = shapes[0].tag if len(shapes) == 1 else f"{len(shapes)} shapes"
    pose = _origin(collision, where)
    if tag == "box":
        return Box(_numbers(_attribute(shapes[0], "size", where), 3, where) / 2.0, pose)
    if tag == "cylinder":
        radius, length = (
            float(_numbers(_attribute(shapes[0], key, where), 1, where)[0])
            for key in ("radius", "length")
        )
        return Cylinder(radius, length, pose)
    raise ValueError(
        f"{where}: a collision geometry of '{tag}' is not supported; "
        "model it with one <box> or one <cylinder> per <collision>"
    )


def _origin(element: ET.Element, where: str) -> np.ndarray:
    """(4, 4) the URDF's origin: roll, pitch, yaw about the fixed axes x, y, z, then xyz."""
    transform = np.eye(4)
    origin = element.find("origin")
    if origin is None:
        return transform
    transform[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), 3, where)
    (cr, cp, cy), (sr, sp, sy) = (
        function(_numbers(origin.get("rpy", "0 0 0"), 3, where)) for function in (np.cos, np.sin)
    )
    transform[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return transform


def _child(element: ET.Element, tag: str, where: str) -> ET.Element:
    child = element.find(tag)
    if child is None:
        raise ValueError(f"{where}: <{element.tag}> has no <{tag}>")
    return child


def _attribute(element: ET.Element, key: str, where: str) -> str:
    value = element.get(key)
    if value is None:
        raise ValueError(f"{where}: <{element.tag}> has no attribute '{key}'")
    return value


def _numbers(text: str, count: int, where: str) -> np.ndarray:
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise ValueError(f"{where}: '{text}' is not a list of numbers") from error
    if numbers.shape != (count,):
        raise ValueError(f"{where}: '{text}' has {numbers.size} numbers instead of {count}")
    return numbers
