"""The task suite. Importing it registers every task found here with ManiSkill and gymnasium."""

import importlib
import pkgutil
from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from dora.configs import plain
from dora.errors import InputError, suggestion
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.options import numbers_under_preset, task_config
from dora.tasks.env.registration import TASKS
from dora.tasks.env.task import Task

ROOMS = ("env", "guidance", "mdp")
"""Packages here that are not tasks: every other module or package is one, found by its place."""


def discover() -> None:
    """Imports every task of this package, which registers it."""
    for found in pkgutil.iter_modules(__path__):
        if found.name not in ROOMS:
            importlib.import_module(f"{__name__}.{found.name}")


def task_ids() -> list[str]:
    """The registered Dora ids, sorted."""
    return sorted(i for i in gym.registry if i.startswith("Dora"))


def check_task_id(env_id: str) -> None:
    """Refuses ids that are not registered with an InputError, which names the nearest one that is."""
    if env_id not in task_ids():
        raise InputError(f"unknown environment {env_id!r}: {suggestion(env_id, task_ids())}")


def find_task(env_id: str) -> type[Task]:
    """What a registered id is about: its class of `Task`.

    Raises:
        InputError: for an unknown id.
    """
    check_task_id(env_id)
    return TASKS[env_id]


def present_rules() -> dict[str, int]:
    """Version of the rules of each task, by id (`TaskConfig.definition`)."""
    return {env_id: task_config(find_task(env_id).CONFIG, "standard", None).definition for env_id in task_ids()}


def options_under_preset(env_id: str, options: Mapping[str, Any], preset: str) -> dict[str, Any]:
    """Arguments of a task under another preset than theirs, which stands in the numbers of their `config` as well.

    Args:
        env_id: a Dora id.
        options: arguments of the task; `config` may be some of its numbers, or a whole configuration.
        preset: name of the other one.

    Raises:
        InputError: for an unknown id or preset.
    """
    config = options.get("config") or {}
    known = config if isinstance(config, Mapping) else plain(config)
    numbers = numbers_under_preset(find_task(env_id).CONFIG, known, options.get("preset", "standard"), preset)
    return {**options, "preset": preset, **({"config": numbers} if numbers else {})}


def make_task(env_id: str, num_envs: int, guidance: str = "affordance", **options: Any) -> DoraEnv:
    """A bare batched task (no gymnasium wrappers), for learners.

    Args:
        env_id: a Dora id.
        num_envs: environments in the batch.
        guidance: "affordance", "grasps" or "none".
        options: further arguments of the task.

    Raises:
        InputError: for an unknown id, or any option the task refuses.
    """
    check_task_id(env_id)
    options = {"obs_mode": "state", "reward_mode": "dense", "sim_backend": "physx_cpu_batch"} | options
    task = gym.make(env_id, num_envs=num_envs, guidance=guidance, **options).unwrapped
    assert isinstance(task, DoraEnv)
    return task


discover()
