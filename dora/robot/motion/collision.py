"""Collision tests of the robot with itself, a table and an object, by Pinocchio and Coal.

The geometry is that of the `RobotDescription`, so capsules stay capsules (Pinocchio's URDF parser refuses them).
Collisions between fingers are not tested: they depend on the candidate alone, not on the posture of the arm.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from dora.errors import InputError
from dora.robot import RobotDescription, Shape

Z_TO_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Rotation of z, the axis of Coal's capsules and cylinders, into x, the axis of a `Shape`."""
TABLE = "table"
"""Name of the table as a part, and of the pairs with it."""
OBJECT = "object"
"""Name of the object as a part."""
KINDS = ("arm", TABLE, "arm object", "hand object")
"""Kinds of pairs of parts that can be tested."""


class _Part(NamedTuple):
    """One shape: its owner (a link, "table" or "object"), Pinocchio's joint, pose in its frame, Coal's geometry."""

    owner: str
    joint: int
    local: Any
    body: Any


def need(module: str, package: str) -> ModuleType:
    """Import a module of an optional package.

    Raises:
        InputError: naming the package to install.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"motion planning needs the package {package!r}: in a checkout of Dora, pip install -e '.[plan]'."
        ) from error


class CollisionModel:
    """Collision model of robot, table and object, which says what touches at a posture.

    Args:
        robot: the robot, with its shapes and ignored pairs.
        pieces: convex shapes of the object in its frame [m]; empty for no object.
        table: (4,) plane in the robot's base frame: unit normal and height along it [m]; the half space below is
            solid. Links that the arm's joints do not move are not tested against it.
        clearance: kinds of pairs that are tested, and for each the distance [m] up to which a pair counts as touching;
            a negative value is an allowed penetration depth. The kinds are "arm" (a link of the arm with one of the
            arm or hand), "table" (arm or hand), "arm object" and "hand object". By default all, with 0.

    Raises:
        InputError: Pinocchio or Coal is not installed, or `clearance` has an unknown kind.
    """

    def __init__(
        self,
        robot: RobotDescription,
        pieces: Sequence[Shape | trimesh.Trimesh] = (),
        table: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 0.0),
        clearance: dict[str, float] | None = None,
    ):
        self._pin, self._coal = need("pinocchio", "pin"), need("coal", "coal")
        self.robot = robot
        pin = self._pin
        self._model = pin.buildModelFromUrdf(str(robot.urdf))
        self._data = self._model.createData()
        names = (*robot.arm.names, *robot.hand.names)
        self._order = np.array([self._model.joints[self._model.getJointId(name)].idx_q for name in names])
        self._q = np.zeros(self._model.nq)
        clearance = dict.fromkeys(KINDS, 0.0) if clearance is None else clearance
        if unknown := set(clearance) - set(KINDS):
            raise InputError(f"there are no pairs of the kind {min(unknown)!r}; choose from {', '.join(KINDS)}")
        # The broad phase has no margin for an unbounded shape: the plane itself is raised.
        plane = self._coal.Halfspace(np.array(table[:3]), table[3] + clearance.get(TABLE, 0.0))
        parts = [*self._robot_parts(), _Part(TABLE, 0, pin.SE3.Identity(), plane)]
        parts += [_Part(OBJECT, 0, local, body) for body, local in map(self._solid, pieces)]
        pairs = _tested(robot, [part.owner for part in parts], clearance)
        # Nor may it contain a shape without a pair, whose bounding box would be undefined.
        used = sorted({index for i, j, _ in pairs for index in (i, j)})
        self._geometry, place = pin.GeometryModel(), {}
        self._pieces: list[tuple[Any, Any]] = []
        for index in used:
            owner, joint, local, body = parts[index]
            place[index] = self._geometry.addGeometryObject(pin.GeometryObject(f"{owner} {index}", joint, local, body))
            if owner == OBJECT:
                self._pieces.append((self._geometry.geometryObjects[place[index]], local))
        for i, j, _ in pairs:
            self._geometry.addCollisionPair(pin.CollisionPair(place[i], place[j]))
        self._pairs = [(parts[i].owner, parts[j].owner) for i, j, _ in pairs]
        self._results = self._geometry.createData()
        for request, (*_, kind) in zip(self._results.collisionRequests, pairs, strict=True):
            request.security_margin = 0.0 if kind == TABLE else clearance[kind]
        self._broad = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(self._model, self._geometry, self._results)

    def place_object(self, position: Float[np.ndarray, " 3"], quaternion: Float[np.ndarray, " 4"]) -> None:
        """Move the object to a pose ([m], wxyz) in the robot's base frame."""
        pose = self._pose(position, quaternion)
        for part, local in self._pieces:
            part.placement = pose * local

    def touching(self, arm: Float[np.ndarray, " dof"], hand: Float[np.ndarray, " h"]) -> tuple[str, str] | None:
        """A pair of parts (a link, then a link, "table" or "object") that touch at joint angles [rad], or None."""
        if not self._collide(arm, hand):
            return None
        for index, pair in enumerate(self._pairs):
            if self._pin.computeCollision(self._geometry, self._results, index):
                return pair
        return None

    def free(self, arms: Float[np.ndarray, "k dof"], hand: Float[np.ndarray, " h"]) -> bool:
        """Whether nothing touches at any of k postures of the arm with one posture of the hand [rad]."""
        return not any(self._collide(arm, hand) for arm in arms)

    def _collide(self, arm: np.ndarray, hand: np.ndarray) -> bool:
        self._q[self._order[: len(arm)]] = arm
        self._q[self._order[len(arm) :]] = hand
        return self._pin.computeCollisions(self._model, self._data, self._broad, self._q, True)

    def _robot_parts(self) -> Iterator[_Part]:
        for link, shapes in self.robot.shapes.items():
            frame = self._model.frames[self._model.getFrameId(link, self._pin.FrameType.BODY)]
            for shape in shapes:
                body, local = self._solid(shape)
                yield _Part(link, frame.parentJoint, frame.placement * local, body)

    def _pose(self, position: Any, quaternion: Any) -> Any:
        w, x, y, z = (float(v) for v in quaternion)
        return self._pin.SE3(self._pin.Quaternion(w, x, y, z).normalized().matrix(), np.asarray(position, dtype=float))

    def _solid(self, shape: Shape | trimesh.Trimesh) -> tuple[Any, Any]:
        """Coal's geometry of a shape, and its pose in the frame in which the shape is given."""
        coal = self._coal
        if isinstance(shape, trimesh.Trimesh):
            points = coal.StdVec_Vec3s()
            points.extend(np.asarray(shape.vertices, dtype=float))
            return coal.Convex.convexHull(points, True, "Qt"), self._pin.SE3.Identity()
        pose = self._pose(shape.position, shape.quaternion)
        if shape.kind == "box":
            return coal.Box(*(2 * half for half in shape.size)), pose
        if shape.kind == "sphere":
            return coal.Sphere(shape.size[0]), pose
        make = coal.Capsule if shape.kind == "capsule" else coal.Cylinder
        return make(shape.size[0], 2 * shape.size[1]), pose * self._pin.SE3(Z_TO_X, np.zeros(3))


def _tested(robot: RobotDescription, owners: Sequence[str], clearance: dict[str, float]) -> list[tuple[int, int, str]]:
    """Pairs of indices into `owners` that are tested, and the kind of each."""
    moving = {link for link in robot.shapes if any(joint.moves for joint in robot.model.chain(link))}
    hand, found = hand_links(robot), []
    for (i, a), (j, b) in itertools.combinations(enumerate(owners), 2):
        if b in (TABLE, OBJECT):
            kind = TABLE if b == TABLE else "hand object" if a in hand else "arm object"
            apart = a in moving
        else:
            kind = "hand" if {a, b} <= hand else "arm"
            apart = a != b and tuple(sorted((a, b))) not in robot.ignored_pairs
        if apart and kind in clearance:
            found.append((i, j, kind))
    return found


def hand_links(robot: RobotDescription) -> frozenset[str]:
    """Names of the wrist link and all links that it carries, of those with collision shapes."""
    wrist = robot.wrist_link
    return frozenset(
        link
        for link in robot.shapes
        if link == wrist or any(joint.parent == wrist for joint in robot.model.chain(link))
    )
