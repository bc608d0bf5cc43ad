"""A nail in a post: a prismatic joint that gives way to blows and to nothing else.

A nail's friction resists both ways. PhysX has no such joint friction here, and drives that are limited in force absorb
a blow like a mass. What works is a viscous drive, a constant force upwards, and a lower limit that follows the nail
down, so that it never comes back up: while the nail moves,

    m a = F_hammer - resistance - drag * v,    v >= 0.

The hammer's blow starts the nail at nearly the hammer's speed and is then spent against drag and resistance. Pushing
moves it too, and a nail pushed in has not been hammered: a blow is an impact above `blow_speed` of the striking face on
the nail's head. What the nail sinks within `blow_window` after one counts as driven while nothing but that face presses
on the nail, and at most as far as the momentum of hammer and hand by itself would drive it (`driven_by_momentum`): more
cannot be had by pushing on, and what a blow has left over is not there for the next one. A hammer that no hand holds
strikes no blow.
"""

from dataclasses import dataclass
from math import inf, log1p

import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float, Int
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation, Link
from sapien.physx import PhysxMaterial
from torch import Tensor

from dora.robot.shapes import Shape
from dora.sim.shapes import DrawnShape, draw, drawn_box
from dora.sim.substeps import watch_contacts

HEAD_RADIUS, HEAD_HALF = 0.008, 0.002
"""Radius and half thickness of the nail's head as it is drawn [m]."""
STOP_HALF = 0.010
"""Half thickness of the head for collisions [m]; a blow goes several millimetres into a thin one, and through."""
SHANK_RADIUS = 0.003
"""Radius of the nail, which is only drawn [m]."""
POST_HALF = 0.025
"""Half width of the post [m]."""
FRICTION = 0.5
"""Friction of post and nail [1]."""
DRIVE_LIMIT = 1e4
"""Largest force of the viscous drive [N]: none."""
MOVED = 1e-6
"""Sinking in one physics step that is motion and not rounding [m]."""
WATCHED = 0.3
"""Distance of the hammer's centre from the nail within which its speed is watched [m]."""
FACE_DEPTH, FACE_EDGE = 0.006, 0.003
"""How far from the plane and beyond the edge of the striking face a contact point may lie that is on it [m]; the
point of a contact lies between the two surfaces, which a blow presses into each other."""
UPRIGHT = 0.7
"""Smallest vertical share of a contact's normal that presses the nail down, not aside [1]."""
SQUARE = 0.7
"""Smallest share along the striking axis of the normal of a contact on the face; the head's side lies across it [1]."""
STATE = ("_depth", "_driven", "_since", "_speed", "_before", "_sinking", "_reach", "_left", "_held")
"""Buffers of a nail that its state holds."""
DOWN = (0.7071068, 0.0, 0.7071068, 0.0)
"""Turns +x, the axis of joints and cylinders, into -z (wxyz): the joint's coordinate is the nail's depth."""
PINE, IRON = (0.78, 0.60, 0.38, 1.0), (0.45, 0.46, 0.48, 1.0)
"""Colours of the post and the nail: red, green, blue and opacity [1]."""


@dataclass(frozen=True, kw_only=True)
class NailSettings:
    """Numbers of a nail."""

    top: tuple[float, float, float] = (0.65, -0.14, 0.30)
    """Top of the undriven nail, world frame [m]."""
    travel: float = 0.05
    """How far the nail can sink [m]."""
    driven: float = 0.010
    """How far blows must drive it [m]."""
    stand: float = 0.08
    """Height of the nail's head above the post before the first blow [m]."""
    mass: float = 0.05
    """Mass of the nail [kg]."""
    resistance: float = 20.0
    """Constant force against the hammer [N]."""
    drag: float = 40.0
    """Force per speed against the hammer [N s/m]."""
    blow_speed: float = 0.5
    """Speed of the striking face relative to the nail above which an impact is a blow [m/s]."""
    blow_window: float = 0.05
    """Time after a blow in which the nail's motion counts as driven, if nothing else touches the nail [s]."""
    hand: float = 0.75
    """Mass of the hand that the nail feels: 1.5 kg, which turn 25 cm from the axis of the swing where the nail is 36 cm
    from it, so that their inertia counts (25 / 36)^2 of it there [kg]."""


