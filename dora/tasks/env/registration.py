"""Registering a task: ManiSkill and gymnasium then make its environment by id."""

from collections.abc import Callable

from mani_skill.utils.registration import register_env

from dora.tasks.env.env import DoraEnv
from dora.tasks.env.task import Task

TASKS: dict[str, type[Task]] = {}
"""The registered tasks by their ids."""


def register_task(env_id: str) -> Callable[[type[Task]], type[Task]]:
    """Registers a task with ManiSkill and gymnasium under an id, as a class decorator.

    Its environment class, a `DoraEnv`, has the task's docstring.
    """

    def register(task: type[Task]) -> type[Task]:
        name = task.__name__.removesuffix("Task") + "Env"
        members = {"TASK": task, "__doc__": task.__doc__, "__module__": task.__module__}
        env = type(name, (DoraEnv,), members)
        register_env(env_id, max_episode_steps=task.MAX_STEPS)(env)
        TASKS[env_id] = task
        return task

    return register
