"""Reading of the parts of a URDF that Dora needs: the tree, the joints and the collision primitives."""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
import torch

from dora.digests import check_file
from dora.errors import InputError, shown
from dora.geometry.rotations import matrix_from_quaternion, quaternion_multiply
from dora.reading import read_text, read_xml
from dora.robot.shapes import Shape, merge_capsules
from dora.robot.urdf_values import (
    THINNEST,
    check_inertial,
    check_material,
    check_visual,
    child,
    lengths,
    numbers,
    origin,
    text,
)

MOVING = ("revolute", "prismatic", "continuous")
"""Types of joints with a degree of freedom."""
MOST_LINKS, MOST_SHAPES = 1000, 200
"""Largest number of links of a robot, and of collision shapes of a link [1]."""
LIMITS = ("lower", "upper", "velocity", "effort")
"""Attributes of a joint's limits."""
LEAST_AXIS = 1e-3
"""Length of a joint's axis below which the simulator takes another one [1]."""
Z_TO_X = (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0)
"""Rotation (quaternion wxyz) of local x, the axis of a `Shape`, into z, the axis of a URDF cylinder."""


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint of a URDF.

    Attributes:
        name, kind: name and type of the joint.
        parent, child: names of the links that it connects.
        origin: (4, 4) pose of the joint frame in the parent link [m].
        axis: (3,) direction of the axis in the joint frame.
        lower, upper: limits [rad], or [m] of a prismatic joint.
        velocity: velocity limit [rad/s] or [m/s].
        effort: limit of torque [N m] or force [N].
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: np.ndarray
    axis: np.ndarray
    lower: float
    upper: float
    velocity: float
    effort: float

    @property
    def moves(self) -> bool:
        """Whether the joint has a degree of freedom."""
        return self.kind in MOVING


@dataclass(frozen=True, eq=False)
class UrdfModel:
    """The tree of a URDF: link names, joints by name, and collision shapes by link (capsules merged)."""

    root: str
    links: tuple[str, ...]
    joints: dict[str, UrdfJoint]
    shapes: dict[str, tuple[Shape, ...]]

    def chain(self, tip: str) -> tuple[UrdfJoint, ...]:
        """Joints from the root link to the link `tip`, in that order, fixed ones included."""
        above = {joint.child: joint for joint in self.joints.values()}
        found = []
        while tip in above:
            found.append(above[tip])
            tip = above[tip].parent
        return tuple(reversed(found))

    @property
    def moving_joints(self) -> tuple[str, ...]:
        """Names of the moving joints, breadth first from the root; joints of one link in the file's order."""
        return tuple(j.name for j in _breadth_first(self.root, self.joints.values()) if j.moves)

    def frame(self, link: str, tip: str) -> np.ndarray:
        """Pose (4, 4) of the link `tip` in `link`, to which fixed joints connect it [m].

        Raises:
            ValueError: `tip` is not fixed to `link`.
        """
        joints = self.chain(tip)[len(self.chain(link)) :]
        if any(joint.moves for joint in joints) or not joints or joints[0].parent != link:
            raise ValueError(f"{tip} is not fixed to {link}")
        return reduce(np.matmul, [joint.origin for joint in joints])


def read_urdf(path: Path) -> UrdfModel:
    """Read a URDF file.

    Raises:
        InputError: there is no such file, it is too large, it is no text in UTF-8, it is not XML, a required element is
            missing, a number is not finite, a size, mass or inertia is none, a name is used twice, a lower limit
            exceeds its upper limit, or the links do not form one tree.
    """
    if not os.path.isfile(path):
        raise InputError(f"{path} does not exist; name the URDF file in robot.toml.")
    check_file(path)
    read_text(path, "URDF")  # the simulator reads no other encoding
    robot = read_xml(path, "URDF")
    try:
        joints = [_joint(element) for element in robot.findall("joint")]
        links = [text(element, "name") for element in robot.findall("link")]
        shapes = {text(link, "name"): _shapes(link) for link in robot.findall("link")}
        for link in robot.findall("link"):
            check_inertial(link)
            for visual in link.findall("visual"):
                check_visual(visual)
        for material in robot.findall("material"):
            check_material(material)
    except ValueError as error:
        raise InputError(f"{path} is not a URDF that Dora can read: {error}.") from error
    _check_tree(path, links, joints)
    root = next(iter(set(links) - {joint.child for joint in joints}))
    return UrdfModel(root, tuple(links), {joint.name: joint for joint in joints}, shapes)


