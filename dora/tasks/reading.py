"""The only place where a task reads the simulator."""

import torch
from jaxtyping import Float
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor
from torch import Tensor

from dora.sim.bodies import BodyReader
from dora.sim.contacts import ContactMonitor, Contacts
from dora.sim.robot import DescribedRobot
from dora.tasks.episode import Episode
from dora.tasks.guidance import GraspReference
from dora.tasks.snapshot import FINGERS, Snapshot
from dora.tasks.stages import StageMachine

TIPS = slice(1, 1 + len(FINGERS))
"""Places of the distal links among the bodies whose poses are read: after the wrist, before the object."""


class SimulatorReader:
    """Reads the robot and the manipulated object of a built scene; make a new one after a reconfiguration.

    Args:
        scene: the scene of all environments.
        agent: the robot.
        target: the manipulated object.
        world: what the object stands on.
    """

    def __init__(self, scene: ManiSkillScene, agent: DescribedRobot, target: Actor, world: Actor):
        self._agent = agent
        self._poses = BodyReader(scene, [agent.wrist, *agent.distals, target])
        self._velocities = BodyReader(scene, [agent.wrist, target])
        parts = dict(zip(FINGERS, agent.finger_links, strict=True)) | {"palm": [agent.palm]}
        pairs = [(part, other) for part in parts for other in ("object", "world")] + [("object", "world")]
        self._contacts = ContactMonitor(scene, parts | {"object": [target], "world": [world]}, pairs)
        self._arm_index = torch.tensor(agent.arm_index, device=scene.device)
        self._hand_index = torch.tensor(agent.hand_index, device=scene.device)

    def contacts(self) -> Contacts:
        """Contacts of the last physics step among the fingers, the palm, the object and the world, in this order."""
        return self._contacts.read()

    def snapshot(
        self,
        machine: StageMachine,
        reference: GraspReference,
        episode: Episode,
        object_half: Float[Tensor, "n 3"],
        time: Float[Tensor, " n"],
    ) -> Snapshot:
        """The state now.

        Args:
            machine: stages of the task.
            reference: candidate, phase and correction.
            episode: what the episode remembers, its contacts being up to date.
            object_half: half extents of the object [m].
            time: share of the episode that is over.
        """
        pose, velocity = self._poses.poses(), self._velocities.velocities()
        p, q, v, w = pose[..., :3], pose[..., 3:], velocity[..., :3], velocity[..., 3:]
        qpos, qvel = self._agent.robot.get_qpos(), self._agent.robot.get_qvel()
        tip_p, tip_q = self._agent.tips_of(p[:, TIPS], q[:, TIPS])
        hand_q, e, r = qpos[:, self._hand_index], episode, reference
        goal_p, goal_q = r.goal(p[:, -1], q[:, -1])
        return Snapshot(
            arm_q=qpos[:, self._arm_index], hand_q=hand_q, hand_v=qvel[:, self._hand_index],
            hand_target=self._hand_target(hand_q),
            wrist_p=p[:, 0], wrist_q=q[:, 0], wrist_v=v[:, 0], wrist_w=w[:, 0], tip_p=tip_p, tip_q=tip_q,
            object_p=p[:, -1], object_q=q[:, -1], object_v=v[:, -1], object_w=w[:, -1],
            object_half=object_half, start_p=e.start_p.clone(),
            touch=e.touch > 0, force=e.force.clone(), supported=e.supported > 0,
            penetration=e.penetration.clone(), deepest=e.deepest.clone(),
            stage=machine.index.clone(), time=time,
            action=e.action.clone(), previous_action=e.previous_action.clone(),
            goal_p=goal_p, goal_q=goal_q,
            goal_pregrasp=r.buffers["pregrasp"].clone(), goal_grasp=r.buffers["grasp"].clone(),
            phase=r.phase.index.clone(), correction=r.buffers["correction"].clone(),
        )  # fmt: skip

    def _hand_target(self, measured: Tensor) -> Tensor:
        """Commanded hand joints; the measured ones before the first command and in other control modes."""
        if not self._agent.commands_wrist:
            return measured
        controller = self._agent.wrist_controller
        return controller.target[:, controller.arm_size :] if len(controller.target) else measured
