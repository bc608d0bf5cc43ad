"""The functions of ManiSkill that are wrapped so that it accepts the back end ``physx_cpu_batch``.

Every wrapper calls ManiSkill's own code unless the environment runs on that back end.
"""

import ctypes
import itertools
from collections.abc import Callable
from functools import cache, cached_property, partial, wraps
from importlib.metadata import version
from typing import Any

import mani_skill.envs.sapien_env as sapien_env
import numpy as np
import sapien
import torch
from mani_skill import logger
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.system.backend import BackendInfo
from mani_skill.utils.structs import Actor, Articulation, ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct
from sapien import physx

from dora.errors import InputError, shown
from dora.sim.batch import resets
from dora.sim.batch.actions import check_action, finite_rows, plain_action
from dora.sim.batch.guard import StateGuard, marked
from dora.sim.batch.rendering import can_render, refuse_pictures, replace_materials, wants_pictures
from dora.sim.batch.scene import BatchScene

BACKEND = "physx_cpu_batch"
"""Name of the back end as `sim_backend`."""
MOST_ENVS = 100_000
"""Largest number of environments of a batch [1]."""
SPARE = 16
"""Keys of thread-specific data that are left to others [1]."""
SUPPORTED = {"mani_skill": "3.0.1", "sapien": "3.0.3"}
"""Versions for which the wrappers are written, by package."""

_installed = False


def install() -> None:
    """Make ``sim_backend="physx_cpu_batch"`` known to ManiSkill; further calls do nothing.

    Raises:
        InputError: ManiSkill or SAPIEN is installed in another version than in ``SUPPORTED``.
    """
    global _installed
    if _installed:
        return
    for package, needed in SUPPORTED.items():
        if (found := version(package)) != needed:
            raise InputError(
                f"dora.sim needs {package} {needed} but found {found}: run pip install {package}=={needed}."
            )
    for owner, name, wrapper in (
        (sapien_env, "parse_sim_and_render_backend", _parse_backends),
        (BaseEnv, "__init__", _init),
        (BaseEnv, "_setup_scene", _setup_scene),
        (BaseEnv, "reset", _reset),
        (BaseEnv, "step", _step),
        (BaseEnv, "_step_action", _step_action),
        (BaseEnv, "reset", partial(_where_batched, resets.reset)),
        (BaseEnv, "get_state_dict", partial(_where_batched, resets.get_state_dict)),
        (BaseEnv, "set_state", partial(_where_batched, resets.set_state)),
        (BaseEnv, "set_state_dict", partial(_where_batched, resets.set_state_dict)),
        (Articulation, "get_collision_meshes", _get_meshes),
        (Articulation, "get_visual_meshes", _get_meshes),
        (Actor, "hide_visual", partial(_set_visible, 0.0)),
        (Actor, "show_visual", partial(_set_visible, 1.0)),
        (PDEEPosController, "set_action", _set_pose_action),
        (Kinematics, "compute_ik", _compute_ik),
    ):
        original = getattr(owner, name)
        setattr(owner, name, wraps(original)(wrapper(original)))
    for owner, name, rows in (
        (PhysxRigidBodyComponentStruct, "_body_data_index", _body_rows),
        (Articulation, "_data_index", _articulation_rows),
        (ArticulationJoint, "_data_index", _joint_rows),
    ):
        _replace_cached_property(owner, name, rows)
    _installed = True


def runs_batched(env: Any) -> bool:
    """Whether a ManiSkill environment (perhaps wrapped) runs on this back end."""
    return env.unwrapped.backend.sim_backend == BACKEND


# ---- environments --------------------------------------------------------------------------------


def _where_batched(ours: Callable, original: Callable) -> Callable:
    """A method that is `ours` on this back end, which gets the original as its first argument; elsewhere that one."""

    def method(self: BaseEnv, *args: Any, **kwargs: Any) -> Any:
        return ours(original, self, *args, **kwargs) if runs_batched(self) else original(self, *args, **kwargs)

    return method


def _parse_backends(original: Callable) -> Callable:
    def parse(sim_backend: str, render_backend: str | None) -> BackendInfo:
        """ManiSkill's result, or its result for a CPU with the name of this back end."""
        if sim_backend != BACKEND:
            return original(sim_backend, render_backend or "none")
        info = original("physx_cpu", render_backend or "none")
        info.sim_backend = BACKEND
        if not can_render():
            replace_materials()
            info.render_device, info.render_backend = None, "none"
        return info

    return parse


def batched_by_default(sim_backend: str, num_envs: int) -> bool:
    """Whether this back end is what "auto" means: for several environments on a machine without CUDA."""
    return sim_backend == "auto" and num_envs > 1 and not torch.cuda.is_available()


