"""Objects on a hinge, such as the handle of a microwave's door: one articulation per environment.

A door resists in two ways that PhysX's joints do not offer here: a constant friction torque against its motion, and a
latch that pulls it shut near its closed position. Both are torques of our own, set after every physics step:

    tau = -friction * tanh(w / FRICTION_SPEED) - latch * (angle < latch_angle)

with the angular velocity w; damping is the joint's own.
"""

from collections.abc import Mapping
from math import tanh
from typing import Any

import numpy as np
import sapien
import torch
from jaxtyping import Float, Int
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Articulation, Link, Pose
from sapien.physx import PhysxMaterial
from torch import Tensor

from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.articulation import Mount, MountLink
from dora.robot.shapes import Shape
from dora.sim.bodies import merged
from dora.sim.shapes import DrawnShape, draw
from dora.sim.substeps import watch_physics

FRICTION_SPEED = 0.05
"""Angular velocity above which friction is nearly whole [rad/s]."""
LARGEST = 1e9
"""No resistance of a state is larger, in SI units."""
DRIVE_LIMIT = 1e4
"""Largest torque of the viscous drive [N m]: none."""
STEEL = (0.75, 0.76, 0.78, 1.0)
"""Colour of the object: red, green, blue and opacity [1]."""
ALONG_X = np.array([1.0, 0.0, 0.0])
"""The axis of SAPIEN's joints, in the frames of a joint."""


