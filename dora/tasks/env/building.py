"""The part of a task that is built: options, scene, candidates."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Actor, Link
from mani_skill.utils.structs.types import DefaultMaterialsConfig, SceneConfig, SimConfig
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.feasibility import Reach
from dora.affordance.reach.feasibility_table import Grid, ReachTable
from dora.sim.properties import ObjectProperties
from dora.sim.robot_agent import DescribedRobot
from dora.tasks.env.episode_memory import Episode
from dora.tasks.env.judging import JudgedEnv
from dora.tasks.env.options import check_options
from dora.tasks.env.perturbations import Perturbations
from dora.tasks.env.state_reader import SimulatorReader
from dora.tasks.env.table import add_table
from dora.tasks.guidance.candidate_choice import Choice
from dora.tasks.guidance.grasp_and_lift import GraspReference, Guide
from dora.tasks.guidance.reference import Reference
from dora.tasks.guidance.residual_action import Bounds, ResidualAction
from dora.tasks.mdp.guidance_parts import PRIOR

SCALE_DRAW = 256
"""Which number of an environment's stream is its size: episodes begin with the same numbers, and use fewer."""


class BuiltEnv(JudgedEnv):
    """A task's options and scene: robot, table, object, candidates, and the readers of all that.

    Args:
        guidance: "affordance" puts candidates into observation, reward and action; "none" removes exactly that.
        guidance_parts: which parts of guidance="affordance" are in force, among "observation", "reward", "filter"
            and "prior"; all by default.
        hand_joints: 20 independent hand targets, or 15 with distal joints coupled to medial ones.
        preset: how much episodes are randomised, see `dora.tasks.mdp.randomisation`.
        grasps: candidates in place of those that come with Dora, of the task's object and robot.
        robot_uids: name of a folder in `robots/`.
        sim_backend: as in ManiSkill; "auto" on a machine without CUDA is "physx_cpu", or "physx_cpu_batch" for
            num_envs > 1.
        kwargs: everything else that `BaseEnv` takes.

    Raises:
        InputError: for an unknown guidance, hand, preset, robot or control mode, or num_envs < 1.
    """

    SUPPORTED_ROBOTS: ClassVar[list[str]] = ["diana7_hit"]

    CONTROL_FREQUENCY: ClassVar[int] = 20
    """Control steps per second [Hz]."""
    PHYSICS_FREQUENCY: ClassVar[int] = 100
    """Physics steps per second [Hz]."""
    SOLVER_ITERATIONS: ClassVar[int] = 6
    """PhysX position iterations."""
    CONTACT_OFFSET: ClassVar[float] = 0.005
    """Distance at which PhysX begins to see a contact of a body without its own setting [m]."""
    CONTACT_POINTS: ClassVar[int] = 0
    """Contact points of hand and object that the snapshot holds; 0 if the task asks for none."""
    CONTACT_EVERY_STEP: ClassVar[bool] = False
    """Whether contacts are collected from all physics steps of a control step: blows are shorter than that."""
    BOUNDS: ClassVar[Bounds] = Bounds()
    """Largest corrections of the reference."""
    HOME: ClassVar[str] = "home"
    """Name of the robot's posture at the start of an episode."""

    OBJECT: ClassVar[str]
    """Name of the object, as `load_object` knows it."""
    START: ClassVar[Grid | None] = None
    """Where the object may stand at the start, for the table of f_reach; None where it does not stand."""

    narrow: Callable[[Tensor], Tensor] | None = None
    """Takes the (b, c) candidates that b new episodes may use and returns fewer; to try candidates one by one."""
    agent: DescribedRobot
    target_object: Actor
    object_half: Tensor

    @abstractmethod
    def candidates(self) -> GraspCandidates:
        """Grasps of the task's object."""

    def prepared(self, candidates: GraspCandidates) -> GraspCandidates:
        """The same grasps as this task executes them."""
        return candidates

    def make_reference(self) -> Reference:
        """What leads the hand along the chosen candidate; called once per scene."""
        return GraspReference(self.num_envs, self.device)

    def world(self) -> Sequence[Actor | Link]:
        """What the object and the hand may touch besides each other; asked once per scene, after `load_object`."""
        return [self.table]

    @abstractmethod
    def load_object(self, scale: np.ndarray) -> Actor:
        """Builds the object into every sub-scene, `scale` (n,) times its size; sets `object_half` (n, 3) [m]."""

    def __init__(
        self,
        *args: Any,
        guidance: str = "affordance",
        guidance_parts: Sequence[str] | None = None,
        hand_joints: int = 20,
        preset: str = "standard",
        grasps: GraspCandidates | None = None,
        robot_uids: Any = "diana7_hit",
        num_envs: int = 1,
        control_mode: str | None = None,
        sim_backend: str = "auto",
        render_backend: str = "auto",
        render_mode: str | None = None,
        obs_mode: str | None = None,
        **kwargs: Any,
    ):
        options = check_options(
            guidance, guidance_parts, hand_joints, preset, robot_uids, num_envs, control_mode,
            sim_backend, render_backend, render_mode, obs_mode,
        )  # fmt: skip
        self.parts, self.preset, self._grasps = options.parts, options.preset, grasps
        self._shares: dict[str, float] = {}
        self._forced_scale: Tensor | None = None
        super().__init__(
            *args,
            num_envs=num_envs,
            robot_uids=options.robot,
            control_mode=options.control_mode,
            sim_backend=options.sim_backend,
            render_backend=options.render_backend,
            render_mode=render_mode,
            obs_mode=obs_mode,
            **kwargs,
        )

    # ------------------------------------------------------------------ scene

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(
            sim_freq=self.PHYSICS_FREQUENCY,
            control_freq=self.CONTROL_FREQUENCY,
            scene_config=SceneConfig(
                contact_offset=self.CONTACT_OFFSET,
                solver_position_iterations=self.SOLVER_ITERATIONS,
                solver_velocity_iterations=1,
                sleep_threshold=0.0,
            ),
            default_materials_config=DefaultMaterialsConfig(static_friction=0.9, dynamic_friction=0.9),
        )

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at(eye=[1.05, 0.62, 0.48], target=[0.42, 0.02, 0.2])
        return CameraConfig("render_camera", pose, width=640, height=640, fov=0.8, near=0.01, far=10)

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict) -> None:
        self.table = add_table(self.scene)
        self.scale = self._forced_scale if self._forced_scale is not None else self._draw_scale()
        self.target_object = self.load_object(self.scale.cpu().numpy())
        points, size = self.CONTACT_POINTS, (self.num_envs, self.action_size)
        bodies = self.target_object, self.world()
        self._reader = SimulatorReader(self.scene, self.agent, *bodies, points, self.CONTACT_EVERY_STEP)
        self._properties = ObjectProperties(self.target_object)
        self._load_judgement()
        choice = Choice(self.prepared(self._grasps or self.candidates()), self.num_envs, self.device)
        correction = ResidualAction(*size, self.BOUNDS, self.device)
        self.guide = Guide(self.parts, choice, self.make_reference(), correction)
        self.guide.anneal(**self._shares)
        self.perturbations = Perturbations(self.preset, *size, self.CONTROL_FREQUENCY, self.device)
        self.episode = Episode(*size, points, self.device)
        self._home = self.agent.posture_wrist(self.HOME)

    @cached_property
    def reach_table(self) -> ReachTable | None:
        """f_reach of the candidates over the places where the object may stand; built once and cached on disk."""
        if self.START is None:
            return None
        obj = load_object(self.OBJECT)
        reach = Reach(self.agent.description, obj, start=self.HOME)
        candidates = self.guide.choice.candidates.to("cpu")
        return ReachTable.of(reach, candidates, self.START, obj.support, obj.rest).to(self.device)

    def _draw_scale(self) -> Tensor:
        """(n,) relative sizes, one draw from each environment's own stream."""
        share = np.asarray(self._batched_episode_rng.uniform(size=(SCALE_DRAW,)))[..., -1].reshape(-1)
        return torch.tensor(1 + self.preset.size * (2 * share - 1), dtype=torch.float32, device=self.device)

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return int(np.prod(self.agent.single_action_space.shape or ()))

    @property
    def reference(self) -> Reference:
        """What leads the hand."""
        return self.guide.reference

    @property
    def corrects(self) -> bool:
        """Whether actions correct the reference: that part of guidance is in force, and actions command the wrist."""
        return PRIOR in self.parts and self.agent.commands_wrist

    def anneal(self, **shares: float) -> None:
        """Sets shares in [0, 1] for curricula, kept from now on: `bounds` of the correction, `error` of the candidates.

        Raises:
            InputError: for a share outside [0, 1].
        """
        self._shares |= shares
        self.guide.anneal(**shares)
