"""Inverse kinematics of the arm."""

import numpy as np
import pytest
import torch
from other_robots import changed, mounted
from placements import yaws

from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_matrix, rotation_angle
from dora.robot import SerialChain
from dora.robot.motion.inverse_kinematics import ANGLE_TOLERANCE, POSITION_TOLERANCE, InverseKinematics


def reachable_poses(kinematics, count):
    """Wrist poses of random postures above the table."""
    generator = torch.Generator().manual_seed(5)
    share = torch.rand(2 * count, 7, generator=generator)
    q = kinematics.lower + share * (kinematics.upper - kinematics.lower)
    position, rotation = kinematics.chain.tip_pose(q)
    above = (position[:, 2] > 0.05).nonzero()[:count, 0]
    return position[above], quaternion_from_matrix(rotation[above])


def test_solves_random_reachable_poses(robot, kinematics):
    position, quaternion = reachable_poses(kinematics, 1000)
    found = kinematics.solve(position, quaternion, seeds=4)
    assert found.solved.any(1).float().mean() >= 0.97
    best, solved = found.q[:, 0].double(), found.solved[:, 0]
    place, turn = SerialChain.of(robot, dtype=torch.float64).tip_pose(best)
    away = (place - position).norm(dim=1)[solved]
    angle = rotation_angle(quaternion.double(), quaternion_from_matrix(turn))[solved]
    assert away.max() < POSITION_TOLERANCE + 1e-6
    assert angle.max() < ANGLE_TOLERANCE + 1e-5
    assert ((found.q >= kinematics.lower) & (found.q <= kinematics.upper)).all()


def test_more_seeds_solve_more_and_cheaper(kinematics):
    position, quaternion = reachable_poses(kinematics, 400)
    few, many = (kinematics.solve(position, quaternion, seeds=n) for n in (1, 8))
    assert many.solved[:, 0].sum() > few.solved[:, 0].sum()
    assert many.solved[:, 0].float().mean() >= 0.985
    both = many.solved[:, 0] & few.solved[:, 0]
    assert many.cost[both, 0].mean() < few.cost[both, 0].mean() - 0.2


def test_seeds_are_near_their_targets(kinematics):
    found = kinematics.solve(*reachable_poses(kinematics, 200), seeds=4, iterations=0)
    assert found.position_error.median() < 0.2
    assert found.angle_error.median() < 0.6


def test_solutions_are_sorted_and_repeatable(robot, kinematics):
    position, quaternion = reachable_poses(kinematics, 100)
    a, b = (k.solve(position, quaternion) for k in (kinematics, InverseKinematics(robot)))
    assert torch.equal(a.q, b.q)
    solved = a.solved.int()
    assert (solved[:, 1:] <= solved[:, :-1]).all()
    both = a.solved[:, 1:]
    assert (a.cost[:, 1:] >= a.cost[:, :-1])[both].all()


def test_out_of_reach_is_finite_and_not_solved(kinematics):
    position = torch.tensor([[3.0, 0.0, 0.5], [0.0, 0.0, 5.0], [0.0, 0.0, 0.2856], [0.0, 0.0, 0.0]])
    found = kinematics.solve(position, yaws([0.0, 1.0, 2.0, 3.0]))
    assert found.q.isfinite().all()
    assert found.position_error.isfinite().all()
    assert not found.solved[:2].any()
    assert found.position_error[0].min() > 1.5


def test_tracking_keeps_to_a_line(kinematics):
    start = kinematics.start[None]
    position, rotation = kinematics.chain.tip_pose(start)
    line = position[:, None] - torch.linspace(0, 0.1, 6)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    path, tracked = kinematics.follow(start, line, quaternion_from_matrix(rotation)[:, None].expand(-1, 6, 4))
    assert tracked.all()
    places, _ = kinematics.chain.tip_pose(path[0])
    assert (places - line[0]).norm(dim=1).max() < POSITION_TOLERANCE
    assert (path[0, 1:] - path[0, :-1]).abs().max() < 0.3


def test_a_fixed_joint_before_the_first_one_changes_nothing(tmp_path, kinematics):
    other = InverseKinematics(changed(tmp_path / "mounted", mounted))
    torch.testing.assert_close(other._axis, kinematics._axis)
    poses = reachable_poses(kinematics, 100)
    torch.testing.assert_close(other.solve(*poses).q, kinematics.solve(*poses).q)


def test_a_start_posture_of_another_arm_is_refused(robot):
    with pytest.raises(InputError, match="6 joints"):
        InverseKinematics(robot, np.zeros(6))
