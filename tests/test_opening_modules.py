"""What has to be imported before a recording of an environment is opened."""

from types import SimpleNamespace
from typing import Any

import pytest
from mani_skill.envs.sapien_env import BaseEnv

from dora.sim import BACKEND
from dora.sim.robot_agent import DescribedRobot
from dora.sim.wrappers import opening_module
from dora.tasks import DoraEnv


def made(base: type, module: str, backend: str, described: bool) -> Any:
    """An environment of which only this is known."""
    kind = type("MyEnv", (base,), {"__module__": module, "agent": None, "backend": None})
    env = object.__new__(kind)
    env.agent = object.__new__(DescribedRobot) if described else SimpleNamespace()
    env.backend = SimpleNamespace(sim_backend=backend)
    return env


@pytest.mark.parametrize(
    ("base", "module", "backend", "described", "wanted"),
    [
        (BaseEnv, "mani_skill.envs.tasks", "physx_cpu", False, None),
        (BaseEnv, "mani_skill.envs.tasks", BACKEND, False, "dora"),
        (BaseEnv, "mani_skill.envs.tasks", "physx_cpu", True, "dora"),
        (DoraEnv, "dora.tasks.env.env", "physx_cpu", False, "dora"),
        (DoraEnv, "my_tasks.kitchen", "physx_cpu", False, "my_tasks.kitchen"),
        (BaseEnv, "my_tasks", "physx_cpu", True, "my_tasks"),
        (BaseEnv, "my_tasks", BACKEND, False, "my_tasks"),
        (BaseEnv, "my_tasks", "physx_cpu", False, None),
        (DoraEnv, "__main__", "physx_cpu", False, "dora"),
    ],
)
def test_a_users_task_is_opened_by_its_module(
    base: type, module: str, backend: str, described: bool, wanted: str | None
):
    assert opening_module(made(base, module, backend, described)) == wanted
