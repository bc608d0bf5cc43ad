"""The task suite. Importing it registers every Dora id with ManiSkill and gymnasium."""

import difflib
from typing import Any

import gymnasium as gym

from dora.errors import InputError
from dora.tasks import cube as cube
from dora.tasks import jug as jug
from dora.tasks.env.base import DoraEnv
from dora.tasks.hammer import env as _hammer  # noqa: F401


def task_ids() -> list[str]:
    """The registered Dora ids, sorted."""
    return sorted(i for i in gym.registry if i.startswith("Dora"))


def check_task_id(env_id: str) -> None:
    """Refuses ids that are not registered with an InputError, which names the nearest one that is."""
    if env_id not in task_ids():
        near = difflib.get_close_matches(env_id, task_ids(), 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"unknown environment {env_id!r}{hint} (known: {', '.join(task_ids())})")


def make_task(env_id: str, num_envs: int, guidance: str = "affordance", **options: Any) -> DoraEnv:
    """A bare batched task (no gymnasium wrappers), for learners.

    Args:
        env_id: a Dora id.
        num_envs: environments in the batch.
        guidance: "affordance" or "none".
        options: further arguments of the task.

    Raises:
        InputError: for an unknown id, or any option the task refuses.
    """
    check_task_id(env_id)
    options = {"obs_mode": "state", "reward_mode": "dense", "sim_backend": "physx_cpu_batch"} | options
    task = gym.make(env_id, num_envs=num_envs, guidance=guidance, **options).unwrapped
    assert isinstance(task, DoraEnv)
    return task
