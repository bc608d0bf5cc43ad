"""Overlap from shapes and poses alone, by Coal: what contacts of PhysX are compared with."""

from collections.abc import Iterable
from importlib import import_module
from typing import Any

import numpy as np
from sapien import physx

from dora.sim.substeps import watch_contacts, watch_physics

coal: Any = import_module("coal")
Z_TO_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Turns z, the axis of Coal's capsules and cylinders, into x, that of PhysX's."""
ROUND = {physx.PhysxCollisionShapeCapsule: coal.Capsule, physx.PhysxCollisionShapeCylinder: coal.Cylinder}
"""Shapes of PhysX with a radius and a length, as those of Coal."""


def solid(shape: Any) -> tuple[Any, np.ndarray]:
    """Coal's geometry of a shape of PhysX, and the half extents of a box around it in Coal's frame [m]."""
    if type(shape) in ROUND:
        radius, half = float(shape.radius), float(shape.half_length)
        return ROUND[type(shape)](radius, 2 * half), np.array([radius, radius, radius + half])
    if isinstance(shape, physx.PhysxCollisionShapeConvexMesh):
        corners, points = np.asarray(shape.vertices, float) * np.asarray(shape.scale, float), coal.StdVec_Vec3s()
        points.extend(list(corners))
        return coal.Convex.convexHull(points, True, "Qt"), np.abs(corners).max(0)
    half_size = np.asarray(shape.half_size, float)
    return coal.Box(*(2 * half_size)), half_size


class Solids:
    """The collision shapes of some bodies of one environment.

    Args:
        members: actors and links of ManiSkill.
        row: index of the environment.
    """

    def __init__(self, members: Iterable[Any], row: int):
        self._bodies = [member._bodies[row] for member in members]
        shapes = [(k, shape) for k, body in enumerate(self._bodies) for shape in body.collision_shapes]
        made = [solid(shape) for _, shape in shapes]
        self._body, self.geometries = [k for k, _ in shapes], [geometry for geometry, _ in made]
        self._local = np.stack([shape.local_pose.to_transformation_matrix().astype(float) for _, shape in shapes])
        for turn, (_, shape) in zip(self._local, shapes, strict=True):
            if type(shape) in ROUND:
                turn[:3, :3] = turn[:3, :3] @ Z_TO_X
        self.half = np.stack([half for _, half in made])
        self.radius = np.linalg.norm(self.half, axis=1)

    def poses(self) -> np.ndarray:
        """World poses of the shapes now (shapes, 4, 4) [m]."""
        bodies = np.stack([body.entity.pose.to_transformation_matrix() for body in self._bodies]).astype(float)
        return bodies[self._body] @ self._local


def near(one: Solids, other: Solids, mine: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Whether the boxes of shapes of one group meet the balls around shapes of the other (shapes, shapes)."""
    between = theirs[None, :, :3, 3] - mine[:, None, :3, 3]
    local = np.abs(np.einsum("iba,ijb->ija", mine[:, :3, :3], between))
    return np.linalg.norm(np.maximum(local - one.half[:, None], 0), axis=-1) < other.radius


def depth(one: Solids, other: Solids, mine: np.ndarray, theirs: np.ndarray) -> float:
    """Largest overlap of a shape of one group with a shape of the other [m], for their `poses`; 0 without any."""
    max_penetration = 0.0
    for i, j in np.argwhere(near(one, other, mine, theirs) & near(other, one, theirs, mine).T):
        found = coal.distance(
            one.geometries[i], coal.Transform3s(mine[i, :3, :3], mine[i, :3, 3]),
            other.geometries[j], coal.Transform3s(theirs[j, :3, :3], theirs[j, :3, 3]),
            coal.DistanceRequest(), coal.DistanceResult(),
        )  # fmt: skip
        max_penetration = max(max_penetration, -found)
    return max_penetration


class PairWatch:
    """Overlap and force of pairs of groups of bodies, in every physics step from now on.

    Args:
        scene: the ManiSkill scene.
        groups: actors and links by the name of their group.
        pairs: names of two groups.
        geometry: compute the overlap from the shapes, too.

    Attributes:
        reported: largest overlap that PhysX reports (environments, pairs) [m].
        true: the same from the shapes.
        force: largest force of a physics step on the second groups by the first ones, all pairs together
            (environments,) [N].
        impulse: sum of those forces over time (environments, 3) [N s].
    """

    def __init__(self, scene: Any, groups: dict[str, list[Any]], pairs: list[tuple[str, str]], geometry: bool = True):
        n, self._pairs, self._frequency = scene.num_envs, pairs, 1 / scene.timestep
        self._group = {id(body): name for name, group in groups.items() for member in group for body in member._bodies}
        self._kept_alive = groups  # ids stay unique
        self._column = {pair: k for k, pair in enumerate(pairs)}
        self.reported, self.true = np.zeros((2, n, len(pairs)))
        self.force, self.impulse = np.zeros(n), np.zeros((n, 3))
        if geometry:
            self._solids = [{name: Solids(group, row) for name, group in groups.items()} for row in range(n)]
            watch_physics(scene, self._look)
        watch_contacts(scene, self._read)

    def clear(self) -> None:
        """Forgets what was seen so far."""
        for values in (self.reported, self.true, self.force, self.impulse):
            values[:] = 0.0

    def _look(self, row: int) -> None:
        solids = self._solids[row]
        poses = {name: group.poses() for name, group in solids.items()}
        for k, (one, other) in enumerate(self._pairs):
            found = depth(solids[one], solids[other], poses[one], poses[other])
            self.true[row, k] = max(self.true[row, k], found)

    def _read(self, row: int, contacts: list) -> None:
        total = np.zeros(3)
        for contact in contacts:
            one, other = (self._group.get(id(body), "") for body in contact.bodies)
            column, sign = self._column.get((one, other)), 1.0
            if column is None:
                column, sign = self._column.get((other, one)), -1.0
            if column is None:
                continue
            for point in contact.points:
                self.reported[row, column] = max(self.reported[row, column], -point.separation)
                total += sign * np.asarray(point.impulse)
        self.force[row] = max(self.force[row], np.linalg.norm(total) * self._frequency)
        self.impulse[row] += total