def _breadth_first(root: str, joints: Iterable[UrdfJoint]) -> list[UrdfJoint]:
    """The joints below a link, level by level; those of one parent in the given order."""
    below: dict[str, list[UrdfJoint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    found = list(below.pop(root, ()))
    for joint in found:  # grows while it is read
        found += below.pop(joint.child, ())
    return found


def _check_tree(path: Path, links: list[str], joints: list[UrdfJoint]) -> None:
    for kind, names in (("link", links), ("joint", [joint.name for joint in joints])):
        twice = sorted(name for name, count in Counter(names).items() if count > 1)
        if twice:
            raise InputError(f"{path} has two {kind}s named {twice[0]!r}; give each its own name.")
    if max(len(links), len(joints)) > MOST_LINKS:
        raise InputError(f"{path} has more than {MOST_LINKS} links or joints: leave some out.")
    known, children = set(links), [joint.child for joint in joints]
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in known:
                raise InputError(f"{path}: joint {joint.name!r} names the link {link!r}, which is missing.")
        if joint.lower > joint.upper:
            raise InputError(f"{path}: joint {joint.name!r} has its lower limit above its upper limit.")
    roots = known - set(children)
    if len(roots) != 1 or len(children) != len(known) - 1 or len(_breadth_first(min(roots), joints)) != len(children):
        raise InputError(f"{path}: the links must form one tree with a single root.")


def _joint(element: ElementTree.Element) -> UrdfJoint:
    kind, name = text(element, "type"), text(element, "name")
    limit, axis = element.find("limit"), element.find("axis")
    if kind not in (*MOVING, "fixed"):
        raise ValueError(f"joint {name!r} is of the type {shown(kind)}, not one of {', '.join(MOVING)}, fixed")
    if kind in MOVING and limit is None:
        raise ValueError(f"joint {name!r} has no <limit>")
    try:
        values = {} if limit is None else {key: numbers(limit, key, 1)[0] for key in LIMITS if key in limit.attrib}
    except ValueError as error:
        raise ValueError(f"joint {name!r} needs finite limits, velocity and effort: {error}") from error
    direction = (1.0, 0.0, 0.0) if axis is None else numbers(axis, "xyz")
    if kind in MOVING and math.hypot(*direction) < LEAST_AXIS:
        raise ValueError(f"the axis of joint {name!r} has no direction")
    for dynamics in element.findall("dynamics"):
        if any(numbers(dynamics, key, 1)[0] < 0 for key in ("damping", "friction") if key in dynamics.attrib):
            raise ValueError(f"joint {name!r} has a negative damping or friction")
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=text(child(element, "parent"), "link"),
        child=text(child(element, "child"), "link"),
        origin=_pose_matrix(*origin(element)),
        axis=np.array(direction),
        **{key: values.get(key, 0.0) for key in LIMITS},
    )


def _shapes(link: ElementTree.Element) -> tuple[Shape, ...]:
    """The collision shapes of a link, capsules merged."""
    found = link.findall("collision")
    if len(found) > MOST_SHAPES:
        raise ValueError(f"a link has {len(found)} collision shapes, and may have {MOST_SHAPES}")
    return merge_capsules([_shape(element) for element in found])


def _shape(collision: ElementTree.Element) -> Shape:
    geometry = next(iter(child(collision, "geometry")), None)
    if geometry is None:
        raise ValueError("a <geometry> is empty")
    position, quaternion = origin(collision)
    match geometry.tag:
        case "box":
            x, y, z = lengths(geometry, "collision", THINNEST)
            return Shape("box", position, quaternion, (x / 2, y / 2, z / 2))
        case "sphere":
            return Shape("sphere", position, quaternion, lengths(geometry, "collision", THINNEST))
        case "cylinder":
            radius, length = lengths(geometry, "collision", THINNEST)
            return Shape("cylinder", position, _compose(quaternion, Z_TO_X), (radius, length / 2))
    raise ValueError(f"collision geometry <{geometry.tag}> is not a box, sphere or cylinder")


def _pose_matrix(position: tuple[float, ...], quaternion: tuple[float, ...]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = matrix_from_quaternion(torch.tensor(quaternion, dtype=torch.float64)).numpy()
    pose[:3, 3] = position
    return pose


def _compose(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float, float]:
    w, x, y, z = quaternion_multiply(
        torch.tensor(a, dtype=torch.float64), torch.tensor(b, dtype=torch.float64)
    ).tolist()
    return w, x, y, z
