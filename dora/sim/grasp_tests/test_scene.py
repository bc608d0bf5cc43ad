"""The scene of grasp tests: one object, a hand without an arm, and optionally a table."""

from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
from sapien import physx

from dora.affordance.objects.affordance_object import AffordanceObject
from dora.errors import InputError
from dora.robot import RobotDescription
from dora.sim.actors import object_entity
from dora.sim.grasp_tests.floating_hand import FloatingHand
from dora.sim.grasp_tests.hand_contacts import HandContactReader

TABLE_HALF = (1.0, 1.0, 0.05)
"""Half sides of the table along x, y, z [m]; its upper face is at z = 0."""
ANGULAR_DAMPING = 0.05
"""PhysX's default damping of rotation [1/s]."""
_ZERO = np.zeros(3, np.float32)
"""No velocity or torque."""


@dataclass(frozen=True)
class Physics:
    """Resolution of the simulation of a test scene.

    Attributes:
        rate: physics steps per second [1/s].
        position_iterations: number of position iterations of the solver (TGS) per step.
        velocity_iterations: number of velocity iterations of the solver per step.
        contact_offset: PhysX's contact offset of the object, the distance below which contacts are generated [m].

    Raises:
        InputError: a number is not positive.
    """

    rate: float = 200.0
    position_iterations: int = 8
    velocity_iterations: int = 1
    contact_offset: float = 0.002

    def __post_init__(self) -> None:
        if not (self.rate > 0 and self.position_iterations > 0 and self.velocity_iterations >= 0):
            raise InputError("the physics rate and iterations must be positive; correct them.")

    def steps(self, duration: float) -> int:
        """Number of physics steps in a duration [s], at least 1."""
        return max(1, round(duration * self.rate))


@contextmanager
def _gravity(gravity: Sequence[float]):
    """Changes SAPIEN's global scene settings, which a new physics system copies, and restores them afterwards."""
    before = physx.get_scene_config()
    kept = (before.gravity.copy(), before.enable_tgs)
    settings: dict[str, Any] = {"gravity": np.array(gravity, np.float32), "enable_tgs": True}
    physx.set_scene_config(**settings)
    try:
        yield
    finally:
        physx.set_scene_config(gravity=kept[0], enable_tgs=kept[1])


class GraspTestScene:
    """A scene with a floating hand and a free object, reused for many grasps.

    Args:
        obj: the object.
        robot: the robot whose hand is simulated.
        friction: Coulomb coefficient of hand and object [1].
        physics: resolution of the simulation.
        gravity: (3,) acceleration of the object in the world [m/s^2]; the hand is weightless.
        carriage: whether the palm is mounted on a carriage, see `FloatingHand`.
        table: whether there is a table below z = 0.

    Attributes:
        hand: the hand.
        body: the object's body.
        step: function that makes one physics step.
        read_contacts: function that returns the contacts of hand and object in the last step.
    """

    def __init__(
        self,
        obj: AffordanceObject,
        robot: RobotDescription,
        friction: float,
        physics: Physics,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        carriage: bool = False,
        table: bool = False,
    ):
        self.physics = physics
        with _gravity(gravity):
            system = physx.PhysxCpuSystem()
        system.timestep = 1 / physics.rate
        self._scene = sapien.Scene([system])
        self.step = system.step
        iterations = physics.position_iterations, physics.velocity_iterations
        self.hand = FloatingHand(self._scene, robot, friction, iterations, carriage)
        self._entity = object_entity(obj, friction=friction, contact_offset=physics.contact_offset)
        self.body: Any = self._entity.find_component_by_type(physx.PhysxRigidDynamicComponent)
        self.body.set_solver_position_iterations(iterations[0])
        self.body.set_solver_velocity_iterations(iterations[1])
        self._scene.add_entity(self._entity)
        self._mass, self._inertia = self.body.mass, np.array(self.body.inertia)
        bodies = [self.body, *self.hand.articulation.links]
        self._materials = [shape.physical_material for body in bodies for shape in body.collision_shapes]
        if table:
            self._add_table(friction)
        self.read_contacts = HandContactReader(system.get_contacts, self.body, self.hand.part_of, system.timestep).read

    def _add_table(self, friction: float) -> None:
        shape = physx.PhysxCollisionShapeBox(list(TABLE_HALF), physx.PhysxMaterial(friction, friction, 0.0))
        shape.local_pose = sapien.Pose([0.0, 0.0, -TABLE_HALF[2]])
        self._materials.append(shape.physical_material)
        top = physx.PhysxRigidStaticComponent()
        top.attach(shape)
        entity = sapien.Entity()
        entity.add_component(top)
        self._scene.add_entity(entity)

    def place(self, position: np.ndarray, quaternion: np.ndarray) -> None:
        """Places the object at rest, with its origin (3,) [m] and orientation (4,) wxyz in the world."""
        self._entity.set_pose(sapien.Pose(position.tolist(), quaternion.tolist()))
        self.body.set_linear_velocity(_ZERO)
        self.body.set_angular_velocity(_ZERO)

    def stage(self, position: np.ndarray, quaternion: np.ndarray, mass: float, friction: float) -> None:
        """Places the object at rest and sets its mass [kg] and the friction coefficient of all bodies [1]."""
        self.place(position, quaternion)
        self.body.set_mass(mass)
        self.body.set_inertia(self._inertia * (mass / self._mass))
        for material in self._materials:
            material.static_friction = friction
            material.dynamic_friction = friction

    def run(self, steps: int) -> None:
        """Makes a number of physics steps."""
        for _ in range(steps):
            self.step()

    def damp(self, rate: float) -> None:
        """Sets the rate at which the object's velocities decay [1/s]; 0 restores PhysX's default."""
        self.body.set_linear_damping(rate)
        self.body.set_angular_damping(max(rate, ANGULAR_DAMPING))

    def push(self, force: np.ndarray) -> None:
        """Applies a force (3,) [N] at the centre of mass during the next physics step."""
        self.body.add_force_torque(force, _ZERO)

    @property
    def position(self) -> np.ndarray:
        """The object's centre of mass (3,) in the world [m]."""
        return np.asarray(self._entity.pose.p)

    @property
    def pose(self) -> sapien.Pose:
        """The object's pose in the world [m]."""
        return self._entity.pose
