"""f_reach of catching: with which grasps the waiting hand can receive an object that falls towards it."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.postures import flexion
from dora.geometry.poses import carried
from dora.geometry.rotations import quaternion_apply, rotation_angle
from dora.robot import RobotDescription
from dora.tasks.hammer.ballistics import slid

REACH = (0.16, 0.16)
"""Half extents of the area around the start in which the wrist waits for the hammer [m]."""
TURN = 0.6
"""Largest turn from the start's orientation while waiting [rad]."""


def within_reach(
    candidates: GraspCandidates,
    object_p: Float[Tensor, "b 3"],
    object_q: Float[Tensor, "b 4"],
    home_p: Float[Tensor, "1 3"],
    home_q: Float[Tensor, "1 4"],
) -> Bool[Tensor, "b c"]:
    """Which candidates the wrist can wait with, below an object that falls with its z axis nearly upright.

    The wrist keeps its height. The candidate is moved along the object's z axis, which comes down through the hand, to
    that height; then it must lie within `REACH` of the wrist's start and be turned by at most `TURN` against it.

    Args:
        candidates: c grasps in the object frame.
        object_p: where the object is [m], world frame.
        object_q: its orientation.
        home_p: the wrist's start [m], world frame.
        home_q: its orientation.
    """
    position, quaternion = carried(candidates.position, candidates.quaternion, object_p, object_q)
    b, c = position.shape[:2]
    up = torch.tensor([0.0, 0.0, 1.0], device=object_p.device).expand_as(object_p)
    axis = quaternion_apply(object_q, up).repeat_interleave(c, 0)
    goal = slid((position.flatten(0, 1), quaternion.flatten(0, 1)), axis, home_p[:, 2].expand(b * c))
    away = (goal[0] - home_p)[:, :2].abs()
    near = (away <= away.new_tensor(REACH)).all(-1)
    return (near & (rotation_angle(goal[1], home_q.expand(b * c, 4)) <= TURN)).view(b, c)


def with_waiting_hand(candidates: GraspCandidates, robot: RobotDescription, posture: str) -> GraspCandidates:
    """The same grasps before whose closing all flexing joints are as in a posture of the robot: wide open, to let
    something fall in between fingers and thumb. The joints that spread the fingers are the candidates'."""
    flexes = torch.tensor(flexion(robot) != 0, device=candidates.pregrasp.device)
    waiting = torch.tensor(robot.posture(posture).hand).to(candidates.pregrasp)
    return replace(candidates, pregrasp=torch.where(flexes, waiting, candidates.pregrasp))