class HingedObject:
    """An object on its mount, in every environment.

    Args:
        scene: the scene of all environments, on a CPU.
        obj: the object.
        mount: what it is mounted on.

    Attributes:
        articulation: the mount; its joints are its hinge alone.
        links: by name.
        resistance: of the hinge by name, one number per environment: `damping` [N m s/rad], `friction` [N m] and
            `latch` [N m].
    """

    def __init__(self, scene: ManiSkillScene, obj: AffordanceObject, mount: Mount):
        self.mount, self._device = mount, torch.device(scene.device)
        self._latch_angle = mount.hinge.latch_angle
        self.articulation: Articulation = _build(scene, obj, mount)
        self.links: dict[str, Link] = {link.name: self.articulation.links_map[link.name] for link in mount.links}
        self._bodies = list(self.articulation._objs)
        self._joints = list(self.articulation.active_joints[0]._objs)
        self.resistance = {name: np.zeros(scene.num_envs, np.float32) for name in ("damping", "friction", "latch")}
        watch_physics(scene, self._resist)

    @property
    def link(self) -> Link:
        """The body of the object."""
        return self.links[self.mount.object_link.name]

    @property
    def angle(self) -> Float[Tensor, " n"]:
        """Angle of each hinge [rad]."""
        return self.articulation.get_qpos()[:, 0]

    @property
    def speed(self) -> Float[Tensor, " n"]:
        """Angular velocity of each hinge [rad/s]."""
        return self.articulation.get_qvel()[:, 0]

    def begin(
        self,
        rows: Int[Tensor, " b"],
        position: Float[Tensor, "b 3"],
        quaternion: Float[Tensor, "b 4"],
        damping: Float[Tensor, " b"],
        friction: Float[Tensor, " b"],
        latch: Float[Tensor, " b"],
    ) -> None:
        """Shuts the environments `rows`, with their mounts at these poses [m], wxyz, and this resistance."""
        zero = torch.zeros(len(rows), 1, device=self._device)
        whole: Any = Pose.create_from_pq(position, quaternion)
        self.articulation.set_pose(whole)
        self.articulation.set_qpos(zero)
        self.articulation.set_qvel(zero)
        self.set_state({"damping": damping, "friction": friction, "latch": latch}, rows)

    def _resist(self, i: int) -> None:
        """Sets the torque of friction and latch in environment i for its next physics step."""
        body = self._bodies[i]
        torque = -float(self.resistance["friction"][i]) * tanh(float(body.qvel[0]) / FRICTION_SPEED)
        if float(body.qpos[0]) < self._latch_angle:
            torque -= float(self.resistance["latch"][i])
        body.set_qf(np.array([torque], np.float32))

    def get_state(self) -> dict[str, Tensor]:
        """What the simulator does not keep, each (n,)."""
        return {name: torch.tensor(values, device=self._device) for name, values in self.resistance.items()}

    def state_ranges(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest value of what `get_state` returns."""
        return dict.fromkeys(self.resistance, (0.0, LARGEST))

    def set_state(self, state: dict[str, Tensor], rows: Tensor) -> None:
        """Inverse of `get_state` for the environments `rows` (b,), whose simulator has been restored."""
        for name, values in self.resistance.items():
            values[rows.cpu().numpy()] = state[name].reshape(-1).cpu().numpy()
        for i in rows.tolist():
            self._joints[i].set_drive_properties(0.0, float(self.resistance["damping"][i]), DRIVE_LIMIT)
            self._resist(i)


def drawn_mount(obj: AffordanceObject, mount: Mount) -> Mapping[str, tuple[DrawnShape, ...]]:
    """What each link looks like, in its own frame."""
    shapes = {
        link.name: tuple(DrawnShape(s.primitive, s.colour) for s in link.shapes if s.colour is not None)
        for link in mount.links
    }
    return shapes | {mount.object_link.name: tuple(DrawnShape(shape, STEEL) for shape in _object_shapes(obj))}


def _object_shapes(obj: AffordanceObject) -> list[Shape]:
    """Collision shapes of the object's target region: the other regions are pieces of its mount."""
    return [p.shape for p in obj.pieces if p.label == obj.target and isinstance(p.shape, Shape)]


def _build(scene: ManiSkillScene, obj: AffordanceObject, mount: Mount) -> Articulation:
    """The articulation; every shape has a material of its own, so that friction can be changed for one environment."""
    parts = []
    for i in range(scene.num_envs):
        builder = scene.create_articulation_builder()
        made: dict[str, Any] = {"": None}
        for link in mount.links:
            made[link.name] = one = builder.create_link_builder(made[link.parent])
            one.set_name(link.name)
            _join(one, link)
            shapes = _object_shapes(obj) if link.object else [s.primitive for s in link.shapes]
            density = link.mass / sum(shape.volume for shape in shapes)
            for shape in shapes:
                _collide(one, shape, link.friction, density)
            if scene.can_render():
                draw(one, drawn_mount(obj, mount)[link.name], roughness=0.5)
        builder.initial_pose = sapien.Pose([0.0, 0.0, 1.0])
        builder.set_scene_idxs([i])
        parts.append(builder.build(f"{obj.name}-{i}", fix_root_link=True))
    whole = merged(scene, parts, Articulation, obj.name)
    for link in whole.links:
        link.disable_gravity = True
    return whole


def _join(builder: Any, link: MountLink) -> None:
    """Attaches a link to its parent where its frame is."""
    if not link.parent:
        return
    builder.set_joint_name(link.name)
    place = sapien.Pose(link.position, link.quaternion)
    if link.hinge is None:
        builder.set_joint_properties("fixed", np.empty((0, 2)), place, sapien.Pose())
        return
    turn = sapien.Pose(q=_turning_x_to(np.asarray(link.hinge.axis)))
    builder.set_joint_properties("revolute", [list(link.hinge.limits)], place * turn, turn)


def _turning_x_to(axis: Float[np.ndarray, " 3"]) -> list[float]:
    """A quaternion wxyz that turns +x to a unit vector."""
    half = ALONG_X + axis
    if np.linalg.norm(half) < 1e-6:  # opposite: half a turn about z
        return [0.0, 0.0, 0.0, 1.0]
    half = half / np.linalg.norm(half)
    return [float(ALONG_X @ half), *np.cross(ALONG_X, half).tolist()]


def _collide(builder: Any, shape: Shape, friction: float, density: float) -> None:
    material = PhysxMaterial(friction, friction, 0.0)
    size = [list(shape.size)] if shape.kind == "box" else shape.size
    pose = sapien.Pose(shape.position, shape.quaternion)
    getattr(builder, f"add_{shape.kind}_collision")(pose, *size, material, density=density)
