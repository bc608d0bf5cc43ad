"""Rotations in pure torch: unit quaternions (w, x, y, z), matrices and rotation vectors, batched.

All functions accept any leading batch shape, keep dtype and device, and have finite gradients everywhere,
also at the identity and at half a turn. Rotation vectors are axis times angle [rad].
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

SMALL_ANGLE = 1e-4
"""Angle below which series replace quotients, with a relative error below 1e-16 [rad]."""


def quaternion_multiply(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*out 4"]:
    """Hamilton product a b: the rotation b followed by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        -1,
    )


def quaternion_inverse(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Inverse rotation of a unit quaternion (its conjugate)."""
    return torch.cat((q[..., :1], -q[..., 1:]), -1)


def quaternion_apply(q: Float[Tensor, "*#batch 4"], v: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*out 3"]:
    """Rotate vectors: v + 2 w (u x v) + 2 u x (u x v) for q = (w, u)."""
    u = q[..., 1:]
    t = 2 * torch.linalg.cross(u, v)
    return v + q[..., :1] * t + torch.linalg.cross(u, t)


def matrix_from_quaternion(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = q.unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quaternion_from_matrix(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion with w >= 0 of a rotation matrix.

    The symmetric matrix 4 q q^T is linear in the entries of the rotation matrix; its row with the largest
    diagonal is divided by that component, which is at least 1 of 4 and so never small.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    outer = (
        1 + a + e + i, h - f, c - g, d - b,
        h - f, 1 + a - e - i, b + d, c + g,
        c - g, b + d, 1 - a + e - i, f + h,
        d - b, c + g, f + h, 1 - a - e + i,
    )  # fmt: skip
    rows = torch.stack(outer, -1).unflatten(-1, (4, 4))
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1, keepdim=True)
    row = torch.take_along_dim(rows, largest.unsqueeze(-1), -2).squeeze(-2)
    q = row / row.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def quaternion_from_rotation_vector(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Exponential map: q = (cos(a/2), sin(a/2)/a v) with a = |v|."""
    square = (v * v).sum(-1, keepdim=True)
    small = square < SMALL_ANGLE**2
    angle = torch.where(small, 1.0, square).sqrt()
    factor = torch.where(small, 0.5 - square / 48, (0.5 * angle).sin() / angle)
    return torch.cat((torch.where(small, 1 - square / 8, (0.5 * angle).cos()), factor * v), -1)


def rotation_vector_from_quaternion(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Logarithm: rotation vector with angle in [0, pi] of a unit quaternion of either sign.

    The angle is 2 atan2(|u|, |w|), exact from 0 to pi.
    """
    q = torch.where(q[..., :1] < 0, -q, q)
    w, u = q[..., :1], q[..., 1:]
    square = (u * u).sum(-1, keepdim=True)
    small = square < (0.5 * SMALL_ANGLE) ** 2
    length = torch.where(small, 1.0, square).sqrt()
    factor = torch.where(small, 2 + square / 3, 2 * torch.atan2(length, w) / length)
    return factor * u


def matrix_from_rotation_vector(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix exp([v]x)."""
    return matrix_from_quaternion(quaternion_from_rotation_vector(v))


def rotation_angle(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*out"]:
    """Angle between two unit quaternions, from 0 to pi [rad]."""
    return rotation_vector_from_quaternion(quaternion_multiply(quaternion_inverse(a), b)).norm(dim=-1)


def quaternion_from_yaw(yaw: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 4"]:
    """Quaternion wxyz of a turn about the vertical, +z, by angles of any size and sign [rad]."""
    half = 0.5 * yaw
    zero = torch.zeros_like(half)
    return torch.stack((half.cos(), zero, zero, half.sin()), -1)


def yaw_of(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
    """Angle of the turn about the vertical, from -pi to pi [rad], of a unit quaternion wxyz of either sign.

    A tilt that comes after or before the turn does not change it; upside down, where there is no such angle, it is 0.
    """
    q = torch.where(q[..., :1] < 0, -q, q)
    return 2 * torch.atan2(q[..., 3], q[..., 0])


def quaternion_from_rpy(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Quaternion wxyz of URDF's fixed-axis angles [rad]: about x, then y, then z of the parent frame."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def rpy_from_z_axis(direction: Sequence[int | float]) -> tuple[float, float, float]:
    """Fixed-axis angles (roll 0, pitch, yaw) [rad] that rotate +z into `direction` (any length above 0)."""
    x, y, z = direction
    return 0.0, math.atan2(math.hypot(x, y), z), math.atan2(y, x) if x or y else 0.0
