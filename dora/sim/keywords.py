"""The keywords of `gym.make`: unknown names, types and values out of range are refused in one sentence."""

import dataclasses
import inspect
import math
import types
import typing
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

import mani_skill.envs.utils.system.backend as backends
import numpy as np
import torch
from jaxtyping import Float
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.observations import CameraObsTextures
from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS
from mani_skill.utils.registration import EnvSpec
from mani_skill.utils.structs.types import SimConfig

from dora.arguments import checked_truth
from dora.errors import InputError, shown, suggestion
from dora.robot import available_robots
from dora.sim.batch.hooks import BACKEND, batched_by_default
from dora.sim.cameras import check_settings
from dora.sim.robots import register_robot

SIM_BACKENDS = ("auto", BACKEND, *backends.sim_backend_name_mapping)
"""Values of `sim_backend`; those of CUDA may have the number of a device, as in "physx_cuda:1"."""
RENDER_BACKENDS = ("none", *backends.render_backend_name_mapping)
"""Values of `render_backend`, and "auto" for tasks of ours; names of devices such as "pci:0000:01:00.0" besides."""
TEXTURES = tuple(field.name for field in dataclasses.fields(CameraObsTextures))
"""Observations of cameras, which an `obs_mode` may join with "+"."""
MODES_OF_PICTURES = ("rgbd", *TEXTURES)
"""What an `obs_mode` may be besides a task's own modes."""
ALONE = ("rgbd", "sensor_data")
"""Modes that ManiSkill does not join with others."""
SETTINGS = ("sensor_configs", "human_render_camera_configs", "viewer_camera_configs")
"""Keywords that take dictionaries."""

_installed = False


def install_keywords() -> None:
    """Check the keywords of all environments of ManiSkill from now on; further calls do nothing."""
    global _installed
    if not _installed:
        EnvSpec.make = wraps(EnvSpec.make)(_make(EnvSpec.make))
        BaseAgent.set_control_mode = wraps(BaseAgent.set_control_mode)(_set_mode(BaseAgent.set_control_mode))
        BaseEnv.__init__ = wraps(BaseEnv.__init__)(_init(BaseEnv.__init__))
        _installed = True


def _make(original: Callable) -> Callable:
    def make(self: EnvSpec, **kwargs: Any) -> Any:
        return original(self, **checked_values(self.cls, kwargs))

    return make


def _init(original: Callable) -> Callable:
    names = list(inspect.signature(original).parameters)[1:]

    def init(self: BaseEnv, *args: Any, **kwargs: Any) -> None:
        """ManiSkill's, after a check of every keyword; InputError about the first that is wrong."""
        kwargs = {**dict(zip(names, args, strict=False)), **kwargs}
        check_names(type(self), kwargs, names)
        if _is_checked(type(self), kwargs):
            config = {} if kwargs.get("sim_config") is None else kwargs["sim_config"]
            kwargs["sim_config"] = config = _checked_sim_config(config, SimConfig, "sim_config")
            self.num_envs = kwargs.get("num_envs", 1)  # as in ManiSkill, whose tasks may use it for their settings
            if config != {}:
                _check_rates(config, self._default_sim_config)
        original(self, **kwargs)

    return init


def _set_mode(original: Callable) -> Callable:
    def set_control_mode(self: BaseAgent, control_mode: Any = None) -> None:
        mode, modes = control_mode or self._default_control_mode, self.supported_control_modes
        if mode not in modes:
            raise InputError(f"there is no control_mode {mode!r}: {suggestion(mode, modes)}")
        original(self, mode)

    return set_control_mode


def check_names(cls: type, kwargs: Mapping[str, Any], names: list[str]) -> None:
    """Refuses keywords that are not among `names`, with the nearest one that the class or its bases take.

    Raises:
        InputError: naming the first unknown one.
    """
    known = [*dict.fromkeys([*_parameters(cls), "max_episode_steps"])]
    for name in kwargs:
        if name not in names:
            raise InputError(f"{cls.__name__} takes no argument {name!r}: {suggestion(name, known)}")


def _parameters(cls: type) -> dict[str, inspect.Parameter]:
    """Named parameters of the constructors of a class and its bases, down to ManiSkill's `BaseEnv`."""
    found: dict[str, inspect.Parameter] = {}
    for base in reversed([base for base in cls.__mro__ if issubclass(base, BaseEnv) and "__init__" in vars(base)]):
        parameters = inspect.signature(vars(base)["__init__"]).parameters
        named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        found |= {name: p for name, p in parameters.items() if p.kind in named and name != "self"}
    return found


def _is_ours(cls: type) -> bool:
    return any(base.__module__.split(".")[0] == "dora" for base in cls.__mro__)


def _is_checked(cls: type, kwargs: Mapping[str, Any]) -> bool:
    """Whether an environment is one of ours or will run batched; the others are ManiSkill's own business."""
    backend, count = kwargs.get("sim_backend", "auto"), kwargs.get("num_envs", 1)
    return _is_ours(cls) or backend == BACKEND or batched_by_default(backend, count)


