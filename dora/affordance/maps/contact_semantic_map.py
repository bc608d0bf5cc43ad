"""The paper's contact semantic map M_CoS: which part of the hand touches each point of an object's surface."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.signed_distance import CHANNELS, SignedDistanceField
from dora.geometry.rotations import matrix_from_quaternion
from dora.geometry.segments import distance_to_segment

CONTACT_DISTANCE = 5e-3
"""Distance between hand and surface below which they are in contact [m]."""
CHUNK = 2_000_000
"""Point-capsule pairs evaluated at once; bounds the memory."""
SLACK = 1e-4
"""Margin of the balls around capsules, above the error of distances that are computed by matrix products [m]."""


def contact_semantic_map(
    points: Float[Tensor, "p 3"],
    position: Float[Tensor, "c 3"],
    quaternion: Float[Tensor, "c 4"],
    joints: Float[Tensor, "c j"],
    hand: HandModel,
    contact_distance: float = CONTACT_DISTANCE,
) -> Int[Tensor, "c p"]:
    """M_CoS(p_i) = the part of the hand whose links are nearest to p_i, or 0 if farther than `contact_distance`.

    Args:
        points: (p, 3) points of the object's surface in the object frame [m].
        position: (c, 3) wrist in the object frame [m].
        quaternion: (c, 4) wrist in the object frame, wxyz.
        joints: (c, j) all hand joints, in the order of `RobotDescription.hand` [rad].
        hand: the hand.
        contact_distance: largest distance of a contact; points inside the hand are in contact [m].

    Returns:
        0 no contact, 1 palm, 2 thumb, 3 index, 4 middle, 5 ring, 6 pinky.
    """
    wrist = wrist_matrix(position.to(hand.lower), quaternion.to(hand.lower))
    poses = hand.forward(wrist, hand.robot.reduce_hand(joints.to(hand.lower)))
    ends = hand.place(poses, hand.ends)
    part = hand.part[hand.ends.body[0::2]]
    rows = max(1, CHUNK // (len(points) * len(part)))
    found = [
        _nearest_part(points.to(hand.lower), chunk[:, 0::2], chunk[:, 1::2], hand.radius, part, contact_distance)
        for chunk in ends.split(rows)
    ]
    return torch.cat(found)


def _nearest_part(
    points: Tensor, start: Tensor, end: Tensor, radius: Tensor, part: Tensor, contact_distance: float
) -> Tensor:
    """Contact class (c, p) of points (p, 3) by the nearest of k capsules with axes from `start` to `end` (c, k, 3).

    A capsule is compared with the points in the ball around it only.
    """
    (count, capsules, _), size = start.shape, len(points)
    ball = (end - start).flatten(0, 1).norm(dim=-1) / 2 + radius.repeat(count) + contact_distance + SLACK
    near = torch.cdist((start + end).flatten(0, 1) / 2, points) < ball[:, None]
    row, point = near.nonzero().unbind(1)
    capsule, cell = row % capsules, row.div(capsules, rounding_mode="floor") * size + point
    gap = distance_to_segment(points[point], start.flatten(0, 1)[row], end.flatten(0, 1)[row]) - radius[capsule]
    least = gap.new_full((count * size,), contact_distance).scatter_reduce_(0, cell, gap, "amin")
    winning = (gap < contact_distance) & (gap == least[cell])
    winner = capsule.new_full((count * size,), capsules)
    winner.scatter_reduce_(0, cell[winning], capsule[winning], "amin")
    return torch.cat([part, part.new_zeros(1)])[winner].view(count, size)


def pressed_contacts(
    hand: HandModel, field: SignedDistanceField, poses: Float[Tensor, "c b 4 4"]
) -> tuple[Float[Tensor, "c k 3"], Int[Tensor, "c k"]]:
    """Contact points of all spheres of the hand that overlap the object, and their contact classes.

    Args:
        hand: the hand.
        field: distance field of the object.
        poses: (c, b, 4, 4) poses of the bodies of the closed hand as from `HandModel.forward`, object frame [m].

    Returns:
        Points on the object in the object frame [m] and contact classes; k is the largest number of contacts of a
        row, and rows with fewer are padded with points of class 0.
    """
    centers = hand.place(poses, hand.spheres)
    value, _ = field.sample(centers.flatten(0, 1), CHANNELS)
    onto = centers - (value[:, :1] * value[:, 1:]).view_as(centers)
    pressed = value[:, 0].view(centers.shape[:2]) < hand.sphere_radius
    first = pressed.int().argsort(dim=1, descending=True, stable=True)[:, : int(pressed.sum(1).max())]
    part = torch.where(pressed, hand.part[hand.spheres.body], 0)
    return torch.take_along_dim(onto, first.unsqueeze(-1), 1), part.gather(1, first)


def wrist_matrix(position: Float[Tensor, "c 3"], quaternion: Float[Tensor, "c 4"]) -> Float[Tensor, "c 4 4"]:
    """Homogeneous matrix of a pose: position [m] and quaternion wxyz."""
    pose = torch.eye(4, dtype=position.dtype, device=position.device).repeat(len(position), 1, 1)
    pose[:, :3, :3] = matrix_from_quaternion(quaternion)
    pose[:, :3, 3] = position
    return pose
