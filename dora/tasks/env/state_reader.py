"""The only place where a task reads the simulator: bodies, joints and contacts, into memory and snapshot."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from torch import Tensor

from dora.geometry.rotations import quaternion_apply, quaternion_inverse
from dora.sim.bodies import BodyReader
from dora.sim.contacts import ContactMonitor, Contacts
from dora.sim.overlap import OverlapMonitor
from dora.sim.robot_agent import DescribedRobot
from dora.tasks.guidance.guide import Guide
from dora.tasks.mdp.memory import EpisodeMemory
from dora.tasks.mdp.snapshot import CONTACT_CLASSES, GoalState, HandState, ObjectState, Snapshot
from dora.tasks.mdp.stages import Stages

WORLD = "world"
"""Name of the group of everything else that hands and objects may touch."""


class StateReader:
    """Reads the robots and the objects of a built scene; make a new one after a reconfiguration.

    Args:
        scene: the scene of all environments.
        agents: the robot of each arm.
        objects: by their names.
        handles: name of the object that each arm handles.
        world: what objects and hands may touch besides each other.
        points: contact points of each hand with its object that are wanted; 0 if nobody asks for them.
        every_step: collect contacts from all physics steps of a control step, not from the last one only.

    Attributes:
        overlap: of robots and objects with each other and with the world, in every physics step.
        pairs: names of the two groups of every pair whose contacts are read.
        contacts: those of the last control step, and None before; `contact_names` are its groups.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        agents: Mapping[str, DescribedRobot],
        objects: Mapping[str, Actor | Link],
        handles: Mapping[str, str],
        world: Sequence[Actor | Link],
        points: int = 0,
        every_step: bool = False,
    ):
        self._agents, self._handles, self._names = dict(agents), dict(handles), tuple(objects)
        self._joints = {
            arm: tuple(torch.tensor(index, device=scene.device) for index in (agent.arm_index, agent.hand_index))
            for arm, agent in agents.items()
        }
        hands = [body for agent in agents.values() for body in (agent.wrist, *agent.distals)]
        self._poses = BodyReader(scene, [*hands, *objects.values()])
        self._velocities = BodyReader(scene, [*(agent.wrist for agent in agents.values()), *objects.values()])
        parts = {arm: _parts(arm, agent) for arm, agent in agents.items()}
        groups = {name: members for part in parts.values() for name, members in part.items()}
        self._part_count = len(groups)
        others = [*objects, WORLD]
        pairs = [(part, other) for part in groups for other in others] + [(name, WORLD) for name in objects]
        located = [(part, handles[arm]) for arm in agents for part in parts[arm]] if points else []
        groups |= {name: [body] for name, body in objects.items()} | {WORLD: list(world)}
        self._contacts = ContactMonitor(scene, groups, pairs, located, every_step)
        self.pairs, self.contact_names = tuple(pairs), self._contacts.names
        self.contacts: Contacts | None = None
        links = [link for agent in agents.values() for link in agent.robot.links]
        self.overlap = OverlapMonitor(scene, [*links, *objects.values()])
        self.points = points * len(agents)
        """Rows of contact points of each hand: those of the other hands are empty."""
        self._rows = {arm: [list(groups).index(part) for part in parts[arm]] for arm in agents}
        classes = [name.rpartition(".")[2] for name in groups]
        known = [CONTACT_CLASSES.index(name) if name in CONTACT_CLASSES else 0 for name in classes]
        self._classes = torch.tensor([0, *known], device=scene.device)  # the first for an empty row

    def keep_points(self) -> None:
        """From now on `contacts` says where groups touch, for those who draw it."""
        self._contacts.keep_points()

    def record(self, memory: EpisodeMemory, frequency: float | int) -> None:
        """Writes contacts and overlap of the last control step into the memory.

        Args:
            memory: of the episode.
            frequency: 1 / the time over which impulses were collected [Hz]: a physics step, or all of a control step.
        """
        self.contacts = contacts = self._contacts.take()
        count = self._part_count
        memory.record_penetration(self.overlap.take())
        for arm, rows in self._rows.items():
            column = count + self._names.index(self._handles[arm])
            force = contacts.impulse[:, rows[0] : rows[-1] + 1, column].norm(dim=-1) * frequency
            memory.hands[arm].update(force=force, touch=force > 0)
        for k, name in enumerate(self._names):
            memory.objects[name].update(supported=contacts.impulse[:, count + k, -1].square().sum(-1) > 0)
        if self.points:
            self._record_points(memory)

    def _record_points(self, memory: EpisodeMemory) -> None:
        """Contact points of each hand with its object in the last physics step, in the object's frame."""
        world, group = self._contacts.points(self.points)
        poses = self._poses.poses()[:, -len(self._names) :]
        for arm, rows in self._rows.items():
            pose = poses[:, self._names.index(self._handles[arm]), None].expand(-1, self.points, 7)
            local = quaternion_apply(quaternion_inverse(pose[..., 3:]), world - pose[..., :3])
            mine = (group >= rows[0]) & (group <= rows[-1])
            memory.hands[arm].update(
                contact_p=torch.where(mine[..., None], local, 0.0),
                contact_finger=torch.where(mine, self._classes[group + 1], 0),
            )

    def snapshot(
        self,
        machine: Stages,
        guides: Mapping[str, Guide],
        memory: EpisodeMemory,
        halves: Mapping[str, Float[Tensor, "n 3"]],
        time: Float[Tensor, " n"],
    ) -> Snapshot:
        """The state now.

        Args:
            machine: stages of the task.
            guides: candidates, phase and residual of each arm.
            memory: what the episode remembers, its contacts being up to date.
            halves: half extents of each object [m].
            time: share of the episode that is over.
        """
        pose, velocity = self._poses.poses(), self._velocities.velocities()
        objects, hands, goals, body, wrist = {}, {}, {}, 0, 0
        first, arms = pose.shape[1] - len(self._names), len(self._agents)
        for k, name in enumerate(self._names):
            m = memory.objects[name]
            objects[name] = ObjectState(
                p=pose[:, first + k, :3], q=pose[:, first + k, 3:], v=velocity[:, arms + k, :3],
                w=velocity[:, arms + k, 3:], half=halves[name], start_p=m.start_p.clone(), supported=m.supported > 0,
            )  # fmt: skip
        for arm, agent in self._agents.items():
            last = body + 1 + len(agent.distals)
            hands[arm] = self._hand(agent, memory, arm, pose[:, body:last], velocity[:, wrist])
            goals[arm] = _goal(guides[arm], objects[self._handles[arm]])
            body, wrist = last, wrist + 1
        e = memory.episode
        return Snapshot(
            hands=hands, objects=objects, goals=goals, handles=self._handles,
            penetration=e.penetration.clone(), max_penetration=e.max_penetration.clone(),
            stage=machine.index.clone(), stages=machine.by_arm(), time=time,
            action=e.action.clone(), previous_action=e.previous_action.clone(),
        )  # fmt: skip

    def _hand(
        self, agent: DescribedRobot, memory: EpisodeMemory, arm: str, pose: Tensor, velocity: Tensor
    ) -> HandState:
        """One hand from poses of wrist and distal links (n, 1 + fingers, 7), and the wrist's velocity (n, 6)."""
        qpos, qvel, m = agent.robot.get_qpos(), agent.robot.get_qvel(), memory.hands[arm]
        tip_p, tip_q = agent.tips_of(pose[:, 1:, :3], pose[:, 1:, 3:])
        arm_index, hand_index = self._joints[arm]
        hand_q = qpos[:, hand_index]
        return HandState(
            arm_q=qpos[:, arm_index], q=hand_q, v=qvel[:, hand_index], target=_hand_target(agent, hand_q),
            wrist_p=pose[:, 0, :3], wrist_q=pose[:, 0, 3:], wrist_v=velocity[:, :3], wrist_w=velocity[:, 3:],
            tip_p=tip_p, tip_q=tip_q, tip_radius=agent.description.tip_radius,
            touch=m.touch > 0, force=m.force.clone(),
            contact_p=m.contact_p.clone(), contact_finger=m.contact_finger.long(),
        )  # fmt: skip


