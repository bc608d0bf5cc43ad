"""Rigid poses as pairs (position [m], unit quaternion wxyz): composition, relative pose, inverse; batched.

Positions have shape (..., 3) and quaternions (..., 4); leading shapes broadcast. Dtype and device are kept.
"""

from __future__ import annotations

from torch import Tensor

from dora.geometry.rotations import quaternion_apply, quaternion_inverse, quaternion_multiply

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
