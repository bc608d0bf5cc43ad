"""Registering a task: ManiSkill and gymnasium then make its environment by id."""

import copy
import dataclasses
from collections.abc import Callable

from gymnasium.envs.registration import EnvSpec, registry
from mani_skill.utils.registration import register_env

from dora.tasks.env.env import DoraEnv
from dora.tasks.env.task import Task

TASKS: dict[str, type[Task]] = {}
"""The registered tasks by their ids."""


def _without_wrappers(spec: EnvSpec, memo: dict) -> EnvSpec:
    """A copy of what is registered, without wrappers.

    `gymnasium.make_vec` copies it and refuses wrappers, which all ids of ManiSkill have for their time limit; the batch
    that it makes is made by `gymnasium.make`, which gives it its limit.
    """
    own = {field.name: getattr(spec, field.name) for field in dataclasses.fields(EnvSpec) if field.init}
    return EnvSpec(**copy.deepcopy({**own, "additional_wrappers": ()}, memo))


TaskSpec = type("TaskSpec", (EnvSpec,), {"__deepcopy__": _without_wrappers})
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
