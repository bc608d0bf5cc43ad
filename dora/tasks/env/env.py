"""The environment of every Dora task: it has an MDP, a scene, an arm with a guide for each robot, and perturbations.

It reads the simulator once per control step; then only pure functions of that snapshot decide.
"""

from collections.abc import Callable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, cast

import gymnasium as gym
import sapien
from jaxtyping import Bool, Float, Int
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs.types import SimConfig
from torch import Tensor

from dora.affordance.reach.feasibility_table import ReachTable
from dora.sim.batch.actions import checked_action
from dora.sim.batch.hooks import mend, runs_batched
from dora.sim.batch.resets import nothing_reset
from dora.sim.cameras import camera_configs
from dora.tasks.env.arm import Arm
from dora.tasks.env.arm_group import ArmGroup
from dora.tasks.env.description import describe
from dora.tasks.env.episode_start import begin_episodes, drawn_sizes, requested, start_numbers
from dora.tasks.env.options import check_grasps, check_options, task_config
from dora.tasks.env.scene import TaskScene, film_camera, freeing_the_old_scene, sim_config
from dora.tasks.env.state import saved_state, set_rows, unflattened
from dora.tasks.env.task import Task
from dora.tasks.guidance.guide import Guide
from dora.tasks.mdp.guidance_parts import FILTER, PRIOR
from dora.tasks.mdp.observations import joined, observation_table, observed_part
from dora.tasks.mdp.rewards import Terms
from dora.tasks.mdp.snapshot import Snapshot, advanced, corrected
from dora.tasks.mdp.stages import Stages, make_stages


