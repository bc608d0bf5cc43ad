"""Postures of the hand around a grasp: opened before closing, and squeezing by commands beyond contact."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.hand.grasp_test_settings import STANDARD, GraspTestSettings
from dora.robot.description import RobotDescription


def pregrasp(
    robot: RobotDescription, joints: Float[Tensor, "*batch j"], test_settings: GraspTestSettings = STANDARD
) -> Float[Tensor, "*batch j"]:
    """The slightly open hand before closing: every flexing joint opened by `test_settings.opening`, within limits.

    Args:
        robot: the robot of the hand.
        joints: posture in contact, in the order of `robot.hand` [rad].
        test_settings: its `opening` is the angle.

    Returns:
        Commanded joints [rad], in the same order; coupled joints follow their leaders.
    """
    return _moved(robot, joints, -test_settings.opening * flexion(robot))


def squeeze(
    robot: RobotDescription, joints: Float[Tensor, "*batch j"], test_settings: GraspTestSettings = STANDARD
) -> Float[Tensor, "*batch j"]:
    """The command that closes every flexing joint by `test_settings.squeeze` beyond contact, within limits.

    The drives are springs: they press because contact keeps them from reaching the command. Arguments and result as
    in `pregrasp`.
    """
    return _moved(robot, joints, test_settings.squeeze * flexion(robot))


def flexion(robot: RobotDescription) -> Float[np.ndarray, " j"]:
    """Sign of the rotation that closes each hand joint, in the order of `robot.hand`; 0 for joints that do not flex.

    The first joint of a finger abducts it, unless it is the only one with a drive. The other joints are zero in the
    straight finger and close towards the limit that is farther from zero.
    """
    hand, followers = robot.hand, {coupling.follower for coupling in robot.couplings}
    sense = np.where(np.abs(hand.upper) >= np.abs(hand.lower), 1.0, -1.0)
    found = np.zeros(len(hand))
    for finger in robot.fingers.values():
        index = [hand.names.index(name) for name in finger.joints]
        spreads = sum(i not in followers for i in index) > 1
        flexing = index[1:] if spreads else index
        found[flexing] = sense[flexing]
    return found


def _moved(robot: RobotDescription, joints: Tensor, change: np.ndarray) -> Tensor:
    """Joints changed by `change` [rad], clamped to the limits; coupled joints follow, clamped to their own limits."""
    lower, upper = joints.new_tensor(robot.hand.lower), joints.new_tensor(robot.hand.upper)
    moved = torch.minimum(torch.maximum(joints + joints.new_tensor(change), lower), upper)
    coupled = robot.expand_hand(robot.reduce_hand(moved))
    return torch.minimum(torch.maximum(coupled, lower), upper)