def driven_by_momentum(settings: NailSettings, speed: float, mass: float) -> float:
    """Depth to which a nail sinks that goes on with what struck it, and nothing pushes either [m].

    The integral of v until m' dv/dt = -resistance - drag v has stopped it, with m' the mass of both:

        m' / drag (v - resistance / drag log(1 + drag v / resistance)).

    Args:
        settings: numbers of the nail; without drag m' v^2 / (2 resistance), without resistance m' v / drag.
        speed: of both, v [m/s].
        mass: of what struck it [kg].
    """
    mass, force, drag = mass + settings.mass, settings.resistance, settings.drag
    if drag == 0:
        return mass * speed**2 / (2 * force) if force > 0 else inf
    spent = force / drag * log1p(drag * speed / force) if force > 0 else 0.0
    return mass / drag * (speed - spent)


def struck(settings: NailSettings, speed: float, sinking: float, mass: float) -> float:
    """Speed of a nail right after an impact that is not elastic: of the momentum of both [m/s].

    Args:
        settings: numbers of the nail.
        speed: of what strikes, relative to the nail [m/s].
        sinking: of the nail, before [m/s].
        mass: of what strikes [kg].
    """
    return sinking + speed * mass / (mass + settings.mass)


class Nail:
    """One upright nail per environment, in a post that stands on the table.

    Args:
        scene: the scene of all environments, on a CPU.
        settings: numbers of the nail.
        dt: duration of a physics step [s].
    """

    def __init__(self, scene: ManiSkillScene, settings: NailSettings, dt: float):
        self.settings, self._dt, self._device = settings, dt, scene.device
        self._place = np.array(settings.top, np.float32)
        self.articulation = _build(scene, settings)
        joint = self.articulation.active_joints[0]
        joint.set_drive_properties(0.0, settings.drag, force_limit=DRIVE_LIMIT)
        self._joints, self._bodies = joint._objs, self.articulation._objs
        n = scene.num_envs
        self._depth = np.zeros(n, np.float32)
        self._driven = np.zeros(n, np.float32)
        self._since = np.full(n, settings.blow_window, np.float32)
        self._speed = np.zeros(n, np.float32)
        self._before = np.zeros(n, np.float32)
        self._sinking = np.zeros(n, np.float32)
        self._reach = np.zeros(n, np.float32)
        self._left = np.zeros(n, np.float32)
        self._held = np.zeros(n, np.float32)
        self._hammers: list[sapien.physx.PhysxRigidDynamicComponent] = []
        self._faces: Float[np.ndarray, "n 3"] = np.zeros((n, 3))
        self._radii: Float[np.ndarray, " n"] = np.zeros(n)
        self._poses: list[Float[np.ndarray, "4 4"] | None] = [None] * n
        self._nails = {id(body): i for i, body in enumerate(self.links[1]._bodies)}
        self._scene = scene

    @property
    def links(self) -> list[Link]:
        """The post and the nail."""
        return self.articulation.links

    def strike_with(self, hammer: Actor, faces: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, " n"]) -> None:
        """Watches the blows of hammers whose striking faces, discs across their x axes, have their centres at `faces`
        and these radii [m], object frame."""
        self._hammers, self._faces, self._radii = list(hammer._bodies), faces, radii
        watch_contacts(self._scene, self._watch)

    def begin(self, rows: Int[Tensor, " b"], pulled: bool = True) -> None:
        """Forgets all blows in the environments `rows`, and pulls their nails out or, without `pulled`, leaves them."""
        index = rows.cpu().numpy()
        if pulled:
            self.articulation.set_qpos(torch.zeros(len(rows), 1, device=self._device))
            self.articulation.set_qvel(torch.zeros(len(rows), 1, device=self._device))
        for name in STATE:
            getattr(self, name)[index] = 0.0
        for i in [] if pulled else index.tolist():
            self._depth[i] = max(float(self._bodies[i].qpos[0]), 0.0)
        self._since[index] = self.settings.blow_window
        self._hold(index.tolist())
        self._look(index.tolist())

    def _look(self, rows: list[int]) -> None:
        """Takes note where the hammers are, which have been put elsewhere."""
        for i in rows if self._hammers else []:
            self._poses[i] = self._hammers[i].entity_pose.to_transformation_matrix()

    def _hold(self, rows: list[int]) -> None:
        """Lets nails rise no higher than they are, and presses them up."""
        for i in rows:
            self._limit(i)
            self._bodies[i].set_qf(np.array([-self.settings.resistance], np.float32))

    def _limit(self, i: int) -> None:
        """Lets the nail of environment i move from where it is to the end of its travel."""
        travel = self.settings.travel
        self._joints[i].set_limits(np.array([[min(self._depth[i], travel - MOVED), travel]], np.float32))

    def _watch(self, i: int, contacts: list) -> None:
        """After a physics step of environment i: the ratchet, and what the step's motion counts."""
        body, before = self._bodies[i], self._depth[i]
        depth = float(body.qpos[0])
        self._since[i] += self._dt
        blow = False
        if depth > before + MOVED:
            face, other = self._pressed(i, contacts)
            speed = float(max(self._speed[i], self._before[i]))  # PhysX slows a face down in the step before it touches
            blow = face and bool(self._held[i]) and speed > self.settings.blow_speed
            if blow:
                self._strike(i, speed, float(self._sinking[i]) if speed == self._speed[i] else 0.0)
            if other or self._since[i] >= self.settings.blow_window:
                self._left[i] = 0.0
            counted = min(depth - before, self._left[i])
            self._driven[i] += counted
            self._left[i] -= counted
            self._depth[i] = depth
            self._limit(i)
        self._before[i] = 0.0 if blow else self._speed[i]
        self._sinking[i] = sinking = float(body.qvel[0])
        self._speed[i] = self._approach(i, sinking)

    def _strike(self, i: int, speed: float, sinking: float) -> None:
        """A blow begins, or goes on in the next physics step: of the face at a speed relative to the nail, which sinks
        already [m/s]."""
        mass = self._mass(i)
        reach = driven_by_momentum(self.settings, struck(self.settings, speed, sinking, mass), mass)
        if self._left[i] > 0 and self._since[i] < self.settings.blow_window:  # the same blow
            reach = max(reach, self._reach[i])
            self._left[i] += reach - self._reach[i]
        else:
            self._left[i] = reach
        self._reach[i], self._since[i] = reach, 0.0

    def _mass(self, i: int) -> float:
        """Mass that strikes in environment i [kg]."""
        return float(self._hammers[i].mass) + self.settings.hand

    def _pressed(self, i: int, contacts: list) -> tuple[bool, bool]:
        """Whether the striking face pressed the nail down in the last physics step, and whether anything else touched
        the nail."""
        face = other = False
        for contact in contacts:
            one, two = contact.bodies
            if id(one) not in self._nails and id(two) not in self._nails:
                continue
            hammer = self._hammers[i] in (one, two)
            for point in contact.points:
                if point.impulse.any():
                    striking = hammer and self._on_face(i, point)
                    face, other = face or striking, other or not striking
        return face, other

    def _on_face(self, i: int, point: sapien.physx.PhysxContactPoint) -> bool:
        """Whether a contact point of hammer and nail was on the striking face, and pressed the nail down."""
        pose = self._poses[i]
        if pose is None or abs(point.normal[2]) < UPRIGHT or abs(pose[:3, 0] @ point.normal) < SQUARE:
            return False
        away = pose[:3, :3].T @ (point.position - pose[:3, 3]) - self._faces[i]
        deep = FACE_DEPTH + max(float(self._speed[i]), 0.0) * self._dt  # the face goes on in the step of the impact
        return bool(abs(away[0]) < deep and np.hypot(away[1], away[2]) < self._radii[i] + FACE_EDGE)

    def _approach(self, i: int, nail_speed: float) -> float:
        """Downward speed of the striking face relative to the nail [m/s]; 0 if the hammer is far away. Keeps the
        hammer's pose, in which the next physics step finds its contacts."""
        hammer = self._hammers[i]
        pose = hammer.entity_pose
        away = pose.p - self._place
        if away @ away > WATCHED * WATCHED:
            self._poses[i] = None
            return 0.0
        self._poses[i] = matrix = pose.to_transformation_matrix()
        arm = matrix[:3, :3] @ self._faces[i]
        spin = hammer.angular_velocity
        down = -(hammer.linear_velocity[2] + spin[0] * arm[1] - spin[1] * arm[0])
        return float(down) - nail_speed

    def let_strike(self, held: Bool[Tensor, " n"]) -> None:
        """Whether each hammer is held to strike: what one that is not does to the nail is no blow."""
        self._held[:] = held.cpu().numpy()

    @property
    def depth(self) -> Float[Tensor, " n"]:
        """How far each nail has sunk [m]."""
        return torch.tensor(self._depth, device=self._device)

    @property
    def driven(self) -> Float[Tensor, " n"]:
        """How far each nail has been driven by blows [m]."""
        return torch.tensor(self._driven, device=self._device)

    def get_state(self) -> dict[str, Tensor]:
        """What the simulator does not keep, each (n,)."""
        return {f"nail{name}": torch.tensor(getattr(self, name), device=self._device) for name in STATE}

    def set_state(self, state: dict[str, Tensor], rows: Tensor) -> None:
        """Inverse of `get_state` for the environments `rows` (b,)."""
        index = rows.cpu().numpy()
        for name in STATE:
            if f"nail{name}" in state:
                getattr(self, name)[index] = state[f"nail{name}"].reshape(-1).cpu().numpy()
        self._hold(index.tolist())
        self._look(index.tolist())


