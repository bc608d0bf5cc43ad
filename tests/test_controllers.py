"""The wrist controller follows paths, respects limits and never yields NaN."""

from collections.abc import Iterator
from math import pi

import pytest
import torch

import dora.tasks as tasks
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_multiply, rotation_angle
from dora.sim.controllers import LIMIT_MARGIN, WRIST_SPEED, WRIST_SPIN
from dora.tasks.env.env import DoraEnv
from dora.tasks.guidance.residual_action import wrist_step

PATH_STEPS = 60
PATH_RADIUS = 0.06
"""Radius of the circle that the wrist follows [m]."""
PATH_TILT = 0.25
"""Largest tilt along the path [rad]."""


@pytest.fixture(scope="module")
def task() -> Iterator[DoraEnv]:
    task = tasks.make_task("DoraCube-v1", 4, guidance="none", preset="none")
    yield task
    task.close()


def command(task: DoraEnv, wrist: torch.Tensor) -> torch.Tensor:
    hand = task.agent.wrist_controller.hand_action(task.snapshot.hand.target)
    return torch.cat([wrist, hand], -1)


def test_the_wrist_follows_a_path(task: DoraEnv, record_property):
    task.reset(seed=0)
    start_p, start_q = task.snapshot.hand.wrist_p.clone(), task.snapshot.hand.wrist_q.clone()
    controller, shifts, turns = task.agent.wrist_controller, [], []
    for t in range(PATH_STEPS + 8):
        phase = torch.tensor(2 * pi * min(t, PATH_STEPS) / PATH_STEPS)
        goal_p = start_p + PATH_RADIUS * torch.stack([phase.cos() - 1, phase.sin(), phase.sin() / 2])
        tilt = torch.stack([phase.sin(), torch.zeros(()), 1 - phase.cos()]) * PATH_TILT
        goal_q = quaternion_multiply(quaternion_from_rotation_vector(tilt).expand(4, 4), start_q)
        step = wrist_step(goal_p, goal_q, *controller.wrist(), limits=controller.wrist_limits)
        task.step(command(task, step))
        s = task.snapshot
        shifts.append((s.hand.wrist_p - goal_p).norm(dim=-1).max() * 1000)
        turns.append(torch.rad2deg(rotation_angle(s.hand.wrist_q, goal_q).max()))
    shift, turn = torch.stack(shifts), torch.stack(turns)
    record_property("tracking", f"moving {shift.max():.1f} mm {turn.max():.1f} deg, at rest {shift[-1]:.2f} mm")
    print(f"tracking: moving {shift.max():.1f} mm, {turn.max():.1f} deg; rest {shift[-1]:.2f} mm, {turn[-1]:.2f} deg")
    assert shift.max() < 15
    assert turn.max() < 5
    assert shift[-1] < 1.0
    assert turn[-1] < 0.5


@pytest.mark.parametrize("direction", [0, 1, 2])
def test_out_of_reach_and_singular_poses_stay_finite_and_within_limits(task: DoraEnv, direction: int):
    task.reset(seed=0)
    arm, controller = task.agent.description.arm, task.agent.wrist_controller
    push = torch.zeros(4, 6)
    push[:, direction] = torch.tensor([1.0, -1.0, 1.0, -1.0])
    push[2:, 3 + direction] = 1.0
    speed = torch.tensor(arm.velocity, dtype=torch.float32) / task.config.control_frequency
    for _ in range(70):
        before = controller.target[:, :7].clone()
        task.step(command(task, push))
        moved = (controller.target[:, :7] - before).abs()
        assert torch.isfinite(controller.target).all()
        assert (moved <= speed + 1e-4).all()
    lower, upper = (torch.tensor(x, dtype=torch.float32) for x in (arm.lower, arm.upper))
    assert (controller.target[:, :7] >= lower + LIMIT_MARGIN - 1e-5).all()
    assert (controller.target[:, :7] <= upper - LIMIT_MARGIN + 1e-5).all()
    assert torch.isfinite(task.snapshot.hand.arm_q).all()


def test_hand_targets_reach_what_was_asked_no_faster_than_allowed(task: DoraEnv):
    task.reset(seed=0)
    controller, hand = task.agent.wrist_controller, task.agent.description.hand
    action = torch.zeros(4, task.action_size)
    action[:, 6:] = 1.0
    limit = torch.tensor(hand.velocity, dtype=torch.float32) / task.config.control_frequency
    for _ in range(12):
        before = controller.target[:, 7:].clone()
        task.step(action)
        assert ((controller.target[:, 7:] - before).abs() <= limit + 1e-5).all()
    torch.testing.assert_close(controller.target[0, 7:], torch.tensor(hand.upper, dtype=torch.float32))


