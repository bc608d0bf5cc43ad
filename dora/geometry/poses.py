"""Rigid poses as pairs (position [m], quaternion wxyz) of batched tensors: composition, differences, interpolation."""

import torch
from jaxtyping import Float
from torch import Tensor

from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_inverse,
    quaternion_multiply,
    rotation_vector_from_quaternion,
)

Pose = tuple[Tensor, Tensor]
"""Position (..., 3) [m] and orientation (..., 4), a unit quaternion wxyz, of one frame in another."""


def compose(a: Pose, b: Pose) -> Pose:
    """Pose b, given in frame a, in the frame of a: x = p_a + R_a p_b, q = q_a q_b."""
    return a[0] + quaternion_apply(a[1], b[0]), quaternion_multiply(a[1], b[1])


def relative(a: Pose, b: Pose) -> Pose:
    """Pose b in frame a, both given in one frame: `compose(inverse(a), b)`."""
    back = quaternion_inverse(a[1])
    return quaternion_apply(back, b[0] - a[0]), quaternion_multiply(back, b[1])


def inverse(a: Pose) -> Pose:
    """The frame in which a is given, in frame a."""
    back = quaternion_inverse(a[1])
    return -quaternion_apply(back, a[0]), back


def carried(
    position: Float[Tensor, "*#b k 3"],
    quaternion: Float[Tensor, "*#b k 4"],
    body_p: Float[Tensor, "b 3"],
    body_q: Float[Tensor, "b 4"],
) -> tuple[Float[Tensor, "b k 3"], Float[Tensor, "b k 4"]]:
    """World poses of k frames fixed in each of b bodies, the same k for all bodies or k of each.

    Args:
        position: of the frames in their body's frame [m].
        quaternion: of the frames in their body's frame, wxyz.
        body_p: of the bodies in the world [m].
        body_q: of the bodies in the world, wxyz.
    """
    each = body_q[:, None].expand(-1, position.shape[-2], 4)
    return (
        body_p[:, None] + quaternion_apply(each, position.expand(len(each), -1, 3)),
        quaternion_multiply(each, quaternion.expand(len(each), -1, 4)),
    )


def slew(start: Pose, goal: Pose, step: float | Float[Tensor, " n"], turn: float | Float[Tensor, " n"]) -> Pose:
    """From `start` towards `goal` on the straight line, by at most `step` [m] and `turn` [rad]; one number for all, or
    one for each."""
    shift = goal[0] - start[0]
    spin = rotation_vector_from_quaternion(quaternion_multiply(goal[1], quaternion_inverse(start[1])))
    steps = torch.maximum(shift.norm(dim=-1) / step, spin.norm(dim=-1) / turn).clamp(min=1)[:, None]
    quaternion = quaternion_multiply(quaternion_from_rotation_vector(spin / steps), start[1])
    return start[0] + shift / steps, quaternion / quaternion.norm(dim=-1, keepdim=True)


def blend(old: Pose, new: Pose, share: Float[Tensor, " n"] | float) -> Pose:
    """`old` moved towards `new` by a share of the difference, for nearby orientations (normalised mean)."""
    share = torch.as_tensor(share).reshape(-1, 1)
    same = torch.where((old[1] * new[1]).sum(-1, keepdim=True) < 0, -new[1], new[1])
    quaternion = old[1] + share * (same - old[1])
    return old[0] + share * (new[0] - old[0]), quaternion / quaternion.norm(dim=-1, keepdim=True)
