"""Base of every one-arm Dora task: reads the simulator once per control step, then only pure tensor code decides."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, cast

import gymnasium as gym
import numpy as np
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Actor
from mani_skill.utils.structs.types import DefaultMaterialsConfig, SceneConfig, SimConfig
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.errors import InputError
from dora.sim.properties import ObjectProperties
from dora.sim.robot import DescribedRobot
from dora.tasks.episode import Episode
from dora.tasks.guidance import GraspReference, Target, wrist_step
from dora.tasks.judging import JudgedEnv
from dora.tasks.options import check_options
from dora.tasks.reading import SimulatorReader
from dora.tasks.scene import add_table
from dora.tasks.snapshot import Snapshot, advanced

CANDIDATE_DRAWS = 26
"""Random numbers of a candidate's error: 3 position, 3 rotation, 20 joints."""


class DoraEnv(JudgedEnv):
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

    SUPPORTED_ROBOTS: ClassVar[list[str]] = ["diana7_hit"]

    DRAWS: ClassVar[int]
    """How many uniform random numbers one initial state needs, besides the candidate's error."""
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
        pose = sapien_utils.look_at(eye=[1.05, 0.62, 0.48], target=[0.42, 0.02, 0.2])
        return CameraConfig("render_camera", pose, width=640, height=640, fov=0.8, near=0.01, far=10)

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict) -> None:
        self.table = add_table(self.scene)
        self.scale = self._forced_scale if self._forced_scale is not None else self._draw_scale()
        self.target_object = self.load_object(self.scale.cpu().numpy())
        self._reader = SimulatorReader(self.scene, self.agent, self.target_object, self.table)
        self._properties = ObjectProperties(self.target_object)
        self._load_judgement()
        self.reference = GraspReference(self.candidates(), self.num_envs, self.action_size, self.device)
        self.episode = Episode(self.num_envs, self.action_size, self.device)
        self._home = self.agent.posture_wrist("home")

    def _draw_scale(self) -> Tensor:
        """(n,) relative sizes, one draw from each environment's own stream."""
        share = np.asarray(self._batched_episode_rng.uniform(size=(1,))).reshape(-1)
        return torch.tensor(1 + self.preset.size * (2 * share - 1), dtype=torch.float32, device=self.device)

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return int(np.prod(self.agent.single_action_space.shape or ()))

    # ---------------------------------------------------------------- reading

    @property
    def snapshot(self) -> Snapshot:
        """The state after the last control step or reset; read from the simulator at most once."""
        if self._snapshot is None:
            self._snapshot = self._read()
        return self._snapshot

    def _read(self) -> Snapshot:
        time = self._elapsed_steps / self.MAX_STEPS
        return self._reader.snapshot(self.machine, self.reference, self.episode, self.object_half, time)

    # ------------------------------------------------------------------ reset

    def reset(self, seed: int | Sequence[int] | None = None, options: dict | None = None) -> tuple[Any, dict[str, Any]]:
        """As in ManiSkill, but a seeded reset builds the scene anew: PhysX remembers earlier contacts, and would
        not repeat a trajectory bit for bit otherwise. A partial reset (`options["env_idx"]`) takes no seed.

        Raises:
            InputError: if a seed comes together with `env_idx`, since ManiSkill would reseed every environment.
        """
        if seed is not None and options and "env_idx" in options:
            raise InputError("a partial reset (env_idx) cannot take a seed: it would reseed every environment")
        seeds = seed if seed is None or isinstance(seed, int) else list(seed)
        gym.Env.reset(self, seed=seeds[0] if isinstance(seeds, list) else seeds)  # gymnasium's own generator
        self._snapshot = None
        if seed is not None and "reset_to_env_states" not in (options or {}):
            options = {**(options or {}), "reconfigure": True}
        return super().reset(seed=seeds, options=options)

    def _initialize_episode(self, env_idx: Tensor, options: dict) -> None:
        # One draw per environment from its own stream: neither num_envs nor the others' resets change it.
        size = self.DRAWS + 2 + CANDIDATE_DRAWS
        draws = np.asarray(self._batched_episode_rng[env_idx.cpu().numpy()].uniform(size=(size,)))
        u = torch.as_tensor(draws, dtype=torch.float32, device=self.device).reshape(len(env_idx), size)
        place, mass, friction, error = u.split([self.DRAWS, 1, 1, CANDIDATE_DRAWS], -1)
        home = self.agent.description.postures["home"]
        qpos = torch.from_numpy(self.agent.qpos_of(home.arm, home.hand)).to(self.device)
        self.agent.robot.set_qpos(qpos.expand(len(env_idx), -1))
        if self.agent.commands_wrist:
            joints = torch.tensor(np.concatenate([home.arm, home.hand]), dtype=torch.float32, device=self.device)
            self.agent.wrist_controller.begin(env_idx, joints.expand(len(env_idx), -1))
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

    def step(self, action: Any) -> tuple[Any, Tensor, Tensor, Tensor, dict[str, Any]]:
        """One control step with the action (n, a), or (a,) for one environment; None moves no command.

        Returns:
            Observation ((n, o) with `obs_mode="state"`), reward (n,), terminated (n,), truncated (n,) and info.

        Raises:
            InputError: if the action has another shape, or holds NaN or infinity; nothing is moved then.
        """
        return super().step(action)

    def _step_action(self, action: Any) -> Any:
        action = self._checked(action)
        if action is not None:
            self.episode.record_action(action)
        super()._step_action(None if action is None else self._command(action))
        self.episode.record_contacts(self._reader.contacts(), self.PHYSICS_FREQUENCY)
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
        if not (self.guided and self.agent.commands_wrist):
            return action
        target, expand = self.reference.target(self.snapshot), self.agent.wrist_controller.expand_hand
        return self._encode(self.reference.corrected(target, action.clamp(-1, 1), expand))

    def _encode(self, target: Target) -> Tensor:
        """A wrist and hand target as an action of the wrist controller."""
        controller = self.agent.wrist_controller
        from_p, from_q = controller.wrist()
        step = wrist_step(target.wrist_p, target.wrist_q, from_p, from_q, controller.wrist_limits)
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

    # ------------------------------------------------------------------ state

    def get_state_dict(self) -> dict:
        """Simulator, controller and task state; a round trip restores stage and observation."""
        task = self.episode.get_state() | {"elapsed": self._elapsed_steps.clone(), "scale": self.scale.clone()}
        simulation = cast(dict[str, Any], super().get_state_dict())  # annotated as a tensor
        return simulation | {
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
        partial = {} if env_idx is None else {"env_idx": env_idx}
        super().set_state_dict({k: state[k] for k in ("actors", "articulations")}, **partial)
        if "controller" in state and self.agent.commands_wrist:
            self.agent.wrist_controller.restore(state["controller"]["target"], rows)
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