@cache
def _say_default() -> None:
    logger.warning(f'There is no CUDA: several environments run with sim_backend="{BACKEND}" unless another is given.')


def _init(original: Callable) -> Callable:
    def init(self: BaseEnv, num_envs: Any = 1, *args: Any, **kwargs: Any) -> None:
        """ManiSkill's, with this back end as the default where it is; InputError for what the back end cannot do."""
        whole = isinstance(num_envs, int | np.integer)
        if whole and batched_by_default(kwargs.get("sim_backend", "auto"), int(num_envs)):
            kwargs["sim_backend"] = BACKEND
            _say_default()
        if kwargs.get("sim_backend") == BACKEND:
            if not whole or not 1 <= num_envs <= MOST_ENVS:
                raise InputError(f"num_envs is {shown(num_envs)}: it must be a whole number from 1 to {MOST_ENVS}.")
            if kwargs.get("parallel_in_single_scene"):
                raise InputError(f"parallel_in_single_scene is not available on {BACKEND}: leave it out.")
        original(self, num_envs, *args, **kwargs)

    return init


def check_room(count: int) -> None:
    """Refuse environments for which this process has no room, with which it would be aborted.

    PhysX takes a key of thread-specific data for each of its scenes, and the system has 1024 for a process.

    Args:
        count: environments that are still to be made.

    Raises:
        InputError: there are too many.
    """
    room = _free_keys(count + SPARE) - SPARE
    if room < count:
        raise InputError(
            f"this process has room for {max(room, 0)} more environments, and {count} are needed (a scene that is "
            "built anew stands beside the old one for a moment): use fewer, or several processes."
        )


def _free_keys(wanted: int) -> int:
    """How many of these keys the system still gives to this process; all of them where it has no such keys."""
    create, delete = (getattr(ctypes.CDLL(None), f"pthread_key_{name}", None) for name in ("create", "delete"))
    if create is None or delete is None:
        return wanted
    keys = [ctypes.c_uint() for _ in range(wanted)]
    made = list(itertools.takewhile(lambda key: create(ctypes.byref(key), None) == 0, keys))
    for key in made:
        delete(key)
    return len(made)


def _setup_scene(original: Callable) -> Callable:
    def setup_scene(self: BaseEnv) -> None:
        """ManiSkill's scene, or a `BatchScene`; InputError if pictures are needed and there is no driver."""
        if not runs_batched(self):
            return original(self)
        renderers = [] if self._render_device is None else [self._render_device]
        if not renderers and (wants_pictures(self._obs_mode) or self.render_mode == "human"):
            refuse_pictures(self._obs_mode, self.render_mode)
        if not renderers and self.render_mode is not None:
            logger.warning(f"render_mode {self.render_mode!r} has no effect because there is no renderer.")
        self._set_scene_config()
        check_room(self.num_envs)
        scenes = [
            sapien.Scene([physx.PhysxCpuSystem(), *(sapien.render.RenderSystem(device) for device in renderers)])
            for _ in range(self.num_envs)
        ]
        self.scene = BatchScene(scenes, sim_config=self.sim_config, device=self.device, backend=self.backend)
        self.scene.px.timestep = 1.0 / self._sim_freq

    return setup_scene


def _reset(original: Callable) -> Callable:
    def reset(self: BaseEnv, *args: Any, **kwargs: Any) -> Any:
        """Puts bad environments back, so that those which are not reset return finite numbers, too."""
        if not runs_batched(self) or not isinstance(self.scene, BatchScene):
            return original(self, *args, **kwargs)
        mend(self)
        result = original(self, *args, **kwargs)
        options = kwargs.get("options") or (args[1] if len(args) > 1 else None) or {}
        rows = options.get("env_idx", slice(None))
        self.scene.px.guard.clear(rows.cpu().numpy() if isinstance(rows, torch.Tensor) else rows)
        return result

    return reset


def mend(env: Any) -> bool:
    """Put the environments of a batch back whose state is bad now; returns whether there are any.

    They count as bad in the next step. `env` is an unwrapped environment, on whatever back end.
    """
    return runs_batched(env) and bool(env.scene.px.guard.check().any())


def _step(original: Callable) -> Callable:
    def step(self: BaseEnv, action: Any) -> Any:
        """ManiSkill's step, in which environments whose state becomes bad are put back and terminated."""
        if not runs_batched(self):
            return original(self, action)
        if self.scene is None:
            raise InputError("step() after close(): make the environment again.")
        guard: StateGuard = self.scene.px.guard  # pyright: ignore[reportAttributeAccessIssue]
        guard.begin(action)
        result, rows = marked(original(self, action), torch.from_numpy(guard.found))
        guard.clear()
        if rows.any():
            self._last_obs = result[0]
        return result

    return step


