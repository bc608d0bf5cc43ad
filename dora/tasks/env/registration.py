"""Registering a task: ManiSkill and gymnasium then make its environment by id."""

import copy
import traceback
from collections.abc import Callable

from gymnasium.envs.registration import EnvSpec, make_vec, registry
from mani_skill.utils.registration import register_env

from dora.tasks.env.env import DoraEnv
from dora.tasks.env.task import Task

TASKS: dict[str, type[Task]] = {}
"""The registered tasks by their ids."""


def _deepcopy(spec: EnvSpec, memo: dict) -> EnvSpec:
    """A copy of what is registered; without wrappers if `gymnasium.make_vec` asks for it, which refuses any.

    All ids of ManiSkill have a wrapper, their time limit. What `make_vec` makes has its limit all the same: a batch is
    made by `gymnasium.make` from the registered id, and a single environment has gymnasium's own limit.
    """
    twin = copy.copy(spec)
    vars(twin).update(copy.deepcopy(vars(spec), memo))
    if any(frame.f_code is make_vec.__code__ for frame, _ in traceback.walk_stack(None)):
        twin.additional_wrappers = ()
    return twin


TaskSpec = type("TaskSpec", (EnvSpec,), {"__deepcopy__": _deepcopy})
"""A registered id of which `gymnasium.make_vec` makes a batch; no statement, because beartype cannot check a class of
gymnasium's."""


def register_task(env_id: str) -> Callable[[type[Task]], type[Task]]:
    """Registers a task with ManiSkill and gymnasium under an id, as a class decorator.

    Its environment class, a `DoraEnv`, has the task's docstring.
    """

    def register(task: type[Task]) -> type[Task]:
        """Makes and registers the environment class of a task, which is returned unchanged."""
        name = task.__name__.removesuffix("Task") + "Env"
        robots: list[str] = task.robots()
        supported = [tuple(robots)] if len(robots) > 1 else robots
        members = {"TASK": task, "__doc__": task.__doc__, "__module__": task.__module__, "SUPPORTED_ROBOTS": supported}
        env = type(name, (DoraEnv,), members)
        register_env(env_id, max_episode_steps=task.MAX_STEPS)(env)
        registry[env_id].__class__ = TaskSpec
        TASKS[env_id] = task
        return task

    return register
