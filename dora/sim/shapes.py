"""PhysX collision shapes of robot descriptions and objects, made in memory without mesh files."""

from collections.abc import Callable

import numpy as np
import sapien
import trimesh
from sapien import physx

from dora.robot.shapes import Shape

_PRIMITIVES: dict[str, Callable[[list[float], physx.PhysxMaterial], physx.PhysxCollisionShape]] = {
    "box": lambda size, material: physx.PhysxCollisionShapeBox(size, material),
    "sphere": lambda size, material: physx.PhysxCollisionShapeSphere(size[0], material),
    "cylinder": lambda size, material: physx.PhysxCollisionShapeCylinder(size[0], size[1], material),
    "capsule": lambda size, material: physx.PhysxCollisionShapeCapsule(size[0], size[1], material),
}
"""Functions that make each kind of primitive from its `Shape.size` [m] and a material."""


def collision_shape(
    shape: Shape | trimesh.Trimesh, material: physx.PhysxMaterial, scale: float = 1.0
) -> physx.PhysxCollisionShape:
    """One PhysX collision shape.

    Args:
        shape: a primitive, or a mesh whose convex hull is used, in the frame of the body [m].
        material: friction and restitution.
        scale: factor of all lengths [1].

    Raises:
        RuntimeError: PhysX cannot make a convex body of the mesh, for example because it is flat.
    """
    if isinstance(shape, trimesh.Trimesh):
        points = np.asarray(shape.vertices * scale, np.float32)
        return physx.PhysxCollisionShapeConvexMesh(points, [1.0, 1.0, 1.0], material)
    made = _PRIMITIVES[shape.kind]([scale * length for length in shape.size], material)
    made.local_pose = sapien.Pose([scale * x for x in shape.position], shape.quaternion)
    return made
