"""The default controller: wrist displacement through damped inverse kinematics, and hand joint targets.

One law on every backend, in batched torch, on *commanded* joints: contact forces never leak into the command.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Bool, Float, Int
from mani_skill.agents.controllers.base_controller import BaseController, ControllerConfig
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController, PDJointPosControllerConfig
from torch import Tensor

from dora.geometry.poses import Pose, compose
from dora.geometry.rotations import quaternion_apply, quaternion_from_matrix, quaternion_inverse
from dora.robot.description import RobotDescription
from dora.robot.kinematics import Frames, SerialChain
from dora.robot.synergies import expand_fingers, reduce_fingers, synergy_count

WRIST_SPEED = 0.6
"""Linear wrist speed of a full action along one axis [m/s], unless a task sets its own."""
WRIST_SPIN = 2.0
"""Angular wrist speed of a full action about one axis [rad/s], unless a task sets its own."""
ARM_LEASH = 0.3
"""Largest lead of a commanded arm joint over the measured one [rad]; stops wind-up in contact."""
ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""The world's own pose: position [m], quaternion wxyz."""
AT_ORIGIN = 1e-6
"""Largest difference of a base's pose from the world's that is rounding of the simulator [m], [1]."""
LIMIT_MARGIN = 0.01
"""Distance that commanded arm joints keep from their limits [rad]."""


@dataclass(frozen=True)
class HandCommand:
    """How a hand is commanded: number of components, and the maps from them to all joints and back.

    Both are in units of half a joint's range about its middle.
    """

    size: Callable[[RobotDescription], int]
    expand: Callable[[RobotDescription, Tensor], Tensor]
    reduce: Callable[[RobotDescription, Tensor], Tensor]


HAND_COMMANDS = {
    "joints": HandCommand(lambda robot: len(robot.hand), lambda _, hand: hand, lambda _, hand: hand),
    "coupled": HandCommand(
        lambda robot: len(robot.hand_actuated), RobotDescription.expand_hand, RobotDescription.reduce_hand
    ),
    "fingers": HandCommand(synergy_count, expand_fingers, reduce_fingers),
}
"""By name: every joint, the actuated joints with their followers, and the bend of each finger."""


