"""What the hammer task reads in addition, and the quantities that its stages, terms and observations share."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dora.geometry.rotations import quaternion_apply, quaternion_inverse
from dora.geometry.segments import distance_to_segment
from dora.tasks.mdp.quantities import in_wrist
from dora.tasks.mdp.snapshot import Snapshot, derived

HAND_CENTRE = (0.045, 0.0, 0.150)
"""Middle of what a closed hand holds, in the hand frame [m]."""
HANDLE_RADIUS = 0.0105
"""Radius of the handle, the smaller half axis of its oval [m]."""


@dataclass(frozen=True)
class HammerSnapshot(Snapshot):
    """A snapshot with the nail and the hammer's regions.

    Attributes:
        nail_p: centre of the nail's head now [m].
        nail_depth: how far the nail has sunk [m].
        nail_driven: how far it has been driven by blows [m].
        drift_p, drift_r: how far the hammer has moved in the hand within the last moments [m], [rad]; large before they
            are over.
        turned: by how much the fingers have turned the hammer about its handle since it was held still, relative to the
            palm and towards the blow [rad]; 0 before.
        way: 1 or -1, about which direction of the handle that is; 0 where the wrist re-orients the hammer.
        face: centre of the striking face, hammer frame [m].
        butt, neck: ends of the handle's axis, hammer frame [m].
    """

    nail_p: Float[Tensor, "n 3"]
    nail_depth: Float[Tensor, " n"]
    nail_driven: Float[Tensor, " n"]
    drift_p: Float[Tensor, " n"]
    drift_r: Float[Tensor, " n"]
    turned: Float[Tensor, " n"]
    way: Float[Tensor, " n"]
    face: Float[Tensor, "n 3"]
    butt: Float[Tensor, "n 3"]
    neck: Float[Tensor, "n 3"]


def _axis(s: Snapshot, x: float, y: float, z: float) -> Tensor:
    return quaternion_apply(s.object.q, torch.tensor([x, y, z], device=s.object.q.device).expand(len(s.object.q), 3))


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
    return s.nail_p - s.object.p - quaternion_apply(s.object.q, s.face)


def handle_distance(s: HammerSnapshot, point: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k"]:
    """Distance of points (world frame) from the handle's axis, a line between its two ends [m]."""
    q = quaternion_inverse(s.object.q)[:, None].expand(-1, point.shape[1], -1)
    local = quaternion_apply(q, point - s.object.p[:, None])
    return distance_to_segment(local, s.butt[:, None], s.neck[:, None])


@derived
def tip_distance(s: HammerSnapshot) -> Float[Tensor, "n fingers"]:
    """Distance of each fingertip's surface from the handle's [m]."""
    return handle_distance(s, s.hand.tip_p) - s.hand.tip_radius - HANDLE_RADIUS


@derived
def off_centre(s: HammerSnapshot) -> Float[Tensor, " n"]:
    """Distance of the middle of the hand from the handle's axis [m]."""
    centre = torch.tensor(HAND_CENTRE, device=s.hand.wrist_p.device).expand_as(s.hand.wrist_p)
    return handle_distance(s, (s.hand.wrist_p + quaternion_apply(s.hand.wrist_q, centre))[:, None])[:, 0]


@derived
def relative_speed(s: Snapshot) -> Float[Tensor, " n"]:
    """Speed of the hammer's centre of mass as seen from the hand [m/s]."""
    carried = s.hand.wrist_v + torch.linalg.cross(s.hand.wrist_w, s.object.p - s.hand.wrist_p)
    return (s.object.v - carried).norm(dim=-1)


@derived
def fingers_on(s: Snapshot) -> Float[Tensor, " n"]:
    """Number of fingers, the thumb included, that touch the hammer."""
    return s.hand.touch[:, :-1].float().sum(-1)


@derived
def nail_in_hand(s: HammerSnapshot) -> Float[Tensor, "n 3"]:
    """The nail's head in the hand frame [m]."""
    return in_wrist(s, s.nail_p)
