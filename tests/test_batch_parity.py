"""Every environment of a batch behaves bit for bit like a stock single environment on a CPU."""

from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import numpy as np
import pytest
import torch

import dora.sim
from dora.tasks import make_task

pytestmark = pytest.mark.usefixtures("materials")
STEPS = 100
TASKS = (
    "PickCube-v1",
    "PegInsertionSide-v1",  # merged actors
    "RotateValveLevel2-v1",  # articulated object, other shape in each environment
    "TriFingerRotateCubeLevel1-v1",  # dexterous
    "TwoRobotStackCube-v1",  # two robots
    "MS-HopperHop-v1",  # floating base, net contact forces
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("StackCube-v1", "PullCubeTool-v1", "MS-AntWalk-v1")),
)


def make(env_id: str, backend: str, num_envs: int = 1, **kwargs) -> Any:
    return gym.make(env_id, num_envs=num_envs, sim_backend=backend, render_backend="none", obs_mode="state", **kwargs)


def numbers(value) -> list[np.ndarray]:
    """All arrays in nested dictionaries and tuples, as float32 or what they are, in order; stock has no `nonfinite`."""
    if isinstance(value, dict):
        return [array for key in sorted(set(value) - {"nonfinite"}) for array in numbers(value[key])]
    if isinstance(value, tuple | list):
        return [array for part in value for array in numbers(part)]
    return [np.asarray(value)]


def assert_equal(one, other, what: str) -> None:
    for first, second in zip(numbers(one), numbers(other), strict=True):
        np.testing.assert_array_equal(first, second, err_msg=what)


@pytest.mark.parametrize("env_id", TASKS)
def test_one_environment_equals_stock_from_reset_on(env_id):
    stock, ours = make(env_id, "physx_cpu"), make(env_id, dora.sim.BACKEND)
    for episode in range(2):
        assert_equal(stock.reset(seed=episode), ours.reset(seed=episode), "reset")
        stock.action_space.seed(episode)
        for step in range(STEPS):
            action = stock.action_space.sample()
            assert_equal(stock.step(action), ours.step(action), f"episode {episode}, step {step}")
    assert_equal(stock.unwrapped.get_state_dict(), ours.unwrapped.get_state_dict(), "state")


def test_touching_hand_equals_stock():
    """The sensed impulses are equal up to rounding: stock takes their norm in float64 on a CPU."""
    env_id = "RotateSingleObjectInHandLevel0-v1"
    stock, ours = make(env_id, "physx_cpu"), make(env_id, dora.sim.BACKEND)
    stock.reset(seed=0)
    ours.reset(seed=0)
    stock.action_space.seed(0)
    for _ in range(STEPS):
        action = stock.action_space.sample()
        one, other = stock.step(action)[0], ours.step(action)[0]
        np.testing.assert_allclose(one, other, rtol=1e-6)
        assert_equal(stock.unwrapped.get_state_dict(), ours.unwrapped.get_state_dict(), "state")


@pytest.mark.parametrize("control_mode", ["pd_joint_pos", "pd_ee_delta_pose", "pd_joint_delta_pos_vel"])
def test_other_controllers_equal_stock(control_mode):
    """Absolute targets, inverse kinematics, and targets of position and velocity."""
    stock = make("PickCube-v1", "physx_cpu", control_mode=control_mode)
    ours = make("PickCube-v1", dora.sim.BACKEND, control_mode=control_mode)
    assert_equal(stock.reset(seed=3), ours.reset(seed=3), "reset")
    stock.action_space.seed(3)
    for step in range(20):
        action = stock.action_space.sample()
        assert_equal(stock.step(action), ours.step(action), f"step {step}")


def row(value, i: int):
    if isinstance(value, dict):
        return {key: row(part, i) for key, part in value.items()}
    return value[i : i + 1]


def test_every_row_of_a_batch_equals_stock():
    """Each row is followed by a stock environment that starts in its state and takes its actions."""
    rows = 3
    ours = make("PickCube-v1", dora.sim.BACKEND, rows)
    ours.reset(seed=5)
    start = ours.unwrapped.get_state_dict()
    ours.unwrapped.set_state_dict(start)  # as below: setting a root pose rounds it
    ours.unwrapped.agent.controller.reset()
    generator = np.random.default_rng(0)
    actions = generator.uniform(-1, 1, (40, *ours.action_space.shape)).astype(np.float32)
    states = []
    for action in actions:
        ours.step(action)
        states.append(ours.unwrapped.get_state_dict())
    stock = make("PickCube-v1", "physx_cpu")
    for i in range(rows):
        stock.reset(seed=5)
        stock.unwrapped.set_state_dict(row(start, i))
        stock.unwrapped.agent.controller.reset()
        for action, state in zip(actions, states, strict=True):
            stock.step(action[i])
            assert_equal(stock.unwrapped.get_state_dict(), row(state, i), f"row {i}")


@pytest.mark.slow
def test_two_robots_of_ours_equal_stock_in_every_row_until_they_hold_handle_and_cube():
    """Random corrections of a reference that takes the handle with one hand and the cube with the other; rewards
    are sums that are added up in another order with more rows."""
    seeds = [6, 7, 8]
    ours = make_task("DoraMicrowave-v1", len(seeds), preset="standard")
    stock = make_task("DoraMicrowave-v1", 1, preset="standard", sim_backend="physx_cpu")
    before = ours.reset(seed=seeds)[0]
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (90, ours.action_size)).astype(np.float32)
    results = [ours.step(torch.as_tensor(action).expand(len(seeds), -1)) for action in actions]
    touched: set[str] = set()
    for i, seed in enumerate(seeds):
        assert_equal(stock.reset(seed=[seed])[0], before[i : i + 1], f"row {i}, reset")
        for step, (action, result) in enumerate(zip(actions, results, strict=True)):
            observation, reward, *_ = stock.step(torch.as_tensor(action)[None])
            assert_equal(observation, result[0][i : i + 1], f"row {i}, step {step}")
            np.testing.assert_allclose(reward, result[1][i : i + 1], atol=1e-6)
        assert_equal(
            stock.get_state_dict()["articulations"], row(ours.get_state_dict(), i)["articulations"], f"row {i}"
        )
        touched |= {arm for arm, hand in stock.snapshot.hands.items() if hand.touch[0, :-1].any()}
    assert touched == {"left", "right"}, "a parity without contacts says little"


def test_state_copied_into_all_rows_gives_identical_rows():
    env = make("StackCube-v1", dora.sim.BACKEND, 4)
    env.reset(seed=1)
    state = env.unwrapped.get_state_dict()
    same = {
        kind: {name: values[:1].expand_as(values).clone() for name, values in states.items()}
        for kind, states in state.items()
        if kind in ("actors", "articulations")
    }
    env.unwrapped.set_state_dict(same)
    env.unwrapped.agent.controller.reset()
    action = torch.as_tensor(env.action_space.sample())[:1].expand(4, -1)
    for _ in range(30):
        env.step(action)
    for values in numbers(env.unwrapped.get_state_dict()):
        assert (values == values[:1]).all()