class WristHandController(BaseController):
    """6 wrist displacements, then hand joint targets; every action component in [-1, 1].

    The first three components are a translation and the next three a rotation vector of the wrist in the robot's
    base frame, scaled by WRIST_SPEED and WRIST_SPIN per control step; `to_base_frame` makes them from a displacement
    in the world frame, and `world_wrist` says where the command stands there. They become arm joint increments by
    dq = J^T (J J^T + lambda^2 I)^-1 dx (the paper's J^+, damped), within joint and velocity limits. The rest maps
    linearly onto the joint limits of the hand; targets move no faster than the joints' velocity limits.
    """

    config: "WristHandConfig"
    sets_target_qpos = True
    sets_target_qvel = False
    efforts = 1.0, 1.0
    """Shares of their torque limits with which the drives of arm and hand work."""
    wrist_speed = 1.0
    """Share of the speeds of `set_motion` at which a full action moves the wrist."""

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        robot, f32 = self.config.robot, torch.float32
        self.arm_size = len(robot.arm)
        self.chain = SerialChain.of(robot, device=self.device)
        self.dt = 1.0 / self._control_freq
        self.set_motion(WRIST_SPEED, WRIST_SPIN, feed_forward=False)
        self.arm_lower = torch.tensor(robot.arm.lower + LIMIT_MARGIN, dtype=f32, device=self.device)
        self.arm_upper = torch.tensor(robot.arm.upper - LIMIT_MARGIN, dtype=f32, device=self.device)
        self.hand_lower = torch.tensor(robot.hand.lower, dtype=f32, device=self.device)
        self.hand_upper = torch.tensor(robot.hand.upper, dtype=f32, device=self.device)
        self.hand_step = torch.tensor(robot.hand.velocity, dtype=f32, device=self.device) * self.dt
        self.target: Tensor = torch.empty(0)
        self._begun = False
        self._starting: Tensor | None = None
        self._known: tuple[Tensor, Frames] | None = None
        self._origin: Tensor = torch.empty(0)

    def _initialize_action_space(self) -> None:
        size = 6 + self.hand_size
        self.single_action_space = spaces.Box(-1.0, 1.0, (size,), np.float32)

    def set_motion(self, speed: float, spin: float, feed_forward: bool) -> None:
        """How fast a full action moves the wrist, and whether the arm's drives are told their velocity.

        Without it the arm follows its command with a lag of damping / stiffness (0.1 s here), which makes contacts
        softer; with it there is almost no lag, which catching and striking need.

        Args:
            speed: linear speed along one axis [m/s].
            spin: angular speed about one axis [rad/s].
            feed_forward: the velocity of the commanded joints becomes the drives' velocity target.
        """
        self._motion, self.feed_forward = (speed, spin), feed_forward
        self._scale_motion()

    def _scale_motion(self) -> None:
        speed, spin = (self.wrist_speed * self.dt * full for full in self._motion)
        self.wrist_limits = (speed, spin)
        """Translation [m] and rotation [rad] of a full action in one control step."""
        scale = torch.tensor([speed] * 3 + [spin] * 3, device=self.device)
        full = torch.tensor([self._motion[0]] * 3 + [self._motion[1]] * 3, device=self.device) * self.dt
        self.wrist_scale = full if self.wrist_speed == 1 else scale  # as they are rounded in stored runs

    def limit(self, arm_effort: float, hand_effort: float, wrist_speed: float, hand_speed: float) -> None:
        """Makes arm and hand gentler where they meet something.

        Args:
            arm_effort: share of their torque limits that the drives of the arm get. The motion of the free arm needs
                little of them: it is bounded by its speed, not by its torques.
            hand_effort: the same of the hand.
            wrist_speed: share of the speeds of `set_motion` at which a full action moves the wrist.
            hand_speed: share of the finger joints' velocity limits at which their commands move.
        """
        self.efforts, self.wrist_speed = (arm_effort, hand_effort), wrist_speed
        full = torch.tensor(self.config.robot.hand.velocity, dtype=torch.float32, device=self.device) * self.dt
        self.hand_step = hand_speed * full
        self.set_drive_property()
        self._scale_motion()

    @property
    def hand_size(self) -> int:
        """Number of hand components in the action."""
        return HAND_COMMANDS[self.config.hand].size(self.config.robot)

    def set_drive_property(self) -> None:
        """Gains, effort limits and armature from the robot's description."""
        robot = self.config.robot
        groups, joints_of = (robot.arm, robot.hand), (self.joints[: self.arm_size], self.joints[self.arm_size :])
        for group, joints, share in zip(groups, joints_of, self.efforts, strict=True):
            for i, joint in enumerate(joints):
                joint.set_drive_properties(group.stiffness[i], group.damping[i], force_limit=share * group.effort[i])
                for part in joint._objs:
                    part.set_armature(np.array([group.armature[i]], np.float32))

    def begin(self, rows: Int[Tensor, " b"], joints: Float[Tensor, "b joints"]) -> None:
        """Commands `joints` (arm, hand) [rad] in the environments `rows` at the start of their episodes.

        ManiSkill calls `reset` for all environments even in a partial reset; the call that follows does nothing.
        """
        if len(self.target) == 0:
            self.target = self.qpos.clone()
        self.target = self.target.index_copy(0, rows, joints)
        self._begun = True

    def expect_reset(self, starting: Bool[Tensor, " n"]) -> None:
        """Which environments the next `reset` is about; without this, it is about all of them."""
        self._starting = starting.clone()

    def reset(self) -> None:
        """Commands the measured posture where an episode starts, unless `begin` has just said what to command."""
        if not self._begun:
            measured, starting = self.qpos.clone(), self._starting
            if starting is not None and len(self.target) > 0:
                measured = torch.where(starting[:, None], measured, self.target)
            self.target = measured
        self._begun, self._starting = False, None
        self._send()

    def expand_hand(self, hand: Float[Tensor, "n h"]) -> Float[Tensor, "n hand"]:
        """Values of the action's hand components -> values of all hand joints."""
        return HAND_COMMANDS[self.config.hand].expand(self.config.robot, hand)

    def wrist(self) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
        """The commanded wrist pose in the robot's base frame."""
        tip = self._frames().tip
        return tip[:, :3, 3], quaternion_from_matrix(tip[:, :3, :3])

    def world_wrist(self) -> Pose:
        """The commanded wrist pose in the world frame: (n, 3) [m], (n, 4) wxyz.

        The base pose is read at each call (0.01 ms of a control step of 1 ms and more), so that a base that a task
        has just moved counts at once.
        """
        base = self._moved_base()
        return self.wrist() if base is None else compose(base, self.wrist())

    def to_base_frame(self, step: Float[Tensor, "n 6"]) -> Float[Tensor, "n 6"]:
        """A displacement in the world frame, turned into the base frame of the action.

        Both halves are rotated by the inverse of the base's orientation, which keeps their lengths. So a step in
        units of a full action ([-1, 1], see `wrist_limits`) may be given as well as one in m and rad.

        Args:
            step: translation of the wrist [m], then rotation vector [rad], both in the world frame.
        """
        base = self._moved_base()
        if base is None:
            return step
        back = quaternion_inverse(base[1])
        return torch.cat([quaternion_apply(back, step[:, :3]), quaternion_apply(back, step[:, 3:])], -1)

    def _moved_base(self) -> Pose | None:
        """Pose of the robot's base in the world; None where it is the world's frame in every environment."""
        pose = self.articulation.pose.raw_pose
        if self._origin.shape != pose.shape:
            self._origin = pose.new_tensor(ORIGIN).expand_as(pose)
        at_origin = torch.allclose(pose, self._origin, rtol=0.0, atol=AT_ORIGIN)
        return None if at_origin else (pose[:, :3], pose[:, 3:])

    def _frames(self) -> Frames:
        """Forward kinematics of the commanded arm, once per command."""
        if self._known is None or self._known[0] is not self.target:
            self._known = (self.target, self.chain.forward(self.target[:, : self.arm_size]))
        return self._known[1]

    def hand_action(self, joints: Float[Tensor, "n hand"]) -> Float[Tensor, "n h"]:
        """Hand components of the action that ask for these joint targets [rad]."""
        middle, half = (self.hand_upper + self.hand_lower) / 2, (self.hand_upper - self.hand_lower) / 2
        return HAND_COMMANDS[self.config.hand].reduce(self.config.robot, ((joints - middle) / half).clamp(-1, 1))

    def set_action(self, action: Float[Tensor, "n a"]) -> None:
        """Moves the commanded joints by one control step and sends them to the drives."""
        action = action.clamp(-1, 1)
        arm, hand = self.target[:, : self.arm_size], self.target[:, self.arm_size :]
        arm = arm + self.chain.damped_step(
            arm, action[:, :6] * self.wrist_scale, duration=self.dt, frames=self._frames()
        )
        measured = self.qpos[:, : self.arm_size]
        arm = torch.clamp(arm, measured - ARM_LEASH, measured + ARM_LEASH)
        arm = torch.clamp(arm, self.arm_lower, self.arm_upper)
        share = self.expand_hand(action[:, 6:]) / 2 + 0.5
        wanted = self.hand_lower + share * (self.hand_upper - self.hand_lower)
        hand = hand + torch.clamp(wanted - hand, -self.hand_step, self.hand_step)
        if self.feed_forward:
            self._tell_velocity((arm - self.target[:, : self.arm_size]) / self.dt)
        self.target = torch.cat([arm, hand], -1)
        self.articulation.set_joint_drive_targets(self.target, self.joints, self.active_joint_indices)

    def hold(self) -> None:
        """Keeps the commanded joints; with feed-forward, sets the velocity targets of the arm's drives to 0."""
        if self.feed_forward:
            self._tell_velocity(torch.zeros_like(self.target[:, : self.arm_size]))

    def _tell_velocity(self, arm: Float[Tensor, "n arm"]) -> None:
        """Sends velocities [rad/s] to the drives of the arm."""
        self.articulation.set_joint_drive_velocity_targets(
            arm, self.joints[: self.arm_size], self.active_joint_indices[: self.arm_size]
        )

    def get_state(self) -> dict[str, Tensor]:
        """The commanded joints, arm then hand: (n, joints) [rad]."""
        return {"target": self.target.clone()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Restores commanded joints and drive targets of all environments."""
        self.restore(state["target"], torch.arange(len(state["target"]), device=self.device))

    def restore(self, target: Float[Tensor, "b joints"], rows: Int[Tensor, " b"]) -> None:
        """Restores commanded joints [rad] and drive targets of the environments `rows`."""
        if len(self.target) == 0:
            self.target = self.qpos.clone()
        self.target = self.target.index_copy(0, rows, target)
        self._send()

    def _send(self) -> None:
        """Sends the commanded joints to the drives: all, or in a partial reset those of its environments."""
        written = self.target[self.scene._reset_mask]
        self.articulation.set_joint_drive_targets(written, self.joints, self.active_joint_indices)
        if self.scene.gpu_sim_enabled:
            system: Any = self.scene.px  # PhysX's GPU system or BatchSystem
            system.gpu_apply_articulation_target_position()


@dataclass
class WristHandConfig(ControllerConfig):
    """Configuration of `WristHandController`; `hand` is one of `HAND_COMMANDS`."""

    robot: RobotDescription
    hand: str = "joints"
    controller_cls = WristHandController


class CoupledJointPosController(PDJointPosController):
    """ManiSkill's joint position controller for the actuated joints only; coupled joints follow in the command.

    (ManiSkill's own mimic controller wants every joint to be a leader or a follower.)
    """

    config: "CoupledJointPosConfig"

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        arm = len(self.config.robot.arm)
        hand = torch.from_numpy(self.config.robot.hand_actuated).to(self.device) + arm
        self.actuated = torch.cat([torch.arange(arm, device=self.device), hand])
        self.arm_size = arm

    def _get_joint_limits(self) -> np.ndarray:
        return super()._get_joint_limits()[self.actuated.cpu().numpy()]

    def set_action(self, action: Float[Tensor, "n a"]) -> None:
        """Sends absolute targets [rad], or targets relative to the measured joints."""
        asked = torch.as_tensor(self._preprocess_action(action))
        if self.config.use_delta:
            asked = self.qpos[:, self.actuated] + asked
        hand = self.config.robot.expand_hand(asked[:, self.arm_size :])
        self._target_qpos = torch.cat([asked[:, : self.arm_size], hand], -1)
        self.set_drive_targets(self._target_qpos)


@dataclass(kw_only=True)
class CoupledJointPosConfig(PDJointPosControllerConfig):
    """Configuration of `CoupledJointPosController`; joints are the arm's, then the hand's."""

    robot: RobotDescription
    controller_cls = CoupledJointPosController
