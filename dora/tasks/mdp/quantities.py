"""Quantities of a snapshot that stages, terms and observations of several tasks share; computed once each."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_inverse,
    quaternion_multiply,
    rotation_vector_from_quaternion,
)
from dora.tasks.mdp.snapshot import Snapshot, derived


def in_wrist(s: Snapshot, point: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """World point -> hand-base frame [m]."""
    return quaternion_apply(quaternion_inverse(s.hand.wrist_q), point - s.hand.wrist_p)


def turned_in_wrist(s: Snapshot, vector: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """World direction -> hand-base frame (unit unchanged)."""
    return quaternion_apply(quaternion_inverse(s.hand.wrist_q), vector)


@derived
def tips_in_object(s: Snapshot) -> Float[Tensor, "n fingers 3"]:
    """Fingertips in the object frame [m]."""
    q = quaternion_inverse(s.object.q)[:, None].expand(-1, s.hand.tip_p.shape[1], -1)
    return quaternion_apply(q, s.hand.tip_p - s.object.p[:, None])


@derived
def box_distance(s: Snapshot) -> Float[Tensor, "n fingers"]:
    """Distance of each fingertip's surface from a box-shaped object's [m], negative inside (box SDF)."""
    outside = tips_in_object(s).abs() - s.object.half[:, None]
    sdf = outside.clamp(min=0).norm(dim=-1) + outside.amax(-1).clamp(max=0)
    return sdf - s.hand.tip_radius


@derived
def goal_error(s: Snapshot) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Position [m] and rotation vector [rad] from the wrist to the candidate's goal, in the hand-base frame."""
    turn = quaternion_multiply(quaternion_inverse(s.hand.wrist_q), s.goal.q)
    return in_wrist(s, s.goal.p), rotation_vector_from_quaternion(turn)


@derived
def nearest_errors(s: Snapshot) -> Float[Tensor, "n k 6"]:
    """Position [m] and rotation vector [rad] from the wrist to each of the near candidates, in the hand-base frame."""
    back = quaternion_inverse(s.hand.wrist_q)[:, None].expand_as(s.goal.nearest_q)
    shift = quaternion_apply(back, s.goal.nearest_p - s.hand.wrist_p[:, None])
    return torch.cat([shift, rotation_vector_from_quaternion(quaternion_multiply(back, s.goal.nearest_q))], -1)


@derived
def lifted(s: Snapshot) -> Float[Tensor, " n"]:
    """Height of the object above its start [m]."""
    return s.object.p[:, 2] - s.object.start_p[:, 2]


@derived
def opposed(s: Snapshot) -> Bool[Tensor, " n"]:
    """The thumb and at least one more finger touch the object."""
    return s.hand.touch[:, 0] & s.hand.touch[:, 1:-1].any(-1)


def thumb_and_finger(distance: Float[Tensor, "n fingers"]) -> Float[Tensor, " n"]:
    """The larger of the thumb's distance and that of the nearest finger [m], 0 inside."""
    near = distance.clamp(min=0)
    return torch.maximum(near[:, 0], near[:, 1:].amin(-1))


def rise(s: Snapshot, height: float) -> Float[Tensor, " n"]:
    """Share of a height [m] by which the object has risen, saturating."""
    return (lifted(s) / height).clamp(0, 1)


def off_table(s: Snapshot, height: float = 0.02) -> Bool[Tensor, " n"]:
    """The object has left the table: it has risen by more than `height` [m]."""
    return lifted(s) > height
