"""What a grasp candidate has to withstand: one protocol for every object, fixed before anything was tuned.

A candidate is a posture in contact. The hand starts with slightly opened fingers, closes beyond the posture so that
its drives squeeze, and must then hold the object, whatever the direction of gravity. docs/validation.md has the whole
protocol; this module has its numbers and the two postures, without a simulator.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.errors import InputError
from dora.robot.description import RobotDescription

DIRECTIONS = ((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))
"""Directions of gravity in the object frame at the candidate, one after the other."""


@dataclass(frozen=True)
class Protocol:
    """Numbers of the validation.

    Attributes:
        opening: how far the flexing joints are opened before closing [rad].
        squeeze: command of the flexing joints beyond contact [rad]; the same for all, because equal angles against
            drives whose stiffness falls towards the fingertip press the tip with about the same force.
        closing_time: time from the open hand to the first gravity [s]; weightless.
        closing_damping: rate at which the object's velocity decays while the hand closes [1/s]; stands for the
            friction of what the object rests on, so that the first finger to touch does not throw it.
        ramp: share of the closing time in which the command moves, linearly; it rests for the remainder.
        friction: coefficient between hand and object, of both materials.
        gravity: acceleration along each of `DIRECTIONS` [m/s^2].
        duration: time under each direction [s].
        displacement: largest distance of the object's centre of mass from where closing left it [m].
        penetration: deepest overlap of hand and object at the candidate, measured by geometry alone [m].
        strict_self_penetration: deepest overlap of the hand with itself at the candidate that is strictly valid [m].
        strict_shift: largest distance by which closing may move the centre of mass of a strictly valid one [m].
    """

    opening: float = 0.2
    squeeze: float = 0.3
    closing_time: float = 0.5
    closing_damping: float = 20.0
    ramp: float = 0.7
    friction: float = 0.7
    gravity: float = 9.81
    duration: float = 1.0
    displacement: float = 0.02
    penetration: float = 0.002
    strict_self_penetration: float = 0.002
    strict_shift: float = 0.02

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise InputError(f"the protocol's {field.name} must be a positive number; correct it.")
        if self.ramp > 1:
            raise InputError(f"the protocol's ramp is a share of the closing time, not {self.ramp}; use at most 1.")


STANDARD = Protocol()
"""The protocol of every number in the docs."""


def pregrasp(
    robot: RobotDescription, joints: Float[Tensor, "*batch j"], protocol: Protocol = STANDARD
) -> Float[Tensor, "*batch j"]:
    """The slightly open hand before closing: every flexing joint opened by `protocol.opening`, within limits.

    Args:
        robot: whose hand it is.
        joints: posture in contact, in the order of `robot.hand` [rad].
        protocol: has the amount.

    Returns:
        Commanded joints [rad]; couplings hold.
    """
    return _moved(robot, joints, -protocol.opening * flexion(robot))


def squeeze(
    robot: RobotDescription, joints: Float[Tensor, "*batch j"], protocol: Protocol = STANDARD
) -> Float[Tensor, "*batch j"]:
    """The command that closes the hand beyond the posture in contact, so that the drives press, within limits.

    Arguments and result as in `pregrasp`.
    """
    return _moved(robot, joints, protocol.squeeze * flexion(robot))


def flexion(robot: RobotDescription) -> Float[np.ndarray, " j"]:
    """Sense in which each hand joint closes: +1 or -1, and 0 for joints that do not flex.

    A finger's first joint spreads it, unless it is the only one with a drive. The others close towards the limit
    that is farther from zero, as straight fingers are zero.
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
    """Drives moved by `change` within the limits; followers at what their leaders say, within theirs."""
    lower, upper = joints.new_tensor(robot.hand.lower), joints.new_tensor(robot.hand.upper)
    moved = torch.minimum(torch.maximum(joints + joints.new_tensor(change), lower), upper)
    coupled = robot.expand_hand(robot.reduce_hand(moved))
    return torch.minimum(torch.maximum(coupled, lower), upper)
