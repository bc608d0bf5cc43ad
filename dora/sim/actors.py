"""Objects as bodies of a simulation: convex pieces as collision shapes, the labelled mesh as visual."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
import trimesh
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.structs import Actor, Pose
from sapien import physx

from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.palette import PALETTE, colours
from dora.errors import InputError
from dora.sim.bodies import merged
from dora.sim.shapes import collision_shape

CONTACT_OFFSET = 0.005
"""PhysX's contact offset of objects, the distance below which contacts are generated [m]."""
ROUGHNESS = 0.5
"""Roughness of an object's surface in pictures, 0 to 1 [1]."""


def object_entity(
    obj: AffordanceObject,
    scale: float = 1.0,
    friction: float | None = None,
    mass: float | None = None,
    contact_offset: float = CONTACT_OFFSET,
    visible: bool = False,
) -> sapien.Entity:
    """A dynamic body that is in no scene yet. Its frame is the object frame.

    Mass, centre of mass and inertia are those of the object, independent of its pieces. Every piece has a material
    of its own, so that friction can be changed for this body alone; shape i of the body is piece i.

    Args:
        obj: the object.
        scale: factor of all lengths, which does not change the mass [1].
        friction: Coulomb coefficient, static and dynamic [1]; the object's own if None.
        mass: mass [kg]; the object's own if None.
        contact_offset: PhysX's contact offset, the distance below which contacts are generated [m].
        visible: whether the mesh is drawn, one shape per region; needs a renderer.

    Raises:
        InputError: a number is not positive, or a piece is no convex body.
    """
    kilograms = obj.mass if mass is None else mass
    coefficient = obj.friction if friction is None else friction
    for name, value in (("scale", scale), ("mass", kilograms), ("friction", coefficient)):
        if not value > 0:
            raise InputError(f"{obj.name}: {name} is {value}; it must be positive.")
    entity = sapien.Entity()
    entity.name = obj.name
    body: Any = physx.PhysxRigidDynamicComponent()
    for index, piece in enumerate(obj.pieces):
        try:
            shape = collision_shape(piece.shape, physx.PhysxMaterial(coefficient, coefficient, 0.0), scale)
        except RuntimeError as error:
            raise InputError(f"{obj.name}: piece {index} ({piece.label}) is no convex body; decompose it.") from error
        shape.set_contact_offset(contact_offset)
        body.attach(shape)
    moments, axes = np.linalg.eigh(obj.inertia * (kilograms / obj.mass * scale**2))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    turn = np.eye(4)
    turn[:3, :3] = axes
    body.mass = kilograms
    body.cmass_local_pose = sapien.Pose(turn)
    body.inertia = moments
    entity.add_component(body)
    if visible:
        entity.add_component(_visual(obj, scale))
    return entity


def _visual(obj: AffordanceObject, scale: float) -> sapien.render.RenderBodyComponent:
    """The mesh as visual, one shape per region."""
    component = sapien.render.RenderBodyComponent()
    for index, label in enumerate(obj.labels):
        part: trimesh.Trimesh = obj.region(label)
        corners = np.asarray(part.triangles.reshape(-1, 3) * scale, np.float32)
        shape = sapien.render.RenderShapeTriangleMesh(
            vertices=corners,
            triangles=np.arange(len(corners), dtype=np.uint32).reshape(-1, 3),
            normals=np.repeat(part.face_normals, 3, axis=0).astype(np.float32),
            uvs=np.zeros((len(corners), 2), np.float32),
            material=sapien.render.RenderMaterial(
                base_color=(colours(np.array([index]), PALETTE)[0] / 255).tolist(), roughness=ROUGHNESS
            ),
        )
        shape.name = label
        component.attach(shape)
    return component


class ObjectBuilder(ActorBuilder):
    """ManiSkill's actor builder for an object.

    Args:
        scene: the ManiSkill scene; the object is visible if the scene can render.
        obj: the object.
        settings: further arguments of `object_entity`.
    """

    def __init__(self, scene: ManiSkillScene, obj: AffordanceObject, **settings: float | None):
        super().__init__()
        self.scene: Any = scene
        self._object, self._settings = obj, settings

    def build_entity(self) -> sapien.Entity:
        """The body for one environment, see `object_entity`."""
        return object_entity(self._object, visible=self.scene.can_render(), **self._settings)  # pyright: ignore


def build_object(
    scene: ManiSkillScene,
    obj: AffordanceObject,
    name: str | None = None,
    pose: sapien.Pose | None = None,
    scale: float | Sequence[float] | np.ndarray = 1.0,
    friction: float | None = None,
    mass: float | None = None,
    contact_offset: float = CONTACT_OFFSET,
) -> Actor:
    """The object in every environment of a ManiSkill scene.

    Args:
        scene: the ManiSkill scene.
        obj: the object.
        name: name of the actor; the object's if None.
        pose: initial pose in the world; at rest at the origin on a table of height 0 if None.
        scale: factor of all lengths, one for all environments or one per environment [1].
        friction: Coulomb coefficient, static and dynamic [1]; the object's own if None.
        mass: mass [kg]; the object's own if None.
        contact_offset: as in `object_entity`.

    Returns:
        One actor; with a scale per environment it is merged from one actor per environment.

    Raises:
        InputError: as in `object_entity`, or the number of scales is not the number of environments.
    """
    name = obj.name if name is None else name
    factors = np.broadcast_to(np.asarray(scale, float), (scene.num_envs,) if np.ndim(scale) == 0 else np.shape(scale))
    if factors.shape != (scene.num_envs,):
        raise InputError(f"{name}: {factors.size} scales for {scene.num_envs} environments; give one for each.")
    parts = []
    shared = np.ndim(scale) == 0
    for i, factor in enumerate(factors[:1].tolist() if shared else factors.tolist()):
        builder = ObjectBuilder(scene, obj, scale=factor, friction=friction, mass=mass, contact_offset=contact_offset)
        builder.initial_pose = Pose.create(pose or sapien.Pose([0.0, 0.0, factor * obj.support], obj.rest))
        if shared:
            return builder.build(name)
        builder.set_scene_idxs([i])
        parts.append(builder.build(f"{name}-{i}"))
    return merged(scene, parts, Actor, name)


def build_box(
    scene: ManiSkillScene,
    obj: AffordanceObject,
    scale: Sequence[float] | np.ndarray,
    colour: tuple[float, float, float, float],
    pose: sapien.Pose,
) -> Actor:
    """An object as the box around its mesh, of uniform density, whose mass and inertia PhysX computes.

    Args:
        scene: the ManiSkill scene.
        obj: the object.
        scale: factor of all lengths, one per environment, which does not change the mass [1].
        colour: red, green, blue and opacity, 0 to 1.
        pose: initial pose in the world.
    """
    parts = []
    for i, factor in enumerate(np.asarray(scale).tolist()):
        half = (obj.mesh.extents / 2 * factor).tolist()
        builder = scene.create_actor_builder()
        # A material of its own: without one, every shape of every environment shares SAPIEN's default.
        material = physx.PhysxMaterial(obj.friction, obj.friction, 0.0)
        builder.add_box_collision(half_size=half, material=material, density=obj.mass / (8 * math.prod(half)))
        if scene.can_render():
            paint = sapien.render.RenderMaterial(base_color=list(colour), roughness=ROUGHNESS)
            builder.add_box_visual(half_size=half, material=paint)
        builder.set_scene_idxs([i])
        builder.initial_pose = Pose.create(pose)
        parts.append(builder.build(f"{obj.name}-{i}"))
    return merged(scene, parts, Actor, obj.name)
