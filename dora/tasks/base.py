"""Base of every one-arm Dora task: reads the simulator once per control step, then only pure tensor code decides."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Actor
from mani_skill.utils.structs.types import DefaultMaterialsConfig, SceneConfig, SimConfig
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.errors import InputError
from dora.sim.bodies import BodyReader
from dora.sim.contacts import ContactMonitor
from dora.sim.controllers import WristHandController
from dora.sim.properties import ObjectProperties
from dora.sim.robot import DescribedRobot
from dora.tasks.episode import Episode
from dora.tasks.guidance import GraspReference, Target, wrist_step
from dora.tasks.observations import OBSERVATIONS, Entry
from dora.tasks.options import check_options
from dora.tasks.rewards import Terms
from dora.tasks.scene import add_table
from dora.tasks.snapshot import FINGERS, Snapshot, advanced
from dora.tasks.stages import Stage, StageMachine

CANDIDATE_DRAWS = 26
"""Random numbers of a candidate's error: 3 position, 3 rotation, 20 joints."""
MM = 1000.0
"""Millimetres per metre."""


class DoraEnv(BaseEnv):
    """A task is `STAGES`, `TERMS`, `place` (random numbers -> initial state), an object and its candidates.

    Args:
        guidance: "affordance" puts candidates into observation, reward and action; "none" removes exactly that.
        hand_joints: 20 independent hand targets, or 15 with distal joints coupled to medial ones.
        preset: how much episodes are randomised, see `dora.tasks.presets`.
        robot_uids: name of a folder in `robots/`.
        sim_backend: as in ManiSkill; "auto" on a machine without CUDA is "physx_cpu", or "physx_cpu_batch" for
            num_envs > 1.
        kwargs: everything else that `BaseEnv` takes.

    Raises:
        InputError: for an unknown guidance, hand, preset, robot or control mode, or num_envs < 1.
    """

    SUPPORTED_REWARD_MODES = ("dense", "normalized_dense", "sparse", "none", "paper")
    SUPPORTED_ROBOTS: ClassVar[list[str]] = ["diana7_hit"]

    STAGES: ClassVar[Sequence[Stage[Snapshot]]]
    """The sub-tasks, in order."""
    TERMS: ClassVar[Terms[Snapshot]]
    """The reward's terms."""
    PAPER_TERMS: ClassVar[Terms[Snapshot]]
    """The printed reward, corrected (`reward_mode="paper"`)."""
    EXTRA_OBSERVATIONS: ClassVar[Mapping[str, Entry]] = {}
    """Observation entries beyond `OBSERVATIONS`."""
    DRAWS: ClassVar[int]
    """How many uniform random numbers one initial state needs, besides the candidate's error."""
    MAX_STEPS: ClassVar[int]
    """Episode limit [control steps]."""
    DEEPEST: ClassVar[float] = 0.005
    """Penetration that spoils an episode [m]."""
    CONTROL_FREQUENCY: ClassVar[int] = 20
    """Control steps per second [Hz]."""
    PHYSICS_FREQUENCY: ClassVar[int] = 100
    """Physics steps per second [Hz]."""
    SOLVER_ITERATIONS: ClassVar[int] = 6
    """PhysX position iterations."""
    CONTACT_OFFSET: ClassVar[float] = 0.005
    """Distance at which PhysX begins to see a contact of a body without its own setting [m]."""

    agent: DescribedRobot
    target_object: Actor
    object_half: Tensor

    @abstractmethod
    def candidates(self) -> GraspCandidates:
        """Grasps of the task's object."""

    @abstractmethod
    def load_object(self, scale: np.ndarray) -> Actor:
        """Builds the object into every sub-scene, `scale` (n,) times its size; sets `object_half` (n, 3) [m]."""

    @abstractmethod
    def place(self, env_idx: Tensor, u: Tensor) -> None:
        """Puts the object of the environments `env_idx` (b,) where `u` (b, DRAWS) in [0, 1) says."""

    def __init__(
        self,
        *args: Any,
        guidance: str = "affordance",
        hand_joints: int = 20,
        preset: str = "standard",
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
            guidance, hand_joints, preset, robot_uids, num_envs, control_mode,
            sim_backend, render_backend, render_mode, obs_mode,
        )  # fmt: skip
        self.guided, self.preset = options.guided, options.preset
        self._snapshot: Snapshot | None = None
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
        pose = sapien_utils.look_at(eye=[1.15, -0.75, 0.65], target=[0.45, 0.0, 0.22])
        return CameraConfig("render_camera", pose, width=640, height=640, fov=0.8, near=0.01, far=10)

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict) -> None:
        self.table = add_table(self.scene)
        self.scale = self._forced_scale if self._forced_scale is not None else self._draw_scale()
        self.target_object = self.load_object(self.scale.cpu().numpy())
        agent, device, n = self.agent, self.device, self.num_envs
        self.machine = StageMachine(self.STAGES, n, device)
        self.reference = GraspReference(self.candidates(), n, self.action_size, device)
        self.episode = Episode(n, self.action_size, device)
        self._terms = self.PAPER_TERMS if self._reward_mode == "paper" else self.TERMS
        if not self.guided:
            self._terms = self._terms.without_guidance()
        entries = {**OBSERVATIONS, **self.EXTRA_OBSERVATIONS}
        self.observation_entries = {k: e for k, e in entries.items() if self.guided or not e.guided}
        self._poses = BodyReader(self.scene, [agent.wrist, *agent.distals, self.target_object])
        self._velocities = BodyReader(self.scene, [agent.wrist, self.target_object])
        groups = dict(zip(FINGERS, agent.finger_links, strict=True)) | {"palm": [agent.palm]}
        pairs = [(part, other) for part in groups for other in ("object", "world")] + [("object", "world")]
        groups |= {"object": [self.target_object], "world": [self.table]}
        self._contacts = ContactMonitor(self.scene, groups, pairs)
        self._properties = ObjectProperties(self.target_object)
        self._hand_index = torch.tensor(agent.hand_index, device=device)
        self._arm_index = torch.tensor(agent.arm_index, device=device)
        self._home = agent.posture_wrist("home")

    def _draw_scale(self) -> Tensor:
        """(n,) relative sizes, one draw from each environment's own stream."""
        share = np.asarray(self._batched_episode_rng.uniform(size=(1,))).reshape(-1)
        return torch.tensor(1 + self.preset.size * (2 * share - 1), dtype=torch.float32, device=self.device)

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return int(np.prod(self.agent.single_action_space.shape))

    # ------------------------------------------------ the protocol of learners

    @property
    def max_steps(self) -> int:
        """Episode limit [control steps]."""
        return self.MAX_STEPS

    @property
    def stage_names(self) -> tuple[str, ...]:
        """Names of the stages, in order."""
        return tuple(stage.name for stage in self.STAGES)

    @property
    def logged(self) -> tuple[str, ...]:
        """Names of the (n,) tensors in `step`'s info that are worth a curve."""
        stages = [f"stage/{name}" for name in self.stage_names]
        return (*(f"reward/{name}" for name in self._terms.terms), *stages, "penetration_mm", "finished")

    # ---------------------------------------------------------------- reading

    @property
    def snapshot(self) -> Snapshot:
        """The state after the last control step or reset; read from the simulator at most once."""
        if self._snapshot is None:
            self._snapshot = self._read()
        return self._snapshot

    def _read(self) -> Snapshot:
        pose, velocity = self._poses.poses(), self._velocities.velocities()
        p, q, v, w = pose[..., :3], pose[..., 3:], velocity[..., :3], velocity[..., 3:]
        qpos, qvel = self.agent.robot.get_qpos(), self.agent.robot.get_qvel()
        tip_p, tip_q = self.agent.tips_of(p[:, 1:6], q[:, 1:6])
        e, r, hand_q = self.episode, self.reference, qpos[:, self._hand_index]
        goal_p, goal_q = r.goal(p[:, 6], q[:, 6])
        controller = self.agent.controller
        commanded = isinstance(controller, WristHandController) and len(controller.target)
        return Snapshot(
            arm_q=qpos[:, self._arm_index], hand_q=hand_q, hand_v=qvel[:, self._hand_index],
            hand_target=controller.target[:, controller.arm_size :] if commanded else hand_q,
            wrist_p=p[:, 0], wrist_q=q[:, 0], wrist_v=v[:, 0], wrist_w=w[:, 0], tip_p=tip_p, tip_q=tip_q,
            object_p=p[:, 6], object_q=q[:, 6], object_v=v[:, 1], object_w=w[:, 1],
            object_half=self.object_half, start_p=e.start_p.clone(),
            touch=e.touch > 0, force=e.force.clone(), supported=e.supported > 0,
            penetration=e.penetration.clone(), deepest=e.deepest.clone(),
            stage=self.machine.index.clone(), time=self._elapsed_steps / self.MAX_STEPS,
            action=e.action.clone(), previous_action=e.previous_action.clone(),
            goal_p=goal_p, goal_q=goal_q,
            goal_pregrasp=r.buffers["pregrasp"].clone(), goal_grasp=r.buffers["grasp"].clone(),
            phase=r.phase.index.clone(), correction=r.buffers["correction"].clone(),
        )  # fmt: skip

    # ------------------------------------------------------------------ reset

    def reset(self, seed: Any = None, options: dict | None = None) -> tuple[Any, dict]:
        """As in ManiSkill, but a seeded reset builds the scene anew: PhysX remembers earlier contacts, and would
        not repeat a trajectory bit for bit otherwise. A partial reset (`options["env_idx"]`) takes no seed.

        Raises:
            InputError: if a seed comes together with `env_idx`, since ManiSkill would reseed every environment.
        """
        if seed is not None and options and "env_idx" in options:
            raise InputError("a partial reset (env_idx) cannot take a seed: it would reseed every environment")
        gym.Env.reset(self, seed=seed[0] if isinstance(seed, list | tuple) else seed)  # gymnasium's own generator
        self._snapshot = None
        if seed is not None and "reset_to_env_states" not in (options or {}):
            options = {**(options or {}), "reconfigure": True}
        return super().reset(seed=seed, options=options)

    def _initialize_episode(self, env_idx: Tensor, options: dict) -> None:
        # One draw per environment from its own stream: neither num_envs nor the others' resets change it.
        size = self.DRAWS + 2 + CANDIDATE_DRAWS
        draws = np.asarray(self._batched_episode_rng[env_idx.cpu().numpy()].uniform(size=(size,)))
        u = torch.as_tensor(draws, dtype=torch.float32, device=self.device).reshape(len(env_idx), size)
        place, mass, friction, error = u.split([self.DRAWS, 1, 1, CANDIDATE_DRAWS], -1)
        home = self.agent.description.postures["home"]
        qpos = torch.from_numpy(self.agent.qpos_of(home.arm, home.hand)).to(self.device)
        self.agent.robot.set_qpos(qpos.expand(len(env_idx), -1))
        if isinstance(self.agent.controller, WristHandController):
            joints = torch.tensor(np.concatenate([home.arm, home.hand]), dtype=torch.float32, device=self.device)
            self.agent.controller.begin(env_idx, joints.expand(len(env_idx), -1))
        self.place(env_idx, place)
        pose, e, rows = self.target_object.pose, self.episode, len(env_idx)
        e.begin(env_idx, pose.p[env_idx])
        low, high = self.preset.friction
        nominal = torch.tensor(self._properties.nominal, device=self.device)[env_idx]
        e.mass[env_idx] = nominal * (1 + self.preset.mass * (2 * mass[:, 0] - 1))
        e.friction[env_idx] = low + (high - low) * friction[:, 0]
        self._apply_properties(env_idx)
        self.machine.reset(env_idx)
        wrist_p, wrist_q = self._home
        self.reference.choose(
            env_idx, pose.p[env_idx], pose.q[env_idx],
            wrist_p.expand(rows, 3), wrist_q.expand(rows, 4), 2 * error - 1, self.preset,
        )  # fmt: skip

    def _apply_properties(self, env_idx: Tensor) -> None:
        e = self.episode
        self._properties.apply(env_idx.tolist(), e.mass[env_idx].tolist(), e.friction[env_idx].tolist())

    # ------------------------------------------------------------------- step

    def _step_action(self, action: Any) -> Any:
        action = self._checked(action)
        if action is not None:
            self.episode.record_action(action)
        super()._step_action(None if action is None else self._command(action))
        self.episode.record_contacts(self._contacts.read(), self.PHYSICS_FREQUENCY)
        s = self._read()
        self.machine.advance(s)
        self.reference.advance(s)
        self._snapshot = advanced(
            s,
            stage=self.machine.index.clone(),
            phase=self.reference.phase.index.clone(),
            time=(self._elapsed_steps + 1) / self.MAX_STEPS,  # ManiSkill counts the step after this method
        )
        return action

    def _checked(self, action: Any) -> Tensor | None:
        """The action as an (n, a) tensor; InputError for a wrong shape or a value that is not finite."""
        if action is None:
            return None
        out = torch.as_tensor(action, dtype=torch.float32, device=self.device)
        shape = (self.num_envs, self.action_size)
        if self.num_envs == 1 and out.shape == shape[1:]:
            out = out[None]
        if out.shape != shape:
            raise InputError(f"the action has the shape {tuple(out.shape)}; this environment needs {shape}")
        if not torch.isfinite(out).all():
            raise InputError("the action holds NaN or infinity; nothing was moved")
        return out

    def _command(self, action: Tensor) -> Tensor:
        """What the controller is asked: the action itself, or the corrected reference if guided."""
        controller = self.agent.controller
        if not (self.guided and isinstance(controller, WristHandController)):
            return action
        target = self.reference.target(self.snapshot)
        return self._encode(self.reference.corrected(target, action.clamp(-1, 1), controller.expand_hand))

    def _encode(self, target: Target) -> Tensor:
        """A wrist and hand target as an action of the wrist controller."""
        controller = self.agent.controller
        step = wrist_step(target.wrist_p, target.wrist_q, *controller.wrist(), controller.wrist_limits)
        return torch.cat([step, controller.hand_action(target.hand)], -1)

    def scripted_action(self) -> Tensor:
        """(n, a) action that executes the chosen candidate from the present state: the scripted solution.

        With guidance that is zero correction; without, the reference's target as a plain action of the default
        controller.
        """
        if self.guided:
            return torch.zeros(self.num_envs, self.action_size, device=self.device)
        target = self.reference.target(self.snapshot)
        self.reference.aim(target)
        return self._encode(target)

    # ---------------------------------------------------- evaluation, reward

    @property
    def spoiled(self) -> Tensor:
        """(n,) bool: the episode's deepest penetration is above the task's limit."""
        return self.episode.deepest > self.DEEPEST

    def evaluate(self) -> dict[str, Tensor]:
        """Idempotent: reset and wrappers call it too, so it moves nothing."""
        finished = self.machine.finished
        info = {
            "success": finished & ~self.spoiled,
            "fail": self.failed(self.snapshot),
            "finished": finished,
            "stage": self.machine.index.clone(),
            "penetration_mm": self.episode.penetration * MM,
            "penetration_max_mm": self.episode.deepest * MM,
        }
        for k, stage in enumerate(self.machine.stages):
            info[f"stage/{stage.name}"] = self.machine.furthest > k
        return info

    def failed(self, s: Snapshot) -> Tensor:
        """(n,) bool: the object has left the table or the robot's reach; nothing can mend the episode."""
        away = (s.object_p[:, :2] - s.start_p[:, :2]).norm(dim=-1)
        return (s.object_p[:, 2] < -0.05) | (away > 0.6)

    def compute_dense_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """Sum of the terms (n,); each one's share goes into `info["reward/<name>"]`."""
        total, parts = self._terms(self.snapshot)
        info.update({f"reward/{name}": value for name, value in parts.items()})
        return total

    def compute_normalized_dense_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """The dense reward over its largest possible value."""
        return self.compute_dense_reward(obs, action, info) / self._terms.upper

    def get_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """(n,) reward of the chosen mode; "paper" sums the printed terms."""
        if self._reward_mode == "paper":
            return self.compute_dense_reward(obs, action, info)
        return super().get_reward(obs, action, info)

    # ----------------------------------------------------------- observation

    def _get_obs_agent(self) -> dict[str, Tensor]:
        return {}

    def _get_obs_extra(self, info: dict) -> dict[str, Tensor]:
        s = self.snapshot
        return {name: entry.value(s) for name, entry in self.observation_entries.items()}

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if self._obs_mode == "state":
            return torch.cat(list(obs["extra"].values()), -1)
        return super()._flatten_raw_obs(obs)

    # ------------------------------------------------------------------ state

    def get_state_dict(self) -> dict:
        """Simulator, controller and task state; a round trip restores stage and observation."""
        task = self.episode.get_state() | {"elapsed": self._elapsed_steps.clone(), "scale": self.scale.clone()}
        return super().get_state_dict() | {
            "task": task,
            "machine": self.machine.get_state(),
            "reference": self.reference.get_state(),
        }

    def set_state_dict(self, state: dict, env_idx: Tensor | None = None) -> None:
        """Inverse of `get_state_dict`; with `env_idx` (b,) the state has b rows.

        Where the state's objects have another size, the scene is built anew with those sizes.
        """
        rows = torch.arange(self.num_envs, device=self.device) if env_idx is None else env_idx
        if "task" in state:
            self._rebuild(state["task"]["scale"].reshape(-1), rows)
        super().set_state_dict({k: state[k] for k in ("actors", "articulations")}, env_idx)
        controller = self.agent.controller
        if "controller" in state and isinstance(controller, WristHandController):
            controller.restore(state["controller"]["target"], rows)
        if "task" in state:
            self.episode.set_state(state["task"], rows)
            self._elapsed_steps[rows] = state["task"]["elapsed"].reshape(-1).to(self._elapsed_steps.dtype)
            self.machine.set_state(state["machine"], rows)
            self.reference.set_state(state["reference"], rows)
            self._apply_properties(rows)
        self._snapshot = None

    def _rebuild(self, scale: Tensor, rows: Tensor) -> None:
        """Gives the objects of the environments `rows` the sizes `scale` (b,), keeping everybody's state."""
        if torch.equal(self.scale[rows], scale):
            return
        keep = self.get_state_dict()
        keep["task"]["scale"][rows] = scale
        self._forced_scale = keep["task"]["scale"]
        super().reset(options={"reconfigure": True})
        self._forced_scale = None
        self.set_state_dict(keep)
