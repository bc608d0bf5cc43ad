"""Base of every one-arm Dora task: reads the simulator once per control step, then only pure tensor code decides."""

from abc import abstractmethod
from collections.abc import Sequence
from math import pi
from typing import Any, ClassVar, cast

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from mani_skill.utils.structs import Pose
from torch import Tensor

from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_rotation_vector
from dora.sim.batch.actions import check_action
from dora.tasks.env.building import SCALE_DRAW, BuiltEnv
from dora.tasks.guidance.candidate_choice import ERROR_DRAWS
from dora.tasks.guidance.residual_action import Target, wrist_step
from dora.tasks.mdp.guidance_parts import FILTER
from dora.tasks.mdp.snapshot import Snapshot, advanced, lifted

TRIES = 8
"""Starting poses that are drawn for an object that stands."""
STANDING_DRAWS = 3 * TRIES
"""Random numbers of one such start: x, y and yaw of each pose."""


class DoraEnv(BuiltEnv):
    """A task is `STAGES`, `TERMS`, `place` (random numbers -> initial state), an object and its candidates."""

    DRAWS: ClassVar[int]
    """How many uniform random numbers one initial state needs, besides mass, friction and errors."""

    _snapshot: Snapshot | None = None
    _observed: Snapshot

    @abstractmethod
    def place(self, env_idx: Tensor, u: Tensor) -> None:
        """Puts the object of the environments `env_idx` (b,) where `u` (b, DRAWS) in [0, 1) says."""

    def masses(self, nominal: Float[Tensor, " b"], u: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        """Masses of new episodes [kg] from the objects' nominal ones and uniform random numbers."""
        return nominal * (1 + self.preset.mass * (2 * u - 1))

    def reachable(self, object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]) -> Bool[Tensor, "b c"]:
        """f_reach: which candidates the arm can grasp without collision when the object stands like this."""
        if self.reach_table is not None:
            return self.reach_table.mask(object_p, object_q)
        return torch.ones(len(object_p), len(self.guide.choice.candidates), dtype=torch.bool, device=self.device)

    def standing(self, u: Float[Tensor, "b d"], height: Float[Tensor, " b"]) -> Pose:
        """Poses of objects that stand within `START` at any yaw, where a candidate can be reached.

        Args:
            u: uniform random numbers, x, y and yaw of each of `TRIES` poses; the first that leaves a reachable
                candidate is taken, or the very first if none does.
            height: of the objects' origins [m].
        """
        assert self.START is not None
        u = u.reshape(len(u), TRIES, 3)
        x, y = (
            c + w * (2 * u[..., k] - 1)
            for k, (c, w) in enumerate(zip(self.START.centre, self.START.spread, strict=True))
        )
        position = torch.stack([x, y, height[:, None].expand_as(x)], -1)
        turn = torch.zeros_like(position)
        turn[..., 2] = 2 * pi * u[..., 2]
        quaternion = quaternion_from_rotation_vector(turn)
        able = self.reachable(position.flatten(0, 1), quaternion.flatten(0, 1)).any(-1).reshape(len(u), TRIES)
        chosen = torch.arange(len(u), device=u.device), able.float().argmax(-1)
        return Pose.create_from_pq(position[chosen], quaternion[chosen])

    def extended(self, s: Snapshot) -> Snapshot:
        """The snapshot with what this task reads in addition: a subclass of `Snapshot`."""
        return s

    # ---------------------------------------------------------------- reading

    @property
    def snapshot(self) -> Snapshot:
        """The state after the last control step or reset; read from the simulator at most once."""
        if self._snapshot is None:
            self._snapshot = self._read(self._elapsed_steps)
        return self._snapshot

    @property
    def observed(self) -> Snapshot:
        """The same state with the preset's noise: what the policy and the reference know of it."""
        _ = self.snapshot
        return self._observed

    def _read(self, step: Int[Tensor, " n"]) -> Snapshot:
        time = step / self.MAX_STEPS
        s = self.extended(self._reader.snapshot(self.machine, self.guide, self.episode, self.object_half, time))
        self._observed = self.perturbations.observed(s, self.guide.choice, step)
        return s

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
        parts = [self.DRAWS, 1, 1, ERROR_DRAWS, 1]
        size = sum(parts)
        assert size < SCALE_DRAW
        draws = np.asarray(self._batched_episode_rng[env_idx.cpu().numpy()].uniform(size=(size,)))
        u = torch.as_tensor(draws, dtype=torch.float32, device=self.device).reshape(len(env_idx), size)
        place, mass, friction, error, key = u.split(parts, -1)
        home = self.agent.description.postures[self.HOME]
        qpos = torch.from_numpy(self.agent.qpos_of(home.arm, home.hand)).to(self.device)
        self.agent.robot.set_qpos(qpos.expand(len(env_idx), -1))
        if self.agent.commands_wrist:
            joints = torch.tensor(np.concatenate([home.arm, home.hand]), dtype=torch.float32, device=self.device)
            self.agent.wrist_controller.begin(env_idx, joints.expand(len(env_idx), -1))
        self.place(env_idx, place)
        pose, e = self.target_object.pose, self.episode
        e.begin(env_idx, pose.p[env_idx])
        low, high = self.preset.friction
        nominal = torch.tensor(self._properties.nominal, device=self.device)[env_idx]
        e.mass[env_idx] = self.masses(nominal, mass[:, 0])
        e.friction[env_idx] = low + (high - low) * friction[:, 0]
        self._apply_properties(env_idx)
        self.machine.reset(env_idx)
        self.perturbations.begin(env_idx, key[:, 0])
        self._choose(env_idx, pose.p[env_idx], pose.q[env_idx], 2 * error - 1)

    def _choose(self, env_idx: Tensor, object_p: Tensor, object_q: Tensor, error: Tensor) -> None:
        """Gives new episodes their candidates and starts their references."""
        wrist_p, wrist_q = (x.expand(len(env_idx), -1) for x in self._home)
        choice, reachable = self.guide.choice, self.reachable(object_p, object_q)
        # Without guidance only the scripted solution uses candidates.
        wanted = reachable if FILTER in self.parts or not self.parts else torch.ones_like(reachable)
        wanted = wanted if self.narrow is None else self.narrow(wanted)
        index = choice.nearest(object_p, object_q, wrist_p, wrist_q, wanted)
        choice.choose(env_idx, index, reachable.any(-1), error, self.preset)
        self.guide.begin(env_idx, wrist_p, wrist_q)

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
        action, step = self._checked(action), self._elapsed_steps
        command = None
        if action is not None:
            self.episode.record_action(action)
            action = self.perturbations.delayed(action, step)
            command = self._command(action)
        elif self.agent.commands_wrist:
            self.agent.wrist_controller.hold()
        self._push(self.perturbations.pushes(step))
        super()._step_action(command)
        seen = self.control_freq if self.CONTACT_EVERY_STEP else self.sim_freq
        self.episode.record_contacts(self._reader.contacts(), seen)
        if self.CONTACT_POINTS:
            self.episode.record_points(*self._reader.points())
        s = self._read(step + 1)  # ManiSkill counts the step after this method
        self.episode.record_rise(lifted(s))
        self.machine.advance(s)
        self.reference.advance(self._observed)
        moved = {"stage": self.machine.index.clone(), "phase": self.reference.one_hot()}
        self._snapshot = advanced(s, **moved)
        self._observed = self._snapshot if self._observed is s else advanced(self._observed, **moved)
        return action

    def _checked(self, action: Any) -> Tensor | None:
        """The action as an (n, a) tensor; InputError for a wrong shape or a value that is not finite."""
        if action is None:
            return None
        out = torch.as_tensor(action, dtype=torch.float32, device=self.device)
        check_action(self, out)
        return out.reshape(self.num_envs, self.action_size)

    def _push(self, impulse: Float[Tensor, "n 3"]) -> None:
        """Gives objects an impulse [N s] at their centres of mass in the next physics step."""
        for row in impulse.any(-1).nonzero()[:, 0].tolist():
            body = self.target_object._bodies[row]
            centre = (body.entity_pose * body.cmass_local_pose).p
            body.add_force_at_point(impulse[row].cpu().numpy(), centre, "impulse")

    def _command(self, action: Tensor) -> Tensor:
        """What the controller is asked: the action itself, or the corrected reference."""
        if not self.corrects:
            return action
        return self._encode(self.guide.corrected(self.observed, action, self.agent.wrist_controller.expand_hand))

    def _encode(self, target: Target) -> Tensor:
        """A wrist and hand target as an action of the wrist controller."""
        controller = self.agent.wrist_controller
        from_p, from_q = controller.wrist()
        step = wrist_step(target.wrist_p, target.wrist_q, from_p, from_q, controller.wrist_limits)
        return torch.cat([step, controller.hand_action(target.hand)], -1)

    def scripted_action(self) -> Tensor:
        """(n, a) action that executes the chosen candidate from the present state: the scripted solution.

        Where actions correct the reference that is zero; elsewhere, its target as a plain action of the default
        controller.
        """
        if self.corrects:
            return torch.zeros(self.num_envs, self.action_size, device=self.device)
        target = self.reference.target(self.observed)
        self.reference.aim(target)
        return self._encode(target)

    # ------------------------------------------------------------------ state

    def get_state_dict(self) -> dict:
        """Simulator, controller and task state; a round trip restores stage and observation."""
        task = self.episode.get_state() | {"elapsed": self._elapsed_steps.clone(), "scale": self.scale.clone()}
        ours = {
            "task": task,
            "machine": self.machine.get_state(),
            "guide": self.guide.get_state(),
            "perturbations": self.perturbations.get_state(),
        }
        rows = {name: {k: v.flatten(min(1, v.ndim - 1)) for k, v in part.items()} for name, part in ours.items()}
        return cast(dict[str, Any], super().get_state_dict()) | rows  # annotated as a tensor

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
            self.guide.set_state(state["guide"], rows)
            self.perturbations.set_state(state["perturbations"], rows)
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
