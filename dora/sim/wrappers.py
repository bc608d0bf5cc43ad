"""ManiSkill's wrappers and recordings, where they need to know of environments that are Dora's or run batched."""

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

import numpy as np
import torch
from mani_skill import logger
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import common, sapien_utils, tree
from mani_skill.utils.registration import TimeLimitWrapper
from mani_skill.utils.wrappers import record
from mani_skill.utils.wrappers.cached_reset import CachedResetWrapper
from mani_skill.utils.wrappers.frame_stack import FrameStack
from mani_skill.utils.wrappers.record import RecordEpisode

from dora.arguments import as_tensor
from dora.configs import plain
from dora.errors import InputError
from dora.sim.batch.hooks import BACKEND, runs_batched
from dora.sim.batch.resets import checked_options
from dora.sim.cameras import check_cameras, check_names, check_settings, check_shown
from dora.sim.robot_agent import DescribedRobot

PACKAGE = "dora"
"""Name of this package, which an id such as "dora:PickCube-v1" imports."""
FORWARDED = ("num_envs", "single_action_space", "single_observation_space")
"""Attributes of the environment that `ManiSkillSB3VectorEnv` reads from what `gym.make` returns."""

_installed = False


def install_wrappers() -> None:
    """Wrap what this module mends in ManiSkill; further calls do nothing."""
    global _installed
    if _installed:
        return
    for owner, name, wrapper in (
        (record, "parse_env_info", _env_info),
        (RecordEpisode, "reset", _reset),
        (RecordEpisode, "step", _step),
        (common, "_batch", _batch),
        (CachedResetWrapper, "__init__", _cache),
        (FrameStack, "reset", _reset_of_frames),
        (BaseEnv, "render", _render),
        (BaseEnv, "_setup_sensors", _setup_sensors),
        (sapien_utils, "create_viewer", _create_viewer),
        (TimeLimitWrapper, "step", _step_of_time_limit),
    ):
        original = getattr(owner, name)
        setattr(owner, name, wraps(original)(wrapper(original)))
    for name in FORWARDED:
        setattr(TimeLimitWrapper, name, property(lambda self, name=name: self.env.get_wrapper_attr(name)))
    _installed = True


def _step_of_time_limit(original: Callable) -> Callable:
    def step(self: TimeLimitWrapper, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """ManiSkill's step; a simulation that is not finite is over, also for those who ignore terminations."""
        observation, reward, terminated, truncated, info = original(self, action)
        if runs_batched(self.base_env):
            truncated = truncated | info["nonfinite"]
        return observation, reward, terminated, truncated, info

    return step


# ---- how a recording says what it is of ----------------------------------------------------------


def opening_module(env: BaseEnv) -> str | None:
    """The module whose import makes an environment known to gymnasium; None if ManiSkill alone does.

    For environments of this package's tasks, with its robots or on `physx_cpu_batch`, it is the module where a user's
    task is defined (which has to import this package), and for others this package.
    """
    agents = getattr(env.agent, "agents", [env.agent])
    module = type(env).__module__
    ours = any(cls.__module__.split(".")[0] == PACKAGE for cls in type(env).__mro__)
    described = any(isinstance(agent, DescribedRobot) for agent in agents)
    if not (ours or described or env.backend.sim_backend == BACKEND):
        return None
    return PACKAGE if module.split(".")[0] in (PACKAGE, "mani_skill", "__main__") else module


def _env_info(original: Callable) -> Callable:
    def parse_env_info(env: Any) -> dict[str, Any] | None:
        """ManiSkill's entry with an id that opens by itself, such as "dora:DoraCube-v1", the back end in use, and
        arguments that JSON can hold."""
        info, base = original(env), env.unwrapped
        if info is None or (module := opening_module(base)) is None:
            return info
        kwargs = info["env_kwargs"] | {"sim_backend": base.backend.sim_backend}
        env_id = info["env_id"] if ":" in info["env_id"] else f"{module}:{info['env_id']}"
        return info | {"env_id": env_id, "env_kwargs": _jsonable(kwargs)}

    return parse_env_info


def _jsonable(kwargs: Mapping[str, Any]) -> dict[str, Any]:
    out = {}
    for name, value in kwargs.items():
        try:
            out[name] = _plain(value)
        except TypeError:
            logger.warning(f"The recording does not hold the argument {name!r}, which is a {type(value).__name__}.")
    return out


def _plain(value: Any) -> Any:
    """A value as JSON has it; TypeError if it has no such form."""
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(part) for part in value]
    if isinstance(value, np.generic | np.ndarray | torch.Tensor):
        return value.tolist()
    if dataclasses.is_dataclass(value) and not any(isinstance(part, torch.Tensor) for part in vars(value).values()):
        return _plain(plain(value))
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    json.dumps(value)
    return value