class DoraEnv(BaseEnv):
    """The environment of a task, with one or several arms; one class per registered id, made by `register_task`.

    Args:
        guidance: "affordance" puts candidates and regions into observation, reward and action, "grasps" candidates of a
            search that knows no region, "none" neither; see `dora.tasks.mdp.guidance_parts`.
        guidance_parts: the parts in force, among "observation", "reward", "filter" and "prior"; all by default.
        hand_joints: 20 independent hand targets, or 15 with distal joints coupled to medial ones.
        preset: how much episodes are randomised, see `dora.tasks.mdp.randomisation`.
        config: numbers that differ from the task's own, by name (nested for weights and randomisation), or all of
            them as an instance of the task's `CONFIG`.
        grasps: candidates in place of those that come with Dora, of the task's object and robot; with several arms a
            dictionary by arm.
        robot_uids: name of a folder in `robots/`, or a tuple with one for each arm; the task's own by default.
        sim_backend: as in ManiSkill; "auto" is "physx_cpu", or "physx_cpu_batch" for num_envs > 1, with and without
            CUDA: on a GPU overlap is not known, so that no episode counts as a success.
        kwargs: everything else that `BaseEnv` takes.

    Raises:
        InputError: for an unknown guidance, hand, preset, robot, control mode or name in `config`, or num_envs < 1.
    """

    SUPPORTED_REWARD_MODES = ("dense", "normalized_dense", "sparse", "none", "paper")
    TASK: ClassVar[type[Task]]
    """What the environment is about; set by `register_task`."""
    agent: Any
    """ManiSkill's: a `DescribedRobot`, or a `MultiAgent` of them."""
    task: Any
    """The task that it has, an instance of `TASK`."""
    narrow: Mapping[str, Callable[[Tensor], Tensor]] = MappingProxyType({})
    """By arm: takes the (b, c) candidates that b new episodes may use and returns fewer; to try them one by one."""
    chosen_start: Callable[[Tensor], Tensor] | None = None
    """Takes the random numbers (b, DRAWS) of b new starts and returns those that are used; to choose a start."""
    resetting = False
    """Whether a reset is under way."""
    _snapshot: Snapshot | None = None
    _observed: Snapshot

    def __init__(
        self,
        *args: Any,
        guidance: str = "affordance",
        guidance_parts: Any = None,
        hand_joints: int = 20,
        preset: str = "standard",
        config: Any = None,
        grasps: Any = None,
        robot_uids: Any = None,
        num_envs: int = 1,
        control_mode: str | None = None,
        sim_backend: str = "auto",
        render_backend: str = "auto",
        render_mode: str | None = None,
        obs_mode: str | None = None,
        **kwargs: Any,
    ):
        numbers = task_config(self.TASK.CONFIG, preset, config, kwargs.get("sim_config"))
        options = check_options(
            guidance, guidance_parts, hand_joints, numbers, robot_uids, self.TASK.robots(), num_envs, control_mode,
            sim_backend, render_backend, render_mode, obs_mode,
        )  # fmt: skip
        self._grasps = check_grasps(grasps, tuple(self.TASK.ARMS))
        self.parts, self.config = options.parts, options.config
        self.task, several = self.TASK(self.config), len(options.robots) > 1
        self._shares, self._tables = dict[str, float](), dict[str, ReachTable]()
        self._forced_scale: Tensor | None = None
        super().__init__(
            *args,
            num_envs=num_envs,
            robot_uids=options.robots if several else options.robots[0],  # pyright: ignore[reportArgumentType]
            control_mode=options.control_mode, sim_backend=options.sim_backend, render_backend=options.render_backend,
            render_mode=render_mode, obs_mode=obs_mode, **kwargs,
        )  # fmt: skip
        if several:  # one action for all arms, as learners want it
            self.single_action_space, self.action_space = self.arms.action_spaces(num_envs)

    # ------------------------------------------------------------------- scene

    @property
    def _default_sim_config(self) -> SimConfig:
        return sim_config(self.config)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return camera_configs(self.task.CAMERAS, {a: x.agent.wrist for a, x in self.arms.items()}, self.obs_mode_struct)

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        return film_camera(*self.task.CAMERA)

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        poses: Any = [sapien.Pose(arm.position, arm.quaternion) for arm in self.task.ARMS.values()]
        super()._load_agent(options, poses)
        c, agents = self.config, getattr(self.agent, "agents", [self.agent])
        for controller in [agent.wrist_controller for agent in agents if agent.commands_wrist]:
            controller.limit(c.arm_effort, c.hand_effort, c.wrist_speed, c.hand_speed)
            if self.task.WRIST_MOTION is not None:
                controller.set_motion(*self.task.WRIST_MOTION, feed_forward=True)

    def _load_scene(self, options: dict) -> None:
        task, names = self.task, tuple(dict.fromkeys(arm.object for arm in self.task.ARMS.values()))
        scale = drawn_sizes(self, names) if self._forced_scale is None else self._forced_scale
        scene = self.task_scene = TaskScene(self.scene, self.num_envs, self.config, scale, task.TABLE)
        for k, name in enumerate(names):
            scene.add(name, task.build(scene, name, self.scale[:, k].cpu().numpy()))
        mdp = self.mdp = task.make_mdp(scene)
        self.machine: Stages = make_stages(mdp.stages, self.num_envs, self.config.dt, self.device)
        terms = mdp.paper_terms if self._reward_mode == "paper" else mdp.terms
        self.terms: Terms[Any] = terms.in_force(self.parts)
        self.observation_entries = observation_table(tuple(task.ARMS), mdp.observations, self.parts, self.config)
        scene.make_arms(task, getattr(self.agent, "agents", [self.agent]), self.parts, self._grasps, self._tables)
        self.anneal(**self._shares)
        scene.make_reader(task)
        self.memory = scene.make_memory(self.action_size)
        self.perturbations = scene.make_perturbations(self.action_size)
        self.past = scene.make_history(self.observation_entries, self.obs_mode_struct.use_state)
        self.observation_entries |= self.past.entries

    def rebuild(self, scale: Float[Tensor, "n objects"]) -> None:
        """Builds the scene anew with objects of these relative sizes; begins new episodes."""
        self._forced_scale = scale
        try:
            with freeing_the_old_scene(self):
                super().reset(options={"reconfigure": True})
        finally:
            self._forced_scale = None

    @property
    def scale(self) -> Float[Tensor, "n objects"]:
        """Sizes of the objects relative to their nominal ones."""
        return self.task_scene.scale

    @property
    def objects(self) -> dict[str, Any]:
        """The objects by name: actors, or links of what they are mounted on."""
        return self.task_scene.objects

    @property
    def arms(self) -> ArmGroup:
        """By name."""
        return self.task_scene.arms

    @cached_property
    def segmentation_id_map(self) -> dict[int, Any]:
        """The objects and links by their numbers in pictures of segmentation, which are the same in all rows."""
        return {**super().segmentation_id_map, **{o._bodies[0].entity.per_scene_id: o for o in self.objects.values()}}

    @property
    def target_object(self) -> Any:
        """The only object; ValueError if there are several."""
        return self.task_scene.object

    @property
    def arm(self) -> Arm:
        """The only arm; ValueError if there are several."""
        return self.arms.only

    @property
    def guide(self) -> Guide:
        """The guide of the only arm; ValueError if there are several."""
        return self.arm.guide

    @property
    def action_size(self) -> int:
        """Number of action components, of all arms in order."""
        return self.arms.action_size

    def anneal(self, **shares: float) -> None:
        """Sets shares for curricula, as `Guide.anneal`, and keeps them at reconfigurations."""
        self._shares |= shares
        self.arms.anneal(**shares)

    # ----------------------------------------------------------------- reading

    @property
    def snapshot(self) -> Snapshot:
        """The state after the last control step or reset; read from the simulator at most once."""
        if self._snapshot is None:
            self._snapshot, self._observed = self._read(self._elapsed_steps)
        return self._snapshot

    @property
    def observed(self) -> Snapshot:
        """The same state with the noise of the sensors: what the policy and the references know of it."""
        _ = self.snapshot
        return self._observed

    def _read(self, step: Int[Tensor, " n"]) -> tuple[Snapshot, Snapshot]:
        """The true state and the observed one after so many control steps."""
        s = self.task.extended(self.task_scene.snapshot(self.machine, self.memory, step / self.task.MAX_STEPS))
        observed = self.perturbations.observed(s, self.arms.choices, step)
        if self.config.observe_correction and PRIOR in self.parts:
            observed = corrected(observed, self.arms.exact_corrections(s, self.perturbations))
        return s, observed

    # ------------------------------------------------------------------- reset

    def reset(self, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """As in ManiSkill, but a seeded reset of all builds the scene anew: PhysX remembers earlier contacts, and
        would not repeat a trajectory bit for bit otherwise. In a partial one (`options["env_idx"]`) the seed is theirs.

        Raises:
            InputError: seeds, `env_idx` or states are of another kind or shape.
        """
        seeds, options = requested(self, seed, options)
        if "env_idx" in options and len(options["env_idx"]) == 0:
            return nothing_reset(self)
        gym.Env.reset(self, seed=seeds[0] if isinstance(seeds, list) else seeds)  # gymnasium's own generator
        self._snapshot, self.resetting = None, True
        try:
            with freeing_the_old_scene(self):
                return super().reset(seed=seeds, options=options)
        finally:
            self.resetting = False

    def _initialize_episode(self, env_idx: Tensor, options: dict) -> None:
        begin_episodes(self, env_idx, options)

    # -------------------------------------------------------------------- step

    def step(self, action: Any) -> tuple[Any, Tensor, Tensor, Tensor, dict[str, Any]]:
        """One control step with the action (n, a), or (a,) for one environment, clipped to [-1, 1]; None moves none.

        Returns:
            Observation ((n, o) with `obs_mode="state"`), reward (n,), terminated (n,), truncated (n,) and info.

        Raises:
            InputError: if the action has another shape, or holds NaN or infinity; nothing is moved then.
        """
        if mend(self):
            self._snapshot = None
        return super().step(self.arms.joined(action, self.num_envs))

    def _step_action(self, action: Any) -> Any:
        action = checked_action(action, self.single_action_space, self.num_envs, self.device)
        step = self._elapsed_steps
        self.task.remember(self.snapshot)
        self.perturbations.remember(self.observed)
        self.past.push(self.observed, action)
        command = None
        if action is not None:
            self.memory.record_action(action)
            command = self.arms.commands(self.observed, self.perturbations.delayed(action, step))
        else:
            self.arms.hold()
        self.task_scene.push(self.perturbations.pushes(step, len(self.objects)))
        super()._step_action(command)
        self.task_scene.reader.record(self.memory, self.control_freq if self.task.CONTACT_EVERY_STEP else self.sim_freq)
        s, observed = self._read(step + 1)  # ManiSkill counts the step after this method
        for name, o in s.objects.items():
            self.memory.record_rise(name, o.p[:, 2] - o.start_p[:, 2])
        self.machine.advance(s)
        now = self.machine.index.clone(), self.machine.by_arm(), self.arms.advance(observed)
        self._snapshot = advanced(s, *now)
        self._observed = self._snapshot if observed is s else advanced(observed, *now)
        self.memory.record_failure(self.mdp.failed(self._snapshot, self.memory))
        return action

    def scripted_action(self) -> Float[Tensor, "n a"]:
        """Action that executes the chosen candidates from the present state: the scripted solution."""
        return self.arms.scripted_action(self.observed)

    # ------------------------------------------------------ evaluation, reward

    @property
    def unreachable(self) -> Bool[Tensor, " n"]:
        """No candidate of some arm could be reached when the episode began. Such an episode fails at once and earns
        nothing (paper, Motion-Feasibility Filtering); never so without that part of guidance."""
        return self.arms.out_of_reach & (FILTER in self.parts)

    def evaluate(self) -> dict[str, Tensor]:
        """Success as the MDP says, failure, stages and overlap; moves nothing, since reset and wrappers call it too."""
        s, memory, finished, unreachable = self.snapshot, self.memory, self.machine.finished, self.unreachable
        verdict = self.mdp.verdict(finished, unreachable, s, memory)
        return {**verdict, "unreachable": unreachable, **self.machine.report(), **memory.report()}

    def compute_dense_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """Sum of the terms (n,); each one's share goes into `info["reward/<name>"]`."""
        total, parts = self.terms(self.snapshot)
        weight = (~self.unreachable).float()
        info.update({f"reward/{name}": weight * value for name, value in parts.items()})
        return weight * total

    def compute_normalized_dense_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """The dense reward over its largest possible value."""
        return self.compute_dense_reward(obs, action, info) / self.terms.upper

    def get_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """(n,) reward of the chosen mode; "paper" sums the printed terms."""
        if self._reward_mode == "paper":
            return self.compute_dense_reward(obs, action, info)
        return super().get_reward(obs, action, info) * ~self.unreachable

    # ------------------------------------------------------------- observation

    def _get_obs_agent(self) -> dict[str, Tensor]:
        return observed_part(self.observation_entries, self.observed, sensed=True)

    def _get_obs_extra(self, info: dict) -> dict[str, Tensor]:
        privileged = self.obs_mode_struct.use_state
        return observed_part(self.observation_entries, self.observed, sensed=False) if privileged else {}

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if not self.obs_mode_struct.state:
            return obs
        state = joined(self.observation_entries, obs)
        pictures = {name: part for name, part in obs.items() if name not in ("agent", "extra")}
        return {**pictures, "state": state} if pictures else state

    # ------------------------------------------------ the protocol of learners

    start_numbers = property(start_numbers)

    @property
    def max_steps(self) -> int:
        """Episode limit [control steps]."""
        return self.task.MAX_STEPS

    @property
    def agent_columns(self) -> dict[str, tuple[list[int], list[int]]]:
        """Columns of observation and action of each arm, for learners that tell agents apart."""
        return self.arms.columns(self.observation_entries, self.observed)

    @property
    def ranking_steps(self) -> int | None:
        """Control steps that ranking the candidates took; None if they do not say."""
        return self.arms.ranking_steps

    @property
    def stage_names(self) -> tuple[str, ...]:
        """Names of the stages, in order."""
        return tuple(stage.name for stage in self.machine.stages)

    @property
    def logged(self) -> tuple[str, ...]:
        """Names of the (n,) tensors in `step`'s info that are worth a curve."""
        stages = [f"stage/{name}" for name in self.stage_names]
        verdicts = ("raw_success", "success_at_end", "finished")
        names = (*(f"reward/{name}" for name in self.terms.terms), *stages, "penetration_mm", *verdicts)
        return (*names, *("nonfinite",) * runs_batched(self), *("unreachable",) * (FILTER in self.parts))

    # ------------------------------------------------------------------- state

    def get_state_dict(self) -> dict:
        """Simulator, controller and task state; a round trip restores stage and observation."""
        return saved_state(self, cast(dict[str, Any], super().get_state_dict()))  # annotated as a tensor

    def set_state_dict(self, state: Any, env_idx: Any = None) -> None:
        """Inverse of `get_state_dict`; with `env_idx` (b,) the state has b rows.

        Where the state's objects have another size, the scene is built anew with those sizes.
        """
        set_rows(self, super().set_state_dict, state, env_idx)

    def set_state(self, state: Any, env_idx: Any = None) -> None:
        """Inverse of `get_state`: rows (n, s), or (b, s) with `env_idx` (b,)."""
        self.set_state_dict(unflattened(self, state, env_idx), env_idx)

    def __str__(self) -> str:
        """The tables in force: stages, terms with weights, observations, limits, numbers."""
        return describe(self)