def _goal(guide: Guide, body: ObjectState) -> GoalState:
    """What the candidates of one arm ask for at the object's pose."""
    nearest_p, nearest_q, approach = guide.choice.goals(body.p, body.q)
    chosen = guide.choice.buffers
    return GoalState(
        p=nearest_p[:, 0], q=nearest_q[:, 0], approach=approach, nearest_p=nearest_p, nearest_q=nearest_q,
        pregrasp=chosen.pregrasp.clone(), grasp=chosen.grasp.clone(),
        phase=guide.reference.one_hot(), residual=guide.residual.buffers.residual.clone(),
    )  # fmt: skip


def _parts(arm: str, agent: DescribedRobot) -> dict[str, list[Link]]:
    """Groups of one hand whose contacts are told apart: the fingers, then the palm, as `<arm>.<part>`."""
    fingers = zip(agent.description.fingers, agent.finger_links, strict=True)
    return {f"{arm}.{name}": links for name, links in fingers} | {f"{arm}.palm": [agent.palm]}


def _hand_target(agent: DescribedRobot, measured: Tensor) -> Tensor:
    """Commanded hand joints; the measured ones before the first command and in control modes of joints."""
    if not agent.commands_wrist:
        return measured
    controller = agent.wrist_controller
    return controller.target[:, controller.arm_size :] if len(controller.target) else measured
