"""A robot's hand without its arm: the palm is fixed in space, or moved in straight lines by a carriage."""

import numpy as np
import sapien
from sapien import physx
from sapien.wrapper.articulation_builder import ArticulationBuilder, LinkBuilder
from sapien.wrapper.urdf_loader import URDFLoader

from dora.digests import check_folder
from dora.robot import RobotDescription
from dora.sim.shapes import collision_shape

PALM, FIRST_FINGER = 0, 1
"""Indices of the palm and of the first finger among the hand parts."""
CARRIAGE_STIFFNESS = 2e4
"""Stiffness of the carriage's drive along each axis, about that of the arm's drives at the wrist [N/m]."""
CARRIAGE_DAMPING = 4e2
"""Damping of the carriage's drive along each axis [N s/m]."""
CARRIAGE_FORCE = 200.0
"""Largest force of the carriage along each axis [N]."""
CARRIAGE_REACH = 2.0
"""Travel of each slide to both sides [m]."""
CARRIAGE_MASS = 0.5
"""Mass of each slide [kg]."""


class FloatingHand:
    """The weightless hand of a robot, with joints in the order of the robot's description.

    Args:
        scene: scene in which the hand is built.
        robot: the robot whose hand is built.
        friction: Coulomb coefficient of all links, instead of the description's [1].
        iterations: numbers of position and velocity iterations of the solver.
        carriage: whether the palm is mounted on three slides along the axes of the root frame.

    Attributes:
        parts: number of hand parts: the palm, then the fingers in the description's order.
        part_of: index of the hand part by `id` of a link's body.
    """

    def __init__(
        self,
        scene: sapien.Scene,
        robot: RobotDescription,
        friction: float,
        iterations: tuple[int, int],
        carriage: bool = False,
    ):
        builder = _hand_builder(scene, robot)
        if carriage:
            _put_on_carriage(builder)
        entities = builder.build_entities(fix_root_link=True)
        bodies = {e.name: e.find_component_by_type(physx.PhysxArticulationLinkComponent) for e in entities}
        bits = robot.collision_bits()
        for name, body in bodies.items():
            for shape in robot.shapes.get(name, ()):
                contact = robot.contacts[name]
                made = collision_shape(shape, physx.PhysxMaterial(friction, friction, contact.restitution))
                made.set_contact_offset(contact.contact_offset)
                made.set_rest_offset(contact.rest_offset)
                made.set_collision_groups([1, 1, bits[name], 0])
                body.attach(made)
            body.disable_gravity = True
        for entity in entities:
            scene.add_entity(entity)
        self.articulation: physx.PhysxArticulation = bodies[robot.wrist_link].articulation
        self.articulation.set_solver_position_iterations(iterations[0])
        self.articulation.set_solver_velocity_iterations(iterations[1])
        self._bodies = bodies  # keeps the bodies alive, whose ids are keys
        self._name_parts(robot)
        self._set_drives(robot)

    def _name_parts(self, robot: RobotDescription) -> None:
        self.parts = FIRST_FINGER + len(robot.fingers)
        part_of = {name: PALM for name in self._bodies}
        for number, finger in enumerate(robot.fingers.values(), FIRST_FINGER):
            part_of |= dict.fromkeys(finger.links, number)
        self.part_of = {id(body): part_of[name] for name, body in self._bodies.items()}

    def _set_drives(self, robot: RobotDescription) -> None:
        active = self.articulation.active_joints
        joints = {joint.name: joint for joint in active}
        self._slides = [joints[name] for name in _SLIDES if name in joints]
        self._joints = [joints[name] for name in robot.hand.names]
        place = {joint.name: index for index, joint in enumerate([*self._slides, *self._joints])}
        self._order = [place[joint.name] for joint in active]
        """Per joint of the articulation: its index among the slides followed by the hand joints."""
        for slide in self._slides:
            slide.set_drive_properties(CARRIAGE_STIFFNESS, CARRIAGE_DAMPING, CARRIAGE_FORCE, "force")
        hand = robot.hand
        for i, joint in enumerate(self._joints):
            joint.set_drive_properties(hand.stiffness[i], hand.damping[i], hand.effort[i], "force")
            joint.set_armature(np.array([hand.armature[i]], np.float32))

    def reset(self, joints: np.ndarray, root: sapien.Pose | None = None, offset: np.ndarray | None = None) -> None:
        """Places the hand at rest and commands it to stay there.

        Args:
            joints: (hand,) hand joints [rad].
            root: pose of the root in the world; unchanged if None.
            offset: (3,) offset of the palm in the root frame [m]; zero if None. Only with a carriage.
        """
        if root is not None:
            self.articulation.set_root_pose(root)
        slides = np.zeros(len(self._slides)) if offset is None else offset
        self.articulation.set_qpos(np.concatenate([slides, joints])[self._order].astype(np.float32))
        self.articulation.set_qvel(np.zeros(len(self._order), np.float32))
        self.command(joints)
        self.move(slides.tolist())

    def command(self, joints: np.ndarray) -> None:
        """Sets the drive targets of the hand joints (hand,) [rad]."""
        for joint, angle in zip(self._joints, joints.tolist(), strict=True):
            joint.set_drive_target(angle)

    def move(self, offset: list[float]) -> None:
        """Sets the drive targets of the slides: offset (3,) of the palm in the root frame [m]."""
        for slide, value in zip(self._slides, offset, strict=True):
            slide.set_drive_target(value)

    @property
    def lag(self) -> float:
        """Distance of the palm from the drive targets of the slides [m]."""
        qpos = self.articulation.qpos
        ahead = [slide.drive_target[0] - qpos[self._order.index(i)] for i, slide in enumerate(self._slides)]
        return float(np.linalg.norm(ahead))


