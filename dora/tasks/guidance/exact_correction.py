"""The action that undoes the error of an episode's candidate: what the best possible policy would have to find out."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from dora.geometry.poses import Pose, compose
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_inverse,
    quaternion_multiply,
    rotation_vector_from_quaternion,
)
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.mdp.config import ResidualBounds


def exact_correction(
    choice: CandidateChoice,
    bounds: ResidualBounds,
    expand: Callable[[Tensor], Tensor],
    hand_size: int,
    frame: Pose | None = None,
) -> Float[Tensor, "n a"]:
    """The residual, in units of its bounds, with which the reference leads to the candidate as the set holds it.

    The error is the same during an episode and in the object frame, and residuals are in the frame of the hand, so this
    is one constant action. It is clipped to [-1, 1]: where it was beyond, the bounds are what stands in the way.

    Args:
        choice: candidates with their errors.
        bounds: of the residual action.
        expand: maps the action's hand part to all hand joints.
        hand_size: components of that part.
        frame: the object's true frame in the measured one, position (n, 3) [m] and wxyz, where a candidate is misplaced
            with its object.
    """
    held, b = choice.candidates, choice.buffers
    chosen = b.chosen.long()
    wrong = quaternion_inverse(b.quaternion[:, 0])
    right = held.position[chosen], held.quaternion[chosen]
    right = right if frame is None else compose(frame, right)
    shift = quaternion_apply(wrong, right[0] - b.position[:, 0]) / bounds.position
    turn = rotation_vector_from_quaternion(quaternion_multiply(wrong, right[1])) / bounds.rotation
    bend = (held.grasp[chosen] - b.grasp) / bounds.joint
    unit = torch.eye(hand_size, device=bend.device)
    effect = expand(unit) - expand(torch.zeros_like(unit))  # (action's part, joints): how a component moves the joints
    # The last digits of a solution depend on where its numbers lie in memory: in float64 they are rounded away.
    hand = torch.linalg.lstsq(effect.T.double(), bend.T.double()).solution.T.round(decimals=12).to(bend.dtype)
    return torch.cat([shift, turn, hand], -1).clamp(-1, 1)
