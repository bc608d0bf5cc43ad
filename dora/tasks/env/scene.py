"""The scene of a task: table, objects with their properties, robots with their guides, and the reader of all that."""

import gc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Actor, Link
from mani_skill.utils.structs.types import DefaultMaterialsConfig, SceneConfig, SimConfig
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.feasibility_table import ReachTable
from dora.errors import InputError
from dora.robot import RobotDescription
from dora.sim.actors import build_object
from dora.sim.properties import ObjectProperties
from dora.sim.robot_agent import DescribedRobot
from dora.tasks.env.arm import Arm
from dora.tasks.env.arm_group import ArmGroup
from dora.tasks.env.perturbations import Perturbations
from dora.tasks.env.state_reader import StateReader
from dora.tasks.env.table import TableTop, add_table
from dora.tasks.env.task import Task
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.guidance.guide import Guide
from dora.tasks.guidance.residual_action import ResidualAction
from dora.tasks.mdp.config import TaskConfig
from dora.tasks.mdp.guidance_parts import REGION
from dora.tasks.mdp.history import History
from dora.tasks.mdp.memory import EpisodeMemory, HandSizes
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stages


class TaskScene:
    """What a task's scene consists of, in all environments; made anew at a reconfiguration.

    Args:
        scene: the ManiSkill scene that is being built.
        num_envs: n.
        config: numbers of the task.
        scale: (n, objects) sizes of the objects relative to their nominal ones.
        table: its top.

    Attributes:
        table: the table, whose upper face is z = 0.
        objects, arms: by name; an object is an actor, or a link of what it is mounted on.
        robots: descriptions of the arms' robots by name, before `Task.make_reference` is asked.
        halves: half extents of each object's bounding box (n, 3) [m].
        reader: reads the simulator.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        num_envs: int,
        config: TaskConfig,
        scale: Float[Tensor, "n objects"],
        table: TableTop,
    ):
        self.scene, self.num_envs, self.config, self.scale = scene, num_envs, config, scale
        self.device = torch.device(scene.device)
        self.table = add_table(scene, table)
        self.objects: dict[str, Any] = {}
        self.halves: dict[str, Float[Tensor, "n 3"]] = {}
        self._properties: dict[str, ObjectProperties] = {}
        self.robots: dict[str, RobotDescription] = {}
        self.arms = ArmGroup()
        self.reader: StateReader

    def build(self, name: str, scale: Float[np.ndarray, " n"], **settings: Any) -> Actor:
        """An object from its folder, in every sub-scene.

        Args:
            name: of the object.
            scale: its size in each environment.
            settings: further arguments of `dora.sim.actors.build_object`.
        """
        offset = self.config.contact_offset
        return build_object(self.scene, load_object(name), scale=scale, contact_offset=offset, **settings)

    def add(self, name: str, actor: Actor | Link) -> None:
        """Takes a built object in: a body of its own, or a link of what it is mounted on."""
        half = torch.as_tensor(load_object(name).mesh.extents / 2, dtype=torch.float32, device=self.device)
        column = self.scale[:, len(self.objects)]
        self.objects[name], self.halves[name] = actor, half * column[:, None]
        self._properties[name] = ObjectProperties(actor)

    @property
    def object(self) -> Any:
        """The only object; ValueError if there are several."""
        (only,) = self.objects.values()
        return only

    @property
    def half(self) -> Float[Tensor, "n 3"]:
        """Half extents of the only object [m]; ValueError if there are several."""
        (only,) = self.halves.values()
        return only

    def make_arms(
        self,
        task: Task,
        agents: Sequence[DescribedRobot],
        parts: frozenset[str],
        grasps: Mapping[str, GraspCandidates],
        tables: dict[str, ReachTable],
    ) -> None:
        """Makes the arms of a task, each with its guide.

        Args:
            task: says what they are about.
            agents: their robots, in order.
            parts: of guidance in force.
            grasps: candidates in place of the task's own, by arm.
            tables: tables of f_reach that are known already.

        Raises:
            InputError: candidates are of another object or hand than the arm's, or none of them is valid.
        """
        region = REGION in parts or not parts
        self.robots = {name: agent.description for name, agent in zip(task.ARMS, agents, strict=True)}
        for (name, spec), agent in zip(task.ARMS.items(), agents, strict=True):
            given = grasps.get(name)
            adapted = _fitting(task, name, agent, task.candidates(name, region) if given is None else given)
            same = region or given is not None
            starts = None if same else _fitting(task, name, agent, task.candidates(name))
            choice = CandidateChoice(adapted, self.num_envs, self.device)
            size = int(np.prod(agent.single_action_space.shape or ()))
            residual = ResidualAction(self.num_envs, size, self.config.residual, self.device)
            guide = Guide(parts, choice, task.make_reference(self, name), residual)
            self.arms[name] = Arm(name, spec, agent, guide, task.start_grid(name), tables, starts)

    def make_reader(self, task: Task) -> None:
        """Makes the reader, when arms and objects are built."""
        agents = {name: arm.agent for name, arm in self.arms.items()}
        handles = {name: arm.spec.object for name, arm in self.arms.items()}
        points, every_step = task.CONTACT_POINTS, task.CONTACT_EVERY_STEP
        world = task.world(self)
        self.reader = StateReader(self.scene, agents, self.objects, handles, world, points, every_step)

    def make_memory(self, action_size: int) -> EpisodeMemory:
        """Memory of an episode of these arms and objects."""
        parts = {name: 1 + len(arm.agent.description.fingers) for name, arm in self.arms.items()}
        hands = {name: HandSizes(count, self.reader.points) for name, count in parts.items()}
        return EpisodeMemory(self.num_envs, action_size, hands, tuple(self.objects), self.device)

    def make_perturbations(self, action_size: int) -> Perturbations:
        """Noise, delay and pushes of the randomisation for these arms."""
        hands = {name: len(arm.agent.description.hand) for name, arm in self.arms.items()}
        c = self.config
        misplaced = c.misplaced == "object"
        numbers = (c.randomisation, self.num_envs, action_size, hands, c.dt, self.device, c.pose_filter, misplaced)
        return Perturbations(*numbers)

    def make_history(self, entries: Mapping[str, Entry], observed: bool) -> History:
        """The history of these observations, of no step if the state is not `observed` at all."""
        actions = {name: arm.action_size for name, arm in self.arms.items()}
        return History(self.config.history if observed else 0, entries, actions, self.num_envs, self.device)

    def snapshot(self, machine: Stages, memory: EpisodeMemory, time: Float[Tensor, " n"]) -> Snapshot:
        """The state now; arguments as of `StateReader.snapshot`."""
        guides = {name: arm.guide for name, arm in self.arms.items()}
        return self.reader.snapshot(machine, guides, memory, self.halves, time)

    def nominal_masses(self, name: str) -> Float[Tensor, " n"]:
        """Masses of an object as built [kg]."""
        return torch.tensor(self._properties[name].nominal, device=self.device)

    def apply_properties(self, memory: EpisodeMemory, rows: Int[Tensor, " b"]) -> None:
        """Gives the objects of the environments `rows` the mass and friction that the memory holds."""
        for name, m in memory.objects.items():
            self._properties[name].apply(rows.tolist(), m.mass[rows].tolist(), m.friction[rows].tolist())

    def push(self, impulse: Float[Tensor, "n objects 3"]) -> None:
        """Gives objects an impulse [N s] at their centres of mass in the next physics step."""
        actors = list(self.objects.values())
        for row, k in impulse.any(-1).nonzero().tolist():
            body = actors[k]._bodies[row]
            centre = (body.entity_pose * body.cmass_local_pose).p
            body.add_force_at_point(impulse[row, k].cpu().numpy(), centre, "impulse")


def _fitting(task: Task, arm: str, agent: DescribedRobot, grasps: GraspCandidates) -> GraspCandidates:
    """The valid candidates as an arm executes them; refused if they are of another object or hand."""
    what, obj = f"the set of the arm {arm!r}", load_object(task.ARMS[arm].object)
    grasps.check_joints(what, agent.description)
    grasps.check_fits(what, obj, None, stored=False)
    adapted = task.adapted(grasps, arm, agent.description)
    adapted.check_fits(what, obj, agent.description, stored=False)
    if not bool(adapted.valid.any()):
        raise InputError(f"{what} holds no valid grasp: give others (`dora grasps --object {obj.name}` makes some).")
    return adapted.select(adapted.valid)


@contextmanager
def freeing_the_old_scene(env: Any) -> Iterator[None]:
    """A context in which an environment may build its scene anew.

    ManiSkill collects the old scene while the task still holds parts of it. It would stay, and grow: PhysX tells every
    scene of a friction that changes, and only those that are stepped forget it.
    """
    before = id(vars(env).get("scene"))
    try:
        yield
    finally:
        if before != id(None) and id(vars(env).get("scene")) != before:
            gc.collect()


def sim_config(c: TaskConfig) -> SimConfig:
    """ManiSkill's settings of the physics."""
    return SimConfig(
        sim_freq=c.physics_frequency,
        control_freq=c.control_frequency,
        scene_config=SceneConfig(
            contact_offset=c.contact_offset,
            solver_position_iterations=c.solver_iterations,
            solver_velocity_iterations=1,
            sleep_threshold=0.0,
            enable_pcm=c.persistent_contacts,
        ),
        default_materials_config=DefaultMaterialsConfig(static_friction=0.9, dynamic_friction=0.9),
    )


def film_camera(eye: Sequence[float], target: Sequence[float]) -> CameraConfig:
    """The camera of films; eye and target (3,) in the world [m]."""
    pose = sapien_utils.look_at(eye=list(eye), target=list(target))
    return CameraConfig("render_camera", pose, width=640, height=640, fov=0.8, near=0.01, far=10)