def checked_values(cls: type, kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """The keywords of an environment; numbers of numpy become Python's, and None an empty dictionary where one is due.

    Args:
        cls: class of the environment, a `BaseEnv`.
        kwargs: as given to `gym.make`.

    Raises:
        InputError: one sentence about the first value that is of the wrong type or out of range.
    """
    out: dict[str, Any] = {k: "none" if k == "render_backend" and v is None else v for k, v in kwargs.items()}
    parameters = _parameters(cls)
    out |= {k: _typed(k, v, parameters[k].annotation) for k, v in out.items() if k in ("num_envs", "sim_backend")}
    if out.get("num_envs", 1) < 1:
        raise InputError(f"num_envs is {out['num_envs']}: it must be a whole number of at least 1.")
    _check_backends(cls, out)
    if not _is_checked(cls, out):
        return out
    out = {k: _typed(k, v, parameters[k].annotation) if k in parameters else v for k, v in out.items()}
    out |= {k: {} for k in (*SETTINGS, "sim_config") if k in out and out[k] is None}
    for name in SETTINGS:
        if not isinstance(out.get(name, {}), Mapping):
            raise InputError(f"{name} must be a dictionary, not {shown(out[name])}.")
        check_settings(out.get(name, {}), name)
    if (frequency := out.get("reconfiguration_freq")) is not None and frequency < 0:
        raise InputError(f"reconfiguration_freq is {frequency}: it must be 0 (never) or a number of resets.")
    if _is_ours(cls) and out.get("parallel_in_single_scene"):
        raise InputError("parallel_in_single_scene is not available for tasks of dora: leave it out.")
    _check_modes(cls, out)
    if not _is_ours(cls) and (robots := out.pop("robot_uids", None)) is not None:  # None stands for the task's own
        out["robot_uids"] = _checked_robots(robots)
    return out


def _typed(name: str, value: Any, annotation: Any) -> Any:
    """A value of the type of its annotation, as far as that is a text, a truth value or a whole number."""
    union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    kinds = set(typing.get_args(annotation) if union else (annotation,))
    if value is None and type(None) in kinds:
        return None
    kinds -= {type(None)}
    if kinds == {str} and not isinstance(value, str):
        raise InputError(f"{name} must be a text, not {shown(value)}.")
    if kinds == {bool}:
        return checked_truth(value, name)
    if kinds == {int}:
        if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
            raise InputError(f"{name} is {shown(value)}: it must be a whole number.")
        return int(value)
    return value


def _checked_robots(robots: Any) -> Any:
    """The `robot_uids` of a task of ManiSkill: a name or class of a robot, or a tuple of those."""
    names = robots if isinstance(robots, tuple | list) else (robots,)
    if not names:
        raise InputError("robot_uids names no robot: leave it out for the task's own.")
    for name in names:
        if isinstance(name, type) and issubclass(name, BaseAgent):
            continue
        if not isinstance(name, str):
            raise InputError(f"robot_uids must be the name of a robot, or a tuple of names, not {shown(robots)}.")
        if name not in REGISTERED_AGENTS and name in available_robots():
            register_robot(name)  # its folder came, or was mended, since
        if name not in ("none", *REGISTERED_AGENTS):
            raise InputError(f"there is no robot {name!r}: {suggestion(name, REGISTERED_AGENTS)}")
    return tuple(robots) if isinstance(robots, list) else robots


def _check_backends(cls: type, kwargs: Mapping[str, Any]) -> None:
    name = kwargs.get("sim_backend", "auto")
    kind, _, device = name.partition(":")
    if kind not in SIM_BACKENDS or (device and not (on_gpu(kind) and device.isdigit())):
        raise InputError(f"there is no sim_backend {name!r}: {suggestion(name, SIM_BACKENDS)}")
    if on_gpu(kind) and not torch.cuda.is_available():
        raise InputError(f"sim_backend {name!r} needs a GPU with CUDA, and torch finds none: use {BACKEND!r}.")
    if _is_ours(cls) and kind in backends.CPU_SIM_BACKENDS and kwargs.get("num_envs", 1) > 1:
        raise InputError(f"sim_backend {name!r} runs one environment: use {BACKEND!r} for {kwargs['num_envs']}.")
    render = kwargs.get("render_backend")
    known = ("auto", *RENDER_BACKENDS) if _is_ours(cls) else RENDER_BACKENDS
    if isinstance(render, str) and render.partition(":")[0] not in (*known, "pci"):
        raise InputError(f"there is no render_backend {render!r}: {suggestion(render, known)}")


def on_gpu(sim_backend: str) -> bool:
    """Whether a value of `sim_backend` stands for PhysX on a GPU, with or without the number of a device."""
    return backends.sim_backend_name_mapping.get(sim_backend.partition(":")[0]) == "physx_cuda"


def _check_modes(cls: Any, kwargs: Mapping[str, Any]) -> None:
    own = [mode for mode in cls.SUPPORTED_OBS_MODES if mode != "any_textures"]
    pictures = MODES_OF_PICTURES if "any_textures" in cls.SUPPORTED_OBS_MODES else ()
    mode = kwargs.get("obs_mode")
    if mode is not None and mode not in own:
        parts = mode.split("+")
        for part in parts:
            if part not in (*pictures, *own):
                raise InputError(f"there is no obs_mode {mode!r}: {suggestion(part, (*own, *pictures))}")
            if part in ALONE and len(parts) > 1:
                raise InputError(
                    f"the obs_mode {part!r} cannot be joined, as in {mode!r}: join textures, as rgb+depth."
                )
        if len(set(parts)) < len(parts) or len(set(parts) & EXCLUSIVE) > 1:
            raise InputError(f"the obs_mode {mode!r} has parts that exclude each other: join textures, as state+rgb.")
    choices = {
        "reward_mode": cls.SUPPORTED_REWARD_MODES,
        "render_mode": cls.SUPPORTED_RENDER_MODES,
        "shader_dir": tuple(PREBUILT_SHADER_CONFIGS),
    }
    for name, known in choices.items():
        if (value := kwargs.get(name)) is not None and value not in known:
            raise InputError(f"there is no {name} {value!r}: {suggestion(value, known)}")


EXCLUSIVE = frozenset({"none", "state", "state_dict"})
"""Modes of observations of which only one can be in force."""
NOT_NEGATIVE = ("spacing", "contact_offset", "sleep_threshold", "bounce_threshold", "static_friction",
                "dynamic_friction", "restitution")  # fmt: skip
"""Numbers of a sim_config that must not be negative."""
LARGEST_GRAVITY = 1e4
"""[m/s^2]."""
LARGEST, LARGEST_COUNT = {"_freq": 100_000, "_iterations": 255}, 2**31 - 1
"""Largest rates [Hz] and PhysX's largest numbers of iterations, by the ends of their names, and that of any other whole
number."""


# ---- sim_config ----------------------------------------------------------------------------------


def _checked_sim_config(config: Any, cls: Any, where: str) -> dict[str, Any]:
    """The settings that are given, as ManiSkill takes them: numbers of Python, gravity as an array.

    Raises:
        InputError: a name is unknown, or a value of another type or out of range.
    """
    if isinstance(config, cls):
        config = {field.name: getattr(config, field.name) for field in dataclasses.fields(cls)}
    if not isinstance(config, Mapping):
        raise InputError(f"{where} must be a dictionary or a {cls.__name__}, not {shown(config)}.")
    hints, checked = typing.get_type_hints(cls), dict[str, Any]()
    for name, value in config.items():
        if name not in hints:
            raise InputError(f"{where} has no entry {name!r}: {suggestion(name, hints)}")
        checked[name] = _checked_setting(f"{where}[{name!r}]", value, hints[name])
    return checked


def _checked_setting(path: str, value: Any, hint: Any) -> Any:
    """One setting, named by its last part."""
    name = path.rpartition("[")[2].strip("'[]")
    if dataclasses.is_dataclass(hint):
        return _checked_sim_config(value, hint, path)
    if hint is int:
        if (whole := _typed(path, value, int)) < (1 if name.endswith("_freq") else 0):
            raise InputError(f"{path} is {value}: it is too small.")
        if whole > next((most for ending, most in LARGEST.items() if name.endswith(ending)), LARGEST_COUNT):
            raise InputError(f"{path} is {shown(value)}: it is too large.")
        return whole
    if hint is float:
        if not (isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)):
            raise InputError(f"{path} must be a finite number, not {shown(value)}.")
        if value < 0 and name in NOT_NEGATIVE:
            raise InputError(f"{path} is {value}: it must not be negative.")
        return float(value)
    return _checked_gravity(path, value) if name == "gravity" else _typed(path, value, hint)


def _checked_gravity(path: str, value: Any) -> Float[np.ndarray, " 3"]:
    """Gravity [m/s^2] as an array."""
    try:
        gravity = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        gravity = np.empty(0, np.float32)
    if gravity.shape != (3,) or not (np.abs(gravity) < LARGEST_GRAVITY).all():
        raise InputError(f"{path} must be three finite numbers, such as [0, 0, -9.81], not {shown(value)}.")
    return gravity


def _check_rates(config: Any, default: SimConfig) -> None:
    """Refuses a rate of the physics that is no multiple of that of control."""
    given = config if isinstance(config, Mapping) else dataclasses.asdict(config)
    physics, control = (given.get(name, getattr(default, name)) for name in ("sim_freq", "control_freq"))
    if physics % control:
        raise InputError(
            f"sim_config['sim_freq'] is {physics} Hz: it must be a multiple of the control_freq, {control} Hz."
        )
