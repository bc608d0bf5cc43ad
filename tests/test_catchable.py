"""f_reach of DoraHammer-v1: which grasps the waiting hand can catch with, and how it waits."""

from dataclasses import replace

import pytest
import torch

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.postures import flexion
from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_multiply
from dora.robot import load_robot
from dora.tasks.hammer.reach import REACH, TURN, with_waiting_hand, within_reach
from dora.tools.in_task.ranking import usable_in_task

HOME_P, HOME_Q = torch.tensor([[0.35, -0.2, 0.6]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
OBJECT_Q = torch.tensor([[1.0, 0.0, 0.0, 0.0]])


def wrists(positions: torch.Tensor, turns: torch.Tensor) -> GraspCandidates:
    """Grasps of an object at the origin of its frame, with these wrists."""
    count = len(positions)
    zeros, names = torch.zeros(count, 20), ("HandleGrasp",) * count
    turn = quaternion_from_rotation_vector(turns)
    return GraspCandidates("hammer", positions, turn, positions, zeros, zeros, names)


def test_a_grasp_is_within_reach_if_the_wrist_need_neither_go_nor_turn_far():
    offsets = torch.tensor([[0.0, 0, 0], [0.15, 0, 0], [0.17, 0, 0], [0, 0.17, 0], [0, 0, 0.3], [0, 0, 0], [0, 0, 0]])
    turns = torch.zeros(7, 3)
    turns[5, 2], turns[6, 2] = TURN - 0.01, TURN + 0.01
    mask = within_reach(wrists(offsets, turns), HOME_P, OBJECT_Q, HOME_P, HOME_Q)
    assert max(REACH) < 0.17
    assert mask.tolist() == [[True, True, False, False, True, True, False]]


def test_the_object_is_followed_along_its_own_axis_and_turns_the_grasp():
    tilt = quaternion_from_rotation_vector(torch.tensor([[0.0, 0.3, 0.0], [0.0, 0.0, TURN + 0.05]]))
    above = HOME_P + torch.tensor([[0.0, 0, 1.0]])
    grasps = wrists(torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, 0.2]]), torch.zeros(2, 3))
    mask = within_reach(grasps, above.expand(2, 3), tilt, HOME_P, HOME_Q)
    # a metre up, a handle tilted by 0.3 rad would come down 31 cm beside the hand
    assert mask.tolist() == [[False, False], [False, False]]
    near = HOME_P + torch.tensor([[0.03, 0.0, 0.1]])
    assert within_reach(grasps, near, tilt[:1], HOME_P, HOME_Q).all()


def test_the_hand_waits_open_and_spread_as_the_grasp_is():
    robot = load_robot("diana7_hit")
    grasps = load_candidates("hammer").select(slice(8))
    waiting, flexes = with_waiting_hand(grasps, robot, "catch"), torch.tensor(flexion(robot) != 0)
    torch.testing.assert_close(waiting.pregrasp[:, ~flexes], grasps.pregrasp[:, ~flexes])
    posture = torch.tensor(robot.postures["catch"].hand, dtype=torch.float32)
    assert (waiting.pregrasp[:, flexes] == posture[flexes]).all()
    assert (waiting.pregrasp[:, flexes] <= grasps.grasp[:, flexes]).float().mean() > 0.9
    torch.testing.assert_close(waiting.grasp, grasps.grasp)


def test_only_grasps_that_face_the_waiting_hand_can_be_used():
    assert usable_in_task("cube") is None
    usable, best = usable_in_task("hammer"), load_candidates("hammer").select([0])
    assert usable is not None
    half = quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, torch.pi]]))
    behind = replace(
        best,
        position=best.position * torch.tensor([-1.0, -1.0, 1.0]),
        quaternion=quaternion_multiply(half, best.quaternion),
    )
    assert usable(best).tolist() == [True]
    assert usable(behind).tolist() == [False]


def test_a_posture_that_the_robot_does_not_have_is_refused():
    with pytest.raises(InputError, match=r"'diana7_hit' has no posture 'nowhere'; add it to .*zero, home"):
        with_waiting_hand(load_candidates("cube").select([0, 1]), load_robot("diana7_hit"), "nowhere")
