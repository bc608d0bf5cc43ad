"""The ManiSkill agent that is made from a robot description; `dora.sim.robots` makes one class per folder."""

from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from jaxtyping import Float
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosControllerConfig
from mani_skill.utils.structs import Articulation, Link
from sapien.physx import PhysxMaterial
from torch import Tensor

from dora.errors import InputError, said
from dora.geometry.poses import Pose, compose
from dora.geometry.rotations import quaternion_apply, quaternion_from_matrix, quaternion_multiply
from dora.robot import RobotDescription
from dora.robot.kinematics import SerialChain
from dora.sim.bodies import merged
from dora.sim.controllers import CoupledJointPosConfig, WristHandConfig, WristHandController

CONTROL_MODES = ("wrist_delta_hand_pos", "pd_joint_pos", "pd_joint_delta_pos")
"""Control modes of every robot, the default first; each exists with the suffix COUPLED as well."""
COUPLED = "_coupled"
"""Suffix of the control modes that enforce the hand's couplings."""
FINGERS = "_fingers"
"""Suffix of the control mode that commands the bend of each finger; the default mode alone has it."""
JOINT_DELTA = 0.1
"""Full action of `pd_joint_delta_pos` [rad per control step]."""


class DescribedRobot(BaseAgent):
    """A ManiSkill agent whose joints, gains, collision shapes and postures come from a `RobotDescription`.

    A class with a `description` of its own gets `urdf_path`, `keyframes` and the joint order from it; subclasses
    inherit them and may replace them:

        @register_agent()
        class Mine(Diana7Hit):
            uid = "mine"
            keyframes = {**Diana7Hit.keyframes, "tucked": Keyframe(pose=sapien.Pose(), qpos=...)}

    Joint vectors "in the simulator's order" are those of ManiSkill (`robot.get_qpos()`, `Keyframe.qpos`); actions of
    the joint modes and vectors of the description have the arm's joints first, then the hand's.
    """

    description: ClassVar[RobotDescription]
    joint_names: ClassVar[tuple[str, ...]]
    """Moving joints in the simulator's order: breadth first from the root, as PhysX sorts the links."""
    arm_index: ClassVar[list[int]]
    """Places of the arm's joints in the simulator's order."""
    hand_index: ClassVar[list[int]]
    """Places of the hand's joints in the simulator's order."""
    fix_root_link = True

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "description" not in vars(cls):
            return
        d = cls.description
        cls.joint_names = d.model.moving_joints
        cls.arm_index, cls.hand_index = ([cls.joint_names.index(n) for n in group.names] for group in (d.arm, d.hand))
        if "urdf_path" not in vars(cls):
            cls.urdf_path = str(d.urdf)
        if "keyframes" not in vars(cls):
            cls.keyframes = {
                name: Keyframe(pose=sapien.Pose(), qpos=cls.qpos_of(p.arm, p.hand)) for name, p in d.postures.items()
            }

    # ---------------------------------------------------------------- building

    def _load_articulation(self, initial_pose: Any = None) -> None:
        """Builds the articulation: primitives and materials of the description instead of the URDF's collisions."""
        name = self.uid if self._agent_idx is None else f"{self.uid}-agent-{self._agent_idx}"
        if self.build_separate:
            parts = [self._build(f"{name}-{i}", initial_pose, [i]) for i in range(self.scene.num_envs)]
            self.robot = merged(self.scene, parts, Articulation, name)
        else:
            self.robot = self._build(name, initial_pose)
        self.robot_link_names = [link.name for link in self.robot.get_links()]
        found = tuple(joint.name for joint in self.robot.active_joints)
        if found != self.joint_names:
            raise InputError(
                f"robot {self.uid!r}: {self.urdf_path} has the moving joints {', '.join(found)} but the description "
                f"has {', '.join(self.joint_names)}; give the class a description of its own."
            )

    def _build(self, name: str, initial_pose: Any, scene_idxs: list[int] | None = None) -> Articulation:
        """One articulation, in all environments or in those of `scene_idxs`."""
        loader = self.scene.create_urdf_loader()
        loader.name = name
        loader.fix_root_link = self.fix_root_link
        try:
            builder = loader.parse(str(self.urdf_path))["articulation_builders"][0]
        except Exception as error:  # the reader raises whatever it meets in elements that only it reads
            raise InputError(
                f"the simulator cannot read {self.urdf_path} ({said(type(error).__name__, error)[:-1]}): correct it."
            ) from error
        # The tips are frames, not bodies: as links they would cost PhysX 6 % of a step.
        frames = {f.tip for f in self.description.fingers.values()}
        builder.link_builders = [link for link in builder.link_builders if link.name not in frames]
        for index, link in enumerate(builder.link_builders):
            link.index = index
        bits = self.description.collision_bits()
        for link in builder.link_builders:
            link.collision_records = []
            self._add_shapes(link)
            link.collision_groups[2] |= bits.get(link.name, 0)
            # Bits of word 2 count only between shapes with one number here: robots do not ignore each other.
            link.collision_groups[3] |= int(self._agent_idx or 0)
        builder.initial_pose = initial_pose if initial_pose is not None else sapien.Pose()
        builder.set_scene_idxs(scene_idxs)
        return builder.build()

    def _add_shapes(self, link: Any) -> None:
        contact = self.description.contacts.get(link.name)
        for shape in self.description.shapes.get(link.name, ()):
            material = PhysxMaterial(contact.friction, contact.friction, contact.restitution) if contact else None
            pose = sapien.Pose(shape.position, shape.quaternion)
            size = [list(shape.size)] if shape.kind == "box" else shape.size
            getattr(link, f"add_{shape.kind}_collision")(pose, *size, material)

    def _after_loading_articulation(self) -> None:
        for name, contact in self.description.contacts.items():
            for body in self.robot.links_map[name]._bodies:
                for shape in body.get_collision_shapes():
                    shape.set_contact_offset(contact.contact_offset)
                    shape.set_rest_offset(contact.rest_offset)

    def _after_init(self) -> None:
        d, links = self.description, self.robot.links_map
        self.wrist: Link = links[d.wrist_link]
        self.palm: Link = links[d.palm_link]
        self.distals: list[Link] = [links[f.distal] for f in d.fingers.values()]
        self._tip_p, self._tip_q = (x.to(self.device) for x in self._tip_frames())
        self.finger_links: list[list[Link]] = [[links[n] for n in f.links] for f in d.fingers.values()]

    # ---------------------------------------------------------------- control

    def reset(self, init_qpos: Tensor | None = None) -> None:
        """As ManiSkill's; in a partial reset the wrist commands of the other environments stay as they are."""
        super().reset(init_qpos)  # pyright: ignore[reportArgumentType]
        if self.commands_wrist:
            self.wrist_controller.expect_reset(self.scene._reset_mask)

    @property
    def commands_wrist(self) -> bool:
        """Whether the active control mode is one of `WristHandController`."""
        return isinstance(self.controller, WristHandController)

    @property
    def wrist_controller(self) -> WristHandController:
        """The active controller.

        Raises:
            InputError: if the control mode commands joints instead of the wrist.
        """
        if not isinstance(controller := self.controller, WristHandController):
            raise InputError(f"the control mode {self.control_mode!r} commands no wrist: use {CONTROL_MODES[0]!r}")
        return controller

    def _tip_frames(self) -> tuple[Tensor, Tensor]:
        """Fingertip frames in their distal links: (f, 3) [m], (f, 4) wxyz."""
        model, fingers = self.description.model, self.description.fingers.values()
        frames = torch.tensor(np.stack([model.frame(f.distal, f.tip) for f in fingers]), dtype=torch.float32)
        return frames[:, :3, 3], quaternion_from_matrix(frames[:, :3, :3])

    def tips_of(
        self, distal_p: Float[Tensor, "n f 3"], distal_q: Float[Tensor, "n f 4"]
    ) -> tuple[Float[Tensor, "n f 3"], Float[Tensor, "n f 4"]]:
        """Poses of the fingertip frames from those of the distal links."""
        shift = quaternion_apply(distal_q, self._tip_p.expand_as(distal_p))
        return distal_p + shift, quaternion_multiply(distal_q, self._tip_q.expand_as(distal_q))

    @classmethod
    def qpos_of(cls, arm: np.ndarray, hand: np.ndarray) -> np.ndarray:
        """Joint vectors (..., n_arm), (..., n_hand) -> the simulator's order (..., n_joints) [rad]."""
        out = np.zeros((*arm.shape[:-1], len(cls.joint_names)), np.float32)
        out[..., cls.arm_index], out[..., cls.hand_index] = arm, hand
        return out

    def joint_action(self, qpos: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch a"]:
        """The action of the present control mode that asks for joint angles given in the simulator's order [rad].

        Raises:
            InputError: if the control mode takes no joint targets.
        """
        _, absolute, _ = CONTROL_MODES
        if self.control_mode not in (absolute, absolute + COUPLED):
            raise InputError(f"the control mode {self.control_mode!r} takes no joint targets: use {absolute!r}")
        hand = qpos[..., self.hand_index]
        hand = self.description.reduce_hand(hand) if self.control_mode.endswith(COUPLED) else hand
        return torch.cat([qpos[..., self.arm_index], hand], -1)

    def base_pose(self) -> Pose:
        """Pose of the robot's base in the world, (n, 3) [m] and (n, 4) wxyz, read from the simulator."""
        pose = self.robot.pose
        return pose.p, pose.q

    def world_posture_wrist(self, name: str) -> Pose:
        """Wrist poses (n, 3) [m], (n, 4) wxyz in the world frame, in a named posture and with the present base."""
        return compose(self.base_pose(), self.posture_wrist(name))

    def posture_wrist(self, name: str) -> tuple[Tensor, Tensor]:
        """Wrist pose (1, 3) [m], (1, 4) wxyz in the base frame, in a posture; errors as `RobotDescription.posture`."""
        arm = torch.tensor(self.description.posture(name).arm, dtype=torch.float32, device=self.device)
        position, matrix = SerialChain.of(self.description, device=self.device).tip_pose(arm[None])
        return position, quaternion_from_matrix(matrix)

    @property
    def _controller_configs(self) -> dict[str, Any]:
        d = self.description
        names = [*d.arm.names, *d.hand.names]
        gains = {
            key: [*getattr(d.arm, source), *getattr(d.hand, source)]
            for key, source in (("stiffness", "stiffness"), ("damping", "damping"), ("force_limit", "effort"))
        }
        absolute = {"normalize_action": False, "lower": None, "upper": None, **gains}
        delta = {"lower": -JOINT_DELTA, "upper": JOINT_DELTA, "use_delta": True, **gains}
        wrist, absolute_mode, delta_mode = CONTROL_MODES
        return {
            wrist: WristHandConfig(names, robot=d),
            absolute_mode: PDJointPosControllerConfig(names, **absolute),
            delta_mode: PDJointPosControllerConfig(names, **delta),
            wrist + COUPLED: WristHandConfig(names, robot=d, hand="coupled"),
            absolute_mode + COUPLED: CoupledJointPosConfig(names, robot=d, **absolute),
            delta_mode + COUPLED: CoupledJointPosConfig(names, robot=d, **delta),
            wrist + FINGERS: WristHandConfig(names, robot=d, hand="fingers"),
        }