_SLIDES = ("slide_x", "slide_y", "slide_z")
"""Names of the joints of the carriage."""
_SLIDE_TURNS = ((1.0, 0.0, 0.0, 0.0), (0.5**0.5, 0.0, 0.0, 0.5**0.5), (0.5**0.5, 0.0, -(0.5**0.5), 0.0))
"""Orientations (wxyz) of the slides' frames: a prismatic joint moves along its frame's x."""


def _hand_builder(scene: sapien.Scene, robot: RobotDescription) -> ArticulationBuilder:
    """Builder of the wrist link and all links that it carries, with their inertias, without shapes."""
    check_folder(robot.folder)
    loader = URDFLoader()
    loader.set_scene(scene)
    builder = loader.parse(str(robot.urdf))[0][0]
    frames = {finger.tip for finger in robot.fingers.values()}
    kept: list[LinkBuilder] = []
    for link in builder.link_builders:
        if link.name == robot.wrist_link or link.parent in kept:
            kept.append(link)
    kept = [link for link in kept if link.name not in frames]
    for index, link in enumerate(kept):
        link.index, link.collision_records, link.visual_records = index, [], []
    kept[0].parent = None
    kept[0].set_joint_name("")
    kept[0].set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
    builder.link_builders = kept
    return builder


def _put_on_carriage(builder: ArticulationBuilder) -> None:
    """Inserts the three slides between the root and the palm."""
    hand, parent = builder.link_builders, None
    builder.link_builders = []
    for name in ("rail", *_SLIDES[:2]):
        link = LinkBuilder(len(builder.link_builders), parent)
        link.set_name(name.replace("slide", "carriage"))
        link.set_mass_and_inertia(CARRIAGE_MASS, sapien.Pose(), [1e-3] * 3)
        builder.link_builders.append(link)
        parent = link
    builder.link_builders += hand
    for index, link in enumerate(builder.link_builders):
        link.index = index
    hand[0].parent = parent
    limits = [[-CARRIAGE_REACH, CARRIAGE_REACH]]
    for name, turn, link in zip(_SLIDES, _SLIDE_TURNS, builder.link_builders[1:4], strict=True):
        link.set_joint_name(name)
        link.set_joint_properties("prismatic", limits, sapien.Pose(q=turn), sapien.Pose(q=turn))
    builder.link_builders[0].set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
