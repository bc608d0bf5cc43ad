"""What an episode begins with: resets to states of the simulator alone, seeds of some rows, drives."""

from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
import pytest
import torch

import dora.tasks as tasks
from dora.sim import BACKEND
from dora.sim.batch.resets import KINDS, START, STATES
from dora.tasks.env.env import DoraEnv

OURS: dict[str, Any] = {"sim_backend": BACKEND, "render_backend": "none", "preset": "none"}


@pytest.fixture(scope="module")
def cubes() -> Iterator[DoraEnv]:
    task = tasks.make_task("DoraCube-v1", 2, preset="none")
    yield task
    task.close()


def alone(state: Mapping[str, Any]) -> dict[str, Any]:
    """A state with what the simulator holds."""
    return {kind: state[kind] for kind in KINDS}


def test_an_episode_begins_where_a_state_of_the_simulator_is_set(cubes: DoraEnv):
    """It inherits nothing from the one that succeeded before it."""
    cubes.reset(seed=0)
    start, rows = alone(cubes.get_state_dict()), torch.tensor([1])
    for _ in range(100):
        info = cubes.step(cubes.scripted_action())[-1]
    assert info["success"].all()
    place = cubes.target_object.pose.p.clone()
    first = {kind: {name: values[rows] for name, values in part.items()} for kind, part in start.items()}
    _, info = cubes.reset(options={START: {STATES: first}, "env_idx": rows})
    for name in ("success", "finished", "success_at_end"):
        assert info[name].tolist() == [True, False], name
    assert info["stage"].tolist()[1] == 0
    assert info["penetration_max_mm"][1] == 0.0
    assert torch.equal(cubes.target_object.pose.p[0], place[0])
    assert cubes.target_object.pose.p[1, 2] < 0.04
    rise = cubes.snapshot.object.p - cubes.snapshot.object.start_p
    assert rise[1].abs().max() < 1e-6
    for _ in range(100):
        info = cubes.step(cubes.scripted_action())[-1]
    assert info["success"][1]  # the reference begins anew, too


def test_a_state_that_is_set_between_two_steps_leaves_the_episode_as_it_is(cubes: DoraEnv):
    cubes.reset(seed=0)
    start = alone(cubes.get_state_dict())
    for _ in range(100):
        cubes.step(cubes.scripted_action())
    cubes.set_state_dict(start)
    assert cubes.machine.finished.all()


def test_a_nail_that_is_set_with_the_simulator_has_not_been_driven():
    task = tasks.make_task("DoraHammer-v1", 1, preset="none", sim_backend="physx_cpu", guidance="none")
    task.reset(seed=0)
    nail: Any = task.task.nail
    nail._driven[:], nail._depth[:], nail._left[:] = 0.012, 0.012, 0.01
    for depth in (0.0, 0.02):
        nail.articulation.set_qpos(torch.tensor([[depth]]))
        state = alone(task.get_state_dict())
        nail.articulation.set_qpos(torch.tensor([[0.012]]))
        nail._driven[:], nail._left[:] = 0.012, 0.01
        task.reset(options={START: {STATES: state}})
        assert nail.depth.item() == pytest.approx(depth)
        assert (nail.driven.item(), nail._left.item()) == (0.0, 0.0)
        assert nail._joints[0].limits[0, 0] == pytest.approx(depth)
    task.close()


@pytest.mark.parametrize("determinism", [False, True])
def test_a_seed_of_some_rows_gives_their_episode_of_a_whole_reset(determinism: bool):
    env: Any = gym.make("DoraCube-v1", num_envs=2, enhanced_determinism=determinism, **OURS)
    env.reset(seed=[11, 7])
    wanted = env.unwrapped.target_object.pose.p.clone()
    env.reset(seed=[3, 4])
    env.reset(seed=7, options={"env_idx": [1]})
    assert torch.equal(env.unwrapped.target_object.pose.p[1], wanted[1])
    env.close()


def test_a_state_of_another_size_leaves_the_random_numbers_of_all():
    """Also outside a reset, where the scene is built anew for it."""
    places = []
    for changed in (False, True):
        task = tasks.make_task("DoraCube-v1", 2, preset="standard")
        task.reset(seed=0)
        state = task.get_state_dict()
        if changed:
            state["task"]["scale"] = state["task"]["scale"] + torch.tensor([[0.01], [0.0]])
        task.set_state_dict(state)
        assert task.scale[0].item() == pytest.approx(state["task"]["scale"][0].item())
        task.reset(options={"env_idx": [1]})
        places.append(task.target_object.pose.p[1].clone())
        task.close()
    assert torch.equal(*places)


@pytest.mark.parametrize("num_envs", [1, 2])
def test_no_action_holds_the_arm_from_the_first_step_on(num_envs: int):
    """Also where the drives were told something else in the episode before."""
    task = tasks.make_task("DoraCube-v1", num_envs, guidance="none", preset="none")
    task.reset(seed=0)
    action = torch.zeros(num_envs, task.action_size)
    for last in (False, True):
        before = task.snapshot.hand
        for _ in range(10):
            task.step(None)
        hand = task.snapshot.hand
        assert (hand.arm_q - before.arm_q).abs().max() < 0.02
        assert (hand.q - before.q).abs().max() < 0.05
        if not last:
            for _ in range(20):
                task.step(action + 1.0)
            task.reset()
    task.close()