def drawn_links(settings: NailSettings) -> tuple[tuple[DrawnShape, ...], tuple[DrawnShape, ...]]:
    """What post and nail look like, each in its own frame."""
    height = settings.top[2] - settings.stand
    post = drawn_box((0.0, 0.0, -settings.stand - height / 2), (POST_HALF, POST_HALF, height / 2), PINE)
    head = Shape("cylinder", (0.0, 0.0, -HEAD_HALF), DOWN, (HEAD_RADIUS, HEAD_HALF))
    shank = Shape("cylinder", (0.0, 0.0, -settings.stand / 2), DOWN, (SHANK_RADIUS, settings.stand / 2))
    return (post,), (DrawnShape(head, IRON), DrawnShape(shank, IRON))


def _build(scene: ManiSkillScene, settings: NailSettings) -> Articulation:
    """Post and nail as an articulation; its root is where the top of the undriven nail is."""
    builder = scene.create_articulation_builder()
    material = PhysxMaterial(FRICTION, FRICTION, 0.0)
    height = settings.top[2] - settings.stand
    post = builder.create_link_builder()
    post.set_name("post")
    centre, half = sapien.Pose([0, 0, -settings.stand - height / 2]), (POST_HALF, POST_HALF, height / 2)
    post.add_box_collision(centre, half, material)
    nail = builder.create_link_builder(post)
    nail.set_name("nail")
    axis = sapien.Pose(q=DOWN)
    nail.set_joint_name("nail")
    nail.set_joint_properties("prismatic", [[0.0, settings.travel]], axis, axis)
    density = settings.mass / (np.pi * HEAD_RADIUS**2 * 2 * STOP_HALF)
    stop = sapien.Pose([0, 0, -STOP_HALF], DOWN)
    nail.add_cylinder_collision(stop, HEAD_RADIUS, STOP_HALF, material, density=density)
    if scene.can_render():
        for link, shapes in zip((post, nail), drawn_links(settings), strict=True):
            draw(link, shapes, roughness=0.6)
    builder.initial_pose = sapien.Pose(list(settings.top))
    articulation = builder.build("nail", fix_root_link=True)
    for link in articulation.links:
        link.disable_gravity = True
    return articulation
