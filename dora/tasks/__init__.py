"""The task suite. Importing it registers every Dora id with ManiSkill and gymnasium."""

import difflib
from typing import Any

import gymnasium as gym

from dora.errors import InputError
from dora.tasks import cube as cube
from dora.tasks.base import DoraEnv


def task_ids() -> list[str]:
    """The registered Dora ids, sorted."""
    return sorted(i for i in gym.registry if i.startswith("Dora"))


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
    if env_id not in task_ids():
        near = difflib.get_close_matches(env_id, task_ids(), 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"unknown environment {env_id!r}{hint} (known: {', '.join(task_ids())})")
    options = {"obs_mode": "state", "reward_mode": "dense"} | options
    backend = {"sim_backend": "physx_cpu_batch"} if "sim_backend" not in options else {}
    task = gym.make(env_id, num_envs=num_envs, guidance=guidance, **backend, **options).unwrapped
    assert isinstance(task, DoraEnv)
    return task
