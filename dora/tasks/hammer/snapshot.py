"""What the hammer task reads in addition, and the quantities that its stages, terms and observations share."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dora.geometry.rotations import quaternion_apply, quaternion_inverse
from dora.tasks.mdp.snapshot import TIP_RADIUS, Snapshot, derived, in_wrist

GRIP = (0.045, 0.0, 0.150)
"""Middle of a closed grip in the hand frame [m]."""
HANDLE_RADIUS = 0.0105
"""Radius of the handle, the smaller half axis of its oval [m]."""
IN_HAND = 0.07
"""Distance of the handle's axis from the middle of the grip up to which the hammer is in the hand [m]."""


@dataclass(frozen=True)
class HammerSnapshot(Snapshot):
    """A snapshot with the nail and the hammer's regions.

    Attributes:
        nail_p: centre of the nail's head now [m].
        nail_depth: how far the nail has sunk [m].
        nail_driven: how far it has been driven by blows [m].
        drift_p, drift_r: how far the hammer has moved in the hand within the last WINDOW control steps [m], [rad];
            large before the window is full.
        face: centre of the striking face, hammer frame [m].
        butt, neck: ends of the handle's axis, hammer frame [m].
    """

    nail_p: Float[Tensor, "n 3"]
    nail_depth: Float[Tensor, " n"]
    nail_driven: Float[Tensor, " n"]
    drift_p: Float[Tensor, " n"]
    drift_r: Float[Tensor, " n"]
    face: Float[Tensor, "n 3"]
    butt: Float[Tensor, "n 3"]
    neck: Float[Tensor, "n 3"]


def _axis(s: Snapshot, x: float, y: float, z: float) -> Tensor:
    return quaternion_apply(s.object_q, torch.tensor([x, y, z], device=s.object_q.device).expand(len(s.object_q), 3))


@derived
def striking_axis(s: Snapshot) -> Float[Tensor, "n 3"]:
    """Direction in which the hammer strikes, world frame."""
    return _axis(s, 1.0, 0.0, 0.0)


@derived
def handle_axis(s: Snapshot) -> Float[Tensor, "n 3"]:
    """Direction of the handle towards the head, world frame."""
    return _axis(s, 0.0, 0.0, 1.0)


@derived
def misalignment(s: Snapshot) -> Float[Tensor, " n"]:
    """Angle between striking axis and nail axis, which points down [rad]."""
    return torch.acos((-striking_axis(s)[:, 2]).clamp(-1, 1))


@derived
def face_to_nail(s: HammerSnapshot) -> Float[Tensor, "n 3"]:
    """From the centre of the striking face to the nail's head [m], world frame."""
    return s.nail_p - s.object_p - quaternion_apply(s.object_q, s.face)


def handle_distance(s: HammerSnapshot, point: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k"]:
    """Distance of points (world frame) from the handle's axis, a line between its two ends [m]."""
    q = quaternion_inverse(s.object_q)[:, None].expand(-1, point.shape[1], -1)
    local = quaternion_apply(q, point - s.object_p[:, None]) - s.butt[:, None]
    along = (s.neck - s.butt)[:, None]
    share = ((local * along).sum(-1, keepdim=True) / along.square().sum(-1, keepdim=True)).clamp(0, 1)
    return (local - share * along).norm(dim=-1)


@derived
def tip_distance(s: HammerSnapshot) -> Float[Tensor, "n 5"]:
    """Distance of each fingertip's surface from the handle's [m]."""
    return handle_distance(s, s.tip_p) - TIP_RADIUS - HANDLE_RADIUS


@derived
def grip_distance(s: HammerSnapshot) -> Float[Tensor, " n"]:
    """Distance of the middle of the grip from the handle's axis [m]."""
    grip = torch.tensor(GRIP, device=s.wrist_p.device).expand_as(s.wrist_p)
    return handle_distance(s, (s.wrist_p + quaternion_apply(s.wrist_q, grip))[:, None])[:, 0]


@derived
def relative_speed(s: Snapshot) -> Float[Tensor, " n"]:
    """Speed of the hammer's centre of mass as seen from the hand [m/s]."""
    carried = s.wrist_v + torch.linalg.cross(s.wrist_w, s.object_p - s.wrist_p)
    return (s.object_v - carried).norm(dim=-1)


@derived
def fingers_on(s: Snapshot) -> Float[Tensor, " n"]:
    """Number of fingers, the thumb included, that touch the hammer."""
    return s.touch[:, :5].float().sum(-1)


@derived
def nail_in_hand(s: HammerSnapshot) -> Float[Tensor, "n 3"]:
    """The nail's head in the hand frame [m]."""
    return in_wrist(s, s.nail_p)
