"""The only place where a task reads the simulator."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from torch import Tensor

from dora.geometry.rotations import quaternion_apply, quaternion_inverse
from dora.sim.bodies import BodyReader
from dora.sim.contacts import ContactMonitor, Contacts
from dora.sim.robot_agent import DescribedRobot
from dora.tasks.env.episode_memory import Episode
from dora.tasks.guidance.grasp_and_lift import Guide
from dora.tasks.mdp.snapshot import CONTACT_CLASSES, FINGERS, Snapshot
from dora.tasks.mdp.stages import StageMachine

TIPS = slice(1, 1 + len(FINGERS))
"""Places of the distal links among the bodies whose poses are read: after the wrist, before the object."""


class SimulatorReader:
    """Reads the robot and the manipulated object of a built scene; make a new one after a reconfiguration.

    Args:
        scene: the scene of all environments.
        agent: the robot.
        target: the manipulated object.
        world: what the object and the hand may touch besides each other.
        points: contact points of hand and object that are wanted; 0 if nobody asks for them.
        every_step: collect contacts from all physics steps of a control step, not from the last one only.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        agent: DescribedRobot,
        target: Actor,
        world: Sequence[Actor | Link],
        points: int = 0,
        every_step: bool = False,
    ):
        self._agent = agent
        self._poses = BodyReader(scene, [agent.wrist, *agent.distals, target])
        self._velocities = BodyReader(scene, [agent.wrist, target])
        parts = dict(zip(FINGERS, agent.finger_links, strict=True)) | {"palm": [agent.palm]}
        pairs = [(part, other) for part in parts for other in ("object", "world")] + [("object", "world")]
        located = [(part, "object") for part in parts] if points else []
        groups = parts | {"object": [target], "world": list(world)}
        self._contacts = ContactMonitor(scene, groups, pairs, located, every_step)
        self._points = points
        classes = [CONTACT_CLASSES.index(name) if name in CONTACT_CLASSES else 0 for name in groups]
        self._classes = torch.tensor([0, *classes], device=scene.device)  # the first for an empty row
        self._arm_index = torch.tensor(agent.arm_index, device=scene.device)
        self._hand_index = torch.tensor(agent.hand_index, device=scene.device)

    def contacts(self) -> Contacts:
        """Contacts among the fingers, the palm, the object and the world, in this order: of the last physics step, or
        of all steps since the last call."""
        return self._contacts.take()

    def points(self) -> tuple[Float[Tensor, "n m 3"], Int[Tensor, "n m"]]:
        """Contact points of the hand on the object in the last physics step, object frame [m], and what touches
        there: a place in `CONTACT_CLASSES`, 0 in empty rows."""
        world, group = self._contacts.points(self._points)
        pose = self._poses.poses()[:, -1:].expand(-1, self._points, 7)
        local = quaternion_apply(quaternion_inverse(pose[..., 3:]), world - pose[..., :3])
        return torch.where((group >= 0)[..., None], local, 0.0), self._classes[group + 1]

    def snapshot(
        self,
        machine: StageMachine,
        guide: Guide,
        episode: Episode,
        object_half: Float[Tensor, "n 3"],
        time: Float[Tensor, " n"],
    ) -> Snapshot:
        """The state now.

        Args:
            machine: stages of the task.
            guide: candidates, phase and correction.
            episode: what the episode remembers, its contacts being up to date.
            object_half: half extents of the object [m].
            time: share of the episode that is over.
        """
        pose, velocity = self._poses.poses(), self._velocities.velocities()
        p, q, v, w = pose[..., :3], pose[..., 3:], velocity[..., :3], velocity[..., 3:]
        qpos, qvel = self._agent.robot.get_qpos(), self._agent.robot.get_qvel()
        tip_p, tip_q = self._agent.tips_of(p[:, TIPS], q[:, TIPS])
        hand_q, e, chosen = qpos[:, self._hand_index], episode, guide.choice.buffers
        near_p, near_q, approach = guide.choice.goals(p[:, -1], q[:, -1])
        return Snapshot(
            arm_q=qpos[:, self._arm_index], hand_q=hand_q, hand_v=qvel[:, self._hand_index],
            hand_target=self._hand_target(hand_q),
            wrist_p=p[:, 0], wrist_q=q[:, 0], wrist_v=v[:, 0], wrist_w=w[:, 0], tip_p=tip_p, tip_q=tip_q,
            object_p=p[:, -1], object_q=q[:, -1], object_v=v[:, -1], object_w=w[:, -1],
            object_half=object_half, start_p=e.start_p.clone(),
            touch=e.touch > 0, force=e.force.clone(), supported=e.supported > 0,
            penetration=e.penetration.clone(), max_penetration=e.max_penetration.clone(),
            stage=machine.index.clone(), time=time,
            action=e.action.clone(), previous_action=e.previous_action.clone(),
            goal_p=near_p[:, 0], goal_q=near_q[:, 0], goal_approach=approach, near_p=near_p, near_q=near_q,
            goal_pregrasp=chosen["pregrasp"].clone(), goal_grasp=chosen["grasp"].clone(),
            phase=guide.reference.one_hot(), correction=guide.correction.value.clone(),
            contact_p=e.contact_p.clone(), contact_finger=e.contact_finger.long(),
        )  # fmt: skip

    def _hand_target(self, measured: Tensor) -> Tensor:
        """Commanded hand joints; the measured ones before the first command and in other control modes."""
        if not self._agent.commands_wrist:
            return measured
        controller = self._agent.wrist_controller
        return controller.target[:, controller.arm_size :] if len(controller.target) else measured
