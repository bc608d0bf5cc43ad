"""Geometry of catching and striking: where a falling hammer will be, and where the wrist must be to strike with it.

Poses are pairs (position (n, 3) [m], quaternion (n, 4) wxyz). The hammer's frame has its origin at the centre of mass,
the handle along z with the head at +z, and the striking face towards +x.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from dora.geometry.poses import Pose
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    quaternion_multiply,
)

GRAVITY = 9.81
"""Acceleration of a fall [m/s^2]."""
LATEST = 1.0
"""Longest fall that is predicted [s]."""
STEEP = 0.5
"""Vertical part of a handle's axis below which it is not followed any more [1]."""
ROUNDS = 4
"""Fixed-point iterations of the time of arrival [1]; the spin between them is small."""


def fall_time(height: Float[Tensor, " n"], speed: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Time [s] until a body that rises with `speed` [m/s] has fallen by `height` [m]; 0 if it is below already.

    The later root of height + speed t - g t^2 / 2 = 0, at most LATEST.
    """
    square = speed.square() + 2 * GRAVITY * height
    time = (speed + square.clamp(min=0).sqrt()) / GRAVITY
    return torch.where(square > 0, time, 0.0).clamp(0, LATEST)


def after_fall(
    body: Pose, velocity: Float[Tensor, "n 3"], spin: Float[Tensor, "n 3"], time: Float[Tensor, " n"]
) -> Pose:
    """Pose of a free body after a time [s]: p + v t - g t^2 / 2 and exp(w t) q, with constant spin [rad/s]."""
    t = time[:, None]
    drop = torch.zeros_like(velocity)
    drop[:, 2] = GRAVITY * time.square() / 2
    return body[0] + velocity * t - drop, quaternion_multiply(quaternion_from_rotation_vector(spin * t), body[1])


def arrival(
    body: Pose,
    velocity: Float[Tensor, "n 3"],
    spin: Float[Tensor, "n 3"],
    carried: Float[Tensor, "n 3"],
    height: Float[Tensor, " n"],
) -> Float[Tensor, " n"]:
    """Time [s] until a point of a falling body comes down to a height.

    Args:
        body: pose now; its origin is the centre of mass.
        velocity: of the centre of mass [m/s].
        spin: angular velocity [rad/s].
        carried: the point, in the body's frame [m].
        height: of the place where it is waited for [m].
    """
    time = torch.zeros_like(height)
    for _ in range(ROUNDS):
        lever = quaternion_apply(after_fall(body, velocity, spin, time)[1], carried)[:, 2]
        time = fall_time(body[0][:, 2] + lever - height, velocity[:, 2])
    return time


def slid(goal: Pose, axis: Float[Tensor, "n 3"], height: Float[Tensor, " n"]) -> Pose:
    """The pose moved along an axis of unit length until it is at a height; an axis near the horizontal is left."""
    steep = axis[:, 2].abs().clamp(min=STEEP) * torch.where(axis[:, 2] < 0, -1.0, 1.0)
    return goal[0] + axis * ((height - goal[0][:, 2]) / steep)[:, None], goal[1]


@dataclass(frozen=True)
class Strike:
    """A blow: the hammer turns about a horizontal axis at the height of the nail's head until its face meets it.

    Attributes:
        top: centre of the undriven nail's head (3,) [m], world frame.
        face: centre of the striking face (n, 3) [m], hammer frame.
        radius: distance of the axis from the nail [m].
        yaw: direction of the handle, from hand to head, about the vertical; 0 is +x [rad].
    """

    top: Tensor
    face: Tensor
    radius: float
    yaw: float = 0.0

    @cached_property
    def _along(self) -> Tensor:
        """Horizontal direction (3,) from hand to head."""
        yaw = torch.tensor(self.yaw)
        return torch.stack([yaw.cos(), yaw.sin(), torch.zeros(())]).to(self.top)

    @cached_property
    def _flat(self) -> Tensor:
        """Orientation (4,) of the hammer at impact: handle horizontal, face down."""
        down = torch.tensor([0.0, 0.0, -1.0]).to(self.top)
        return quaternion_from_matrix(torch.stack([down, torch.linalg.cross(self._along, down), self._along], -1))

    def hammer(self, depth: Float[Tensor, " n"], raised: Float[Tensor, " n"], gap: Float[Tensor, " n"] | float) -> Pose:
        """Pose of the hammer raised by an angle [rad] from where its face is `gap` [m] above the nail's head.

        `depth` [m] is how far the nail has sunk.
        """
        n = len(depth)
        top = self.top.repeat(n, 1)
        top[:, 2] += gap - depth
        axis = torch.linalg.cross(self._along, torch.tensor([0.0, 0.0, 1.0]).to(self.top))
        turn = quaternion_from_rotation_vector(axis * raised[:, None])
        pivot = top - self.radius * self._along
        quaternion = quaternion_multiply(turn, self._flat.expand(n, 4))
        face = pivot + quaternion_apply(turn, top - pivot)
        return face - quaternion_apply(quaternion, self.face), quaternion