def _render(original: Callable) -> Callable:
    def render(self: BaseEnv, *args: Any, **kwargs: Any) -> Any:
        """ManiSkill's, or an InputError where nothing can be drawn."""
        if self.render_mode not in (None, "human") and not self.scene.can_render() and _is_ours(self):
            raise InputError(
                "nothing can be rendered: SAPIEN finds no Vulkan driver (see docs/rendering.md in the project), or "
                f"render_backend is {self.backend.render_backend!r}."
            )
        if self.render_mode == "sensors" and _is_ours(self):
            check_shown(self)
        return original(self, *args, **kwargs)

    return render


def _setup_sensors(original: Callable) -> Callable:
    def setup_sensors(self: BaseEnv, options: dict) -> None:
        """ManiSkill's, or an InputError where a camera is not as it has to be or a picture would be missing."""
        if not _is_ours(self):
            return original(self, options)
        configs = self._custom_sensor_configs or {}
        check_settings(configs)
        try:
            original(self, options)
        except (AttributeError, AssertionError):
            check_names(configs, self._sensor_configs)
            raise
        check_cameras(self)

    return setup_sensors


def _create_viewer(original: Callable) -> Callable:
    def create_viewer(*args: Any, **kwargs: Any) -> Any:
        """ManiSkill's window, or an InputError where none can be opened."""
        try:
            return original(*args, **kwargs)
        except RuntimeError as error:
            raise InputError(
                f'render_mode "human" opens a window, and none can be opened here ({error}): use a machine with a '
                'display, or render_mode "rgb_array".'
            ) from error

    return create_viewer


# ---- recording -----------------------------------------------------------------------------------


def _is_ours(env: Any) -> bool:
    return opening_module(env.unwrapped) is not None


def _reset(original: Callable) -> Callable:
    def reset(self: RecordEpisode, *args: Any, seed: Any = None, options: Any = None, **kwargs: Any) -> Any:
        """ManiSkill's, with seeds and `env_idx` in any form."""
        if _is_ours(self):
            options = checked_options(options, self.num_envs, self.base_env.device) or None
            seed = seed.tolist() if isinstance(seed, np.generic | np.ndarray | torch.Tensor) else seed
        return original(self, *args, seed=seed, options=options, **kwargs)

    return reset


def _reset_of_frames(original: Callable) -> Callable:
    def reset(self: FrameStack, seed: Any = None, options: Any = None) -> Any:
        """ManiSkill's, which refuses a partial reset, also one whose `env_idx` is a mask."""
        if _is_ours(self):
            options = checked_options(options, self.base_env.num_envs, self.base_env.device) or None
        return original(self, seed=seed, options=options)

    return reset


def _step(original: Callable) -> Callable:
    def step(self: RecordEpisode, action: Any) -> Any:
        """ManiSkill's, with actions in any form, which it stores as arrays."""
        if _is_ours(self) and action is not None and not isinstance(action, Mapping):
            action = as_tensor(action, "the action")
        return original(self, action)

    return step


def _batch(original: Callable) -> Callable:
    def batch(array: Any) -> Any:
        """ManiSkill's; numbers of numpy get two axes as those of Python do."""
        return np.array([[array]]) if isinstance(array, np.generic) and np.ndim(array) == 0 else original(array)

    return batch


def _cache(original: Callable) -> Callable:
    def init(self: CachedResetWrapper, *args: Any, **kwargs: Any) -> None:
        """ManiSkill's, which counts whole batches even where it stores a part of the last one."""
        original(self, *args, **kwargs)
        self._num_cached_resets = tree.shape(self._cached_resets_env_states, first_only=True)[0]

    return init