def _step_action(original: Callable) -> Callable:
    def step_action(self: BaseEnv, action: Any) -> Any:
        """Checks the action, then defers the physics steps of the control step to one pass per environment.

        An environment with a `_step_action` of its own checks what the user gave. If what it makes of that is not
        finite, the state is to blame and not the user.
        """
        if not runs_batched(self):
            return original(self, action)
        system: Any = self.scene.px
        if type(self)._step_action is not BaseEnv._step_action:
            action = finite_rows(action, system.guard.found)
        action = plain_action(action, self.device)
        check_action(self, action)
        system.guard.accept()
        hooks = ("_before_simulation_step", "_after_simulation_step")
        watched = any(_is_overridden(self, hook) for hook in hooks)
        system.defer(0 if watched else self._sim_steps_per_control)
        try:
            result = original(self, action)
        finally:
            system.defer(0)
        system.guard.check()
        return result

    return step_action


def _is_overridden(env: BaseEnv, method: str) -> bool:
    """Whether a method of BaseEnv is overridden, in the task's class or in the instance."""
    return getattr(getattr(env, method), "__func__", None) is not getattr(BaseEnv, method)


# ---- structs and controllers ---------------------------------------------------------------------


def _get_meshes(original: Callable) -> Callable:
    """Lets ManiSkill read poses before its flag for an initialised GPU is set."""

    def get_meshes(self: Articulation, *args: Any, **kwargs: Any) -> Any:
        """ManiSkill's meshes, with the flag set for the duration of the call."""
        if not isinstance(self.scene, BatchScene):
            return original(self, *args, **kwargs)
        self.scene._gpu_sim_initialized = True
        try:
            return original(self, *args, **kwargs)
        finally:
            self.scene._gpu_sim_initialized = False

    return get_meshes


def _set_visible(visibility: float, original: Callable) -> Callable:
    """Hides and shows actors by their visibility, as on a CPU; on a GPU ManiSkill moves them 100 km away."""

    def set_visible(self: Actor) -> None:
        if not isinstance(self.scene, BatchScene):
            return original(self)
        for entity in self._objs:
            body: Any = entity.find_component_by_type(sapien.render.RenderBodyComponent)
            body.visibility = visibility

    return set_visible


def _set_pose_action(original: Callable) -> Callable:
    """Gives target poses to the inverse kinematics, as on a CPU; on a GPU ManiSkill gives it the deltas.

    A controller with ``use_target`` does so on every back end, relative to its last target; without it the target is
    relative to the measured pose.
    """

    def set_action(self: PDEEPosController, action: Any) -> None:
        """ManiSkill's action relative to the measured pose, as on a single CPU."""
        if not isinstance(self.scene, BatchScene) or self.config.use_target:
            return original(self, action)
        self._target_pose = self.ee_pose_at_base
        self.config.use_target = True
        try:
            original(self, action)
        finally:
            self.config.use_target = False

    return set_action


def _compute_ik(original: Callable) -> Callable:
    """Pinocchio's inverse kinematics, one environment after the other; where it fails the joints stay unchanged."""

    def compute_ik(self: Kinematics, pose: Any, q0: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        if not isinstance(self.articulation.scene, BatchScene):
            return original(self, pose, q0, *args, **kwargs)
        found = [original(self, pose[i], q0[i : i + 1], *args, **kwargs) for i in range(len(q0))]
        stay = q0[:, self.active_joint_indices]
        return torch.cat([stay[i : i + 1] if row is None else row for i, row in enumerate(found)])

    return compute_ik


def _replace_cached_property(owner: type, name: str, rows: Callable[[Any], torch.Tensor]) -> None:
    original = owner.__dict__[name].func

    @wraps(original)
    def find(self: Any) -> torch.Tensor:
        return rows(self) if isinstance(self.scene, BatchScene) else original(self)

    replacement = cached_property(find)
    replacement.__set_name__(owner, name)
    setattr(owner, name, replacement)


def _body_rows(struct: Any) -> torch.Tensor:
    return torch.tensor(struct.scene.px.body_rows(struct._bodies))


def _articulation_rows(struct: Any) -> torch.Tensor:
    return torch.tensor(struct.scene.px.articulation_rows(struct._objs), dtype=torch.int32)


def _joint_rows(struct: Any) -> torch.Tensor:
    return torch.tensor(struct.scene.px.articulation_rows(struct._physx_articulations), dtype=torch.int32)
