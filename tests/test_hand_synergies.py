"""A hand that is commanded by the bend of each finger: which joints follow, and where that is allowed."""

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch
from refusals import refused

from dora.agents.checkpoint import read_checkpoint
from dora.policies.policy import TaskPolicy
from dora.robot import load_robot
from dora.robot.synergies import expand_fingers, reduce_fingers, synergy_count
from dora.sim.robot_agent import CONTROL_MODES, FINGERS
from dora.tasks import make_task

PAPER = ("observation", "reward", "filter")
"""The paper's own mechanism: guidance without a reference."""


@pytest.mark.parametrize("name", ["diana7_hit", "diana7_hit_left"])
def test_each_number_bends_one_finger_and_the_last_moves_the_thumb_aside(name: str):
    robot = load_robot(name)
    assert synergy_count(robot) == 6
    joints = expand_fingers(robot, torch.eye(6)).reshape(6, 5, 4)  # by number: finger, abduction to distal
    for number in range(5):
        expected = torch.zeros(5, 4)
        expected[number, 1:] = 1.0
        assert torch.equal(joints[number], expected)
    aside = torch.zeros(5, 4)
    aside[0, 0] = 1.0
    assert torch.equal(joints[5], aside)


def test_joints_that_follow_a_number_are_told_by_their_mean():
    robot = load_robot("diana7_hit")
    command = torch.randn(3, 6, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(reduce_fingers(robot, expand_fingers(robot, command)), command)
    hand = torch.zeros(1, 20)
    hand[0, 4:8] = torch.tensor([0.7, 0.3, 0.6, -0.3])  # the index finger; its first joint follows nothing
    torch.testing.assert_close(reduce_fingers(robot, hand), torch.tensor([[0.0, 0.2, 0.0, 0.0, 0.0, 0.0]]))


@pytest.mark.parametrize("options", [{"guidance": "none"}, {"guidance_parts": PAPER}])
def test_a_task_without_a_reference_takes_a_number_for_each_finger(options: dict[str, Any]):
    task = make_task("DoraCube-v1", 2, config={"hand_action": "fingers"}, **options)
    task.reset(seed=0)
    assert task.action_size == 12
    assert task.control_mode == CONTROL_MODES[0] + FINGERS
    controller = task.agent.wrist_controller
    action = torch.zeros(2, 12)
    action[:, 6:] = torch.tensor([-1.0, 1.0, 0.0, -1.0, -1.0, 1.0])
    for _ in range(25):
        task.step(action)
    low, high = (x.reshape(5, 4) for x in (controller.hand_lower, controller.hand_upper))
    middle, target = (low + high) / 2, controller.target[0, 7:].reshape(5, 4)
    bent = torch.stack([low[0], high[1], middle[2], low[3], low[4]])
    torch.testing.assert_close(target[:, 1:], bent[:, 1:])
    torch.testing.assert_close(target[:, 0], torch.cat([high[:1, 0], middle[1:, 0]]))
    task.close()


def test_the_control_mode_and_the_number_of_the_task_mean_the_same():
    task = make_task("DoraCube-v1", 1, "none", control_mode=CONTROL_MODES[0] + FINGERS)
    assert (task.action_size, task.config.hand_action) == (12, "fingers")
    task.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "too coarse"),
        ({"guidance_parts": ("prior",)}, "too coarse"),
        ({"guidance": "none", "hand_joints": 15}, "leave one of them out"),
        ({"guidance": "none", "control_mode": "pd_joint_pos"}, "leave one of them out"),
    ],
)
def test_where_a_number_for_each_finger_does_not_fit_it_is_refused(options: dict[str, Any], words: str):
    with refused(words):
        make_task("DoraCube-v1", 1, config={"hand_action": "fingers"}, **options)


@pytest.mark.parametrize(("hand", "words"), [("joints", "control mode"), ("fingers", "action size")])
def test_a_policy_of_fingers_is_told_from_one_of_joints(hand: str, words: str):
    """One that is said to be of fingers; where the control mode fits, what is wrong with it is its size."""
    path = sorted(Path("results/tasks/DoraCube-v1").glob("ppo-none-*/policy.safetensors"))[0]
    stored = read_checkpoint(path)
    config = dataclasses.replace(stored.config, task=stored.config.task | {"hand_action": "fingers"})
    policy = TaskPolicy(dataclasses.replace(stored, config=config), path)
    env = gym.make("DoraCube-v1", guidance="none", config={"hand_action": hand})
    with refused(f"was trained with {words}"):
        policy.check(env)
    env.close()