def test_commands_move_no_faster_than_their_share_and_the_drives_push_no_more():
    task = tasks.make_task(
        "DoraCube-v1",
        1,
        "none",
        preset="none",
        config={"hand_speed": 0.25, "arm_effort": 0.5, "hand_effort": 0.2, "wrist_speed": 0.1},
    )
    task.reset(seed=0)
    controller, robot = task.agent.wrist_controller, task.agent.description
    before = controller.target[:, 7:].clone()
    action = torch.ones(1, task.action_size)
    action[:, :6] = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, -1.0])
    assert controller.wrist_limits == pytest.approx(
        (0.1 * WRIST_SPEED * controller.dt, 0.1 * WRIST_SPIN * controller.dt)
    )
    p, q = controller.wrist()
    for _ in range(2):
        task.step(action)
    moved, turned = controller.wrist()[0] - p, rotation_angle(controller.wrist()[1], q)
    torch.testing.assert_close(moved, torch.tensor([[0.0, 0.0, 0.2 * WRIST_SPEED * controller.dt]]), atol=5e-4, rtol=0)
    torch.testing.assert_close(turned, torch.tensor([0.2 * WRIST_SPIN * controller.dt]), atol=1e-3, rtol=0)
    share = torch.tensor(robot.hand.velocity, dtype=torch.float32) * controller.dt / 4
    expected = torch.minimum(before + 2 * share, controller.hand_upper)
    torch.testing.assert_close(controller.target[:, 7:], expected)
    limits = [joint._objs[0].force_limit for joint in controller.joints]
    whole = torch.tensor([*robot.arm.effort, *robot.hand.effort], dtype=torch.float64)
    torch.testing.assert_close(torch.tensor(limits).double(), whole * torch.tensor([0.5] * 7 + [0.2] * 20))
    task.close()


def test_wrist_commands_are_rounded_as_in_stored_runs():
    """Products of 32-bit numbers at full speed, of exact ones at a share of it: one bit changes contacts."""
    for share, expected in ((1.0, torch.tensor([WRIST_SPEED, WRIST_SPIN]) * 0.05), (0.4, torch.tensor([0.012, 0.04]))):
        task = tasks.make_task("DoraCube-v1", 1, "none", config={"wrist_speed": share})
        assert torch.equal(task.agent.wrist_controller.wrist_scale[[0, 3]], expected)
        task.close()


def test_an_action_asks_for_the_joints_it_was_made_from(task: DoraEnv):
    controller = task.agent.wrist_controller
    joints = torch.rand(3, 20) * (controller.hand_upper - controller.hand_lower) + controller.hand_lower
    action = controller.hand_action(joints)
    back = controller.hand_lower + (action / 2 + 0.5) * (controller.hand_upper - controller.hand_lower)
    torch.testing.assert_close(back, joints)


def test_no_action_stops_a_wrist_whose_drives_are_told_velocities():
    task = tasks.make_task("DoraHammer-v1", 1, guidance="none", preset="none")
    task.reset(seed=0)
    arm = task.agent.robot._objs[0].active_joints[:7]

    def told() -> float:
        return max(abs(j.get_drive_velocity_target().item()) for j in arm)

    action = torch.zeros(1, task.action_size)
    action[:, 2] = 1.0
    task.step(action)
    assert told() > 0.1
    task.step(None)
    assert told() == 0.0
    task.close()


def test_what_an_episode_begins_with_is_commanded_and_other_resets_command_what_is_measured(task: DoraEnv):
    """Of a reset of two environments, which `begin` is told about, and of one without it."""
    task.reset(seed=0)
    controller = task.agent.wrist_controller
    held = controller.target.clone()
    joints, rows = controller.target[:2] + 0.02, torch.tensor([1, 3])
    controller.begin(rows, joints)
    controller.reset()
    torch.testing.assert_close(controller.target[rows], joints, atol=0, rtol=0)
    torch.testing.assert_close(controller.target[[0, 2]], held[[0, 2]], atol=0, rtol=0)
    controller.expect_reset(torch.tensor([False, True, False, False]))
    controller.reset()
    torch.testing.assert_close(controller.target[1], controller.qpos[1], atol=0, rtol=0)
    torch.testing.assert_close(controller.target[3], joints[1], atol=0, rtol=0)
    controller.reset()
    torch.testing.assert_close(controller.target, controller.qpos, atol=0, rtol=0)
