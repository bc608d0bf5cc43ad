"""Commands of a hand in fewer numbers than it has joints.

Every finger bends with one number, which all of its joints but the first follow; the first joint of the thumb, which
moves it sideways, has a number of its own, and the first joints of the other fingers stay in the middle of their range.
A finger with a single joint bends with that one; a thumb of that kind does not move sideways.
That is the plainest choice of postural synergies (Santello et al. 1998): it knows nothing of an object or a grasp.
"""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.robot.description import RobotDescription


def synergy_count(robot: RobotDescription) -> int:
    """How many numbers command the hand: one for each finger, and one for the thumb's sideways joint."""
    return len(robot.fingers) + 1


@cache
def _synergies(robot: RobotDescription) -> Float[np.ndarray, "hand k"]:
    """Which joint follows which number: 1 or 0; the last column is the thumb's sideways joint."""
    fingers = [[robot.hand.names.index(name) for name in finger.joints] for finger in robot.fingers.values()]
    follows = np.zeros((len(robot.hand), synergy_count(robot)), np.float32)
    for number, (first, *bending) in enumerate(fingers):
        follows[bending or [first], number] = 1.0
    if len(fingers[0]) > 1:
        follows[fingers[0][0], -1] = 1.0
    return follows


def expand_fingers(robot: RobotDescription, command: Float[Tensor, "*n k"]) -> Float[Tensor, "*n hand"]:
    """Values of all hand joints, in units of half their ranges about the middle, from those of the synergies."""
    return command @ torch.from_numpy(_synergies(robot)).to(command).T


def reduce_fingers(robot: RobotDescription, hand: Float[Tensor, "*n hand"]) -> Float[Tensor, "*n k"]:
    """The synergies nearest to values of all hand joints: the mean over the joints that follow each."""
    follows = torch.from_numpy(_synergies(robot)).to(hand)
    return hand @ (follows / follows.sum(0).clamp(min=1))
