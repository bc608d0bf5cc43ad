"""Shapes made in memory without mesh files: PhysX collision shapes, and shapes of furniture that are only drawn."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

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


@dataclass(frozen=True)
class DrawnShape:
    """A shape that is only drawn, in the frame of its body.

    Attributes:
        shape: a box, sphere, cylinder or capsule.
        colour: red, green, blue and opacity, 0 to 1.
    """

    shape: Shape
    colour: tuple[float, float, float, float]


def drawn_box(
    position: Iterable[float], half: Iterable[float], colour: tuple[float, float, float, float]
) -> DrawnShape:
    """A box along the axes of its body, with its centre and half sides [m]."""
    x, y, z = position
    return DrawnShape(Shape("box", (x, y, z), (1.0, 0.0, 0.0, 0.0), tuple(half)), colour)


def draw(builder: Any, shapes: Iterable[DrawnShape], **finish: Any) -> None:
    """Adds shapes as visuals to a builder of an actor or link; needs a renderer.

    Args:
        builder: of SAPIEN or ManiSkill.
        shapes: boxes, cylinders, capsules and spheres.
        finish: further properties of the material, such as roughness.
    """
    for drawn in shapes:
        pose = sapien.Pose(drawn.shape.position, drawn.shape.quaternion)
        material = sapien.render.RenderMaterial(base_color=list(drawn.colour), **finish)
        size = [list(drawn.shape.size)] if drawn.shape.kind == "box" else drawn.shape.size
        getattr(builder, f"add_{drawn.shape.kind}_visual")(pose, *size, material)
