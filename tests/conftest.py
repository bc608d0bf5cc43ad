"""Fixtures of the whole suite; one thread, because tests measure nothing and batches are small."""

import gc
import os
import random
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch
import type_checks

torch.set_num_threads(1)
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # with it each process of a test would compile all modules anew
sys.dont_write_bytecode = False
type_checks.install()

LONG = (
    "test_tasks.py", "test_agents_train.py", "test_run_failures.py", "test_adding_a_task.py", "test_nail.py",
    "test_cameras.py", "test_camera_settings.py",
)  # fmt: skip
"""Modules that take longest; they come first, so that no process is left with one of them when the others are done."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]):
    if not any("::" in each or each.endswith(".py") for each in config.args):  # else in the order of the names
        items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))


@pytest.fixture(scope="module", autouse=True)
def quick_collections():
    """What is alive before a module stays alive: out of the collector's sight a collection, of which every new scene
    takes three, is ten times quicker."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def types_of_first_calls():
    """Are checked in each test."""
    type_checks.next_test()


@pytest.fixture(autouse=True)
def same_random_numbers():
    """What a test draws does not depend on the tests before it."""
    torch.manual_seed(0)
    random.seed(0)


@pytest.fixture(scope="session")
def project_root(pytestconfig: pytest.Config):
    """The repository's root folder."""
    return pytestconfig.rootpath


@pytest.fixture(scope="session")
def robot():
    """The robot that comes with Dora; modules of ours are imported in fixtures only, when their types are checked."""
    from dora.robot import load_robot

    return load_robot("diana7_hit")


@pytest.fixture(scope="session")
def kinematics(robot):
    """Its inverse kinematics."""
    from dora.robot.motion.inverse_kinematics import InverseKinematics

    return InverseKinematics(robot)


@pytest.fixture
def materials() -> None:
    """Tasks of ManiSkill on its own back end make materials, which need stand-ins where there is no Vulkan driver. A
    batch puts them in place for the whole process, so without this a module would pass only after another one."""
    from dora.sim.batch.rendering import can_render, replace_materials

    if not can_render():
        replace_materials()
