"""Contacts between groups of bodies, on one and on many environments."""

from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import pytest
import torch

import dora.sim
from dora.errors import InputError
from dora.sim.contacts import ContactMonitor

pytestmark = pytest.mark.usefixtures("materials")
GRAVITY = 9.81
"""m/s^2"""


def resting_cubes(backend: str, num_envs: int):
    env: Any = gym.make("StackCube-v1", num_envs=num_envs, sim_backend=backend, render_backend="none", obs_mode="none")
    env.reset(seed=0)
    scene = env.unwrapped.scene
    groups = {
        "a": [scene.actors["cubeA"]],
        "b": [scene.actors["cubeB"]],
        "table": [scene.actors["table-workspace"]],
    }
    monitor = ContactMonitor(scene, groups)
    for _ in range(10):
        env.step(None)
    return env, monitor


@pytest.mark.parametrize(("backend", "num_envs"), [("physx_cpu", 1), (dora.sim.BACKEND, 3)])
def test_the_table_carries_the_cubes(backend, num_envs):
    env, monitor = resting_cubes(backend, num_envs)
    contacts = monitor.read()
    weight = env.unwrapped.cubeA.mass[0] * GRAVITY * env.unwrapped.scene.timestep
    assert contacts.impulse.shape == (num_envs, 3, 3, 3)
    assert torch.allclose(contacts.impulse[:, 0, 2, 2], weight.expand(num_envs), rtol=0.02)
    assert torch.equal(contacts.impulse, -contacts.impulse.transpose(1, 2))
    assert (contacts.separation[:, 0, 2].abs() < 1e-3).all()
    assert (contacts.separation[:, 0, 1] == torch.inf).all()


@pytest.mark.parametrize(("backend", "num_envs"), [("physx_cpu", 1), (dora.sim.BACKEND, 2)])
def test_contacts_of_every_step_add_up(backend, num_envs):
    env, monitor = resting_cubes(backend, num_envs)
    scene = env.unwrapped.scene
    single = monitor.read().impulse[:, 0, 2, 2]
    groups = {"cube": [scene.actors["cubeA"]], "table": [scene.actors["table-workspace"]]}
    every = ContactMonitor(scene, groups, every_step=True)
    for _ in range(5):
        scene.step()
    assert torch.allclose(every.take().impulse[:, 0, 1, 2], 5 * single, rtol=0.05)
    assert (every.take().impulse == 0).all()  # taken


@pytest.mark.parametrize(("backend", "num_envs"), [("physx_cpu", 1), (dora.sim.BACKEND, 2)])
@pytest.mark.parametrize("every_step", [False, True])
def test_the_mean_contact_point_of_a_cube_is_below_its_centre(backend: str, num_envs: int, every_step: bool):
    """From either side, also where the groups are in the other order than the bodies of a contact."""
    env, monitor = resting_cubes(backend, num_envs)
    scene = env.unwrapped.scene
    assert monitor.read().point is None
    cube, table = [scene.actors["cubeA"]], [scene.actors["table-workspace"]]
    for groups in ({"cube": cube, "table": table}, {"table": table, "cube": cube}):
        placed = ContactMonitor(scene, groups, every_step=every_step)
        placed.keep_points()
        scene.step()
        point = placed.take().point
        assert point is not None
        assert torch.equal(point, point.transpose(1, 2))
        assert torch.allclose(point[:, 0, 1, :2], scene.actors["cubeA"].pose.p[:, :2], atol=1e-3)
        assert torch.allclose(point[:, 0, 1, 2], torch.zeros(num_envs), atol=2e-3)
        assert (point[:, 0, 0] == 0).all()


def test_a_body_in_two_groups_is_refused():
    env, _ = resting_cubes(dora.sim.BACKEND, 1)
    cube = env.unwrapped.scene.actors["cubeA"]
    with pytest.raises(InputError, match="cubeA"):
        ContactMonitor(env.unwrapped.scene, {"one": [cube], "two": [cube]})


def test_pairwise_and_net_impulses_equal_stock():
    stock, _ = resting_cubes("physx_cpu", 1)
    ours, _ = resting_cubes(dora.sim.BACKEND, 1)
    results = []
    for env in (stock, ours):
        scene = env.unwrapped.scene
        cube, table = scene.actors["cubeA"], scene.actors["table-workspace"]
        results.append(
            (
                scene.get_pairwise_contact_impulses(cube, table),
                scene.get_pairwise_contact_impulses(table, cube),
                cube.get_net_contact_forces(),
            )
        )
    for one, other in zip(*results, strict=True):
        assert one.abs().sum() > 0
        assert torch.equal(one, other)


def test_only_the_pairs_asked_for_are_read():
    env, _ = resting_cubes(dora.sim.BACKEND, 2)
    actors = env.unwrapped.scene.actors
    groups = {"a": [actors["cubeA"]], "b": [actors["cubeB"]], "table": [actors["table-workspace"]]}
    monitor = ContactMonitor(env.unwrapped.scene, groups, [("table", "a")])
    env.step(None)
    contacts = monitor.read()
    assert (contacts.impulse[:, 0, 2, 2] > 0).all()
    assert (contacts.impulse[:, 1, 2] == 0).all()
    assert torch.isinf(contacts.separation[:, 1, 2]).all()
    with pytest.raises(InputError, match="unknown group"):
        ContactMonitor(env.unwrapped.scene, groups, [("table", "c")])
    env.close()
