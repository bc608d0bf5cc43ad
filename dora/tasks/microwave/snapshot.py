"""What the microwave task reads in addition, and the quantities that its stages, terms and observations share.

The microwave's frame: origin in its front plane at the bottom, +x into the cavity, +z up; the door's hinge is at +y.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.geometry.poses import Pose
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_inverse,
    quaternion_multiply,
    rotation_vector_from_quaternion,
)
from dora.geometry.segments import distance_to_segment
from dora.tasks.mdp.quantities import box_distance, in_wrist, thumb_and_finger, tips_in_object, turned_in_wrist
from dora.tasks.mdp.snapshot import Snapshot, derived

LEFT, RIGHT = "left", "right"
"""Names of the arms: the left one opens the door, the right one puts the cube inside."""
CAVITY = ((0.02, 0.32), (-0.18, 0.18), (0.02, 0.28))
"""The space between walls, floor and top in the microwave's frame [m]; along x from 20 mm behind the front plane, which
keeps the corners of a turned cube behind it, to the back wall."""


@dataclass(frozen=True)
class MicrowaveSnapshot(Snapshot):
    """A snapshot with the microwave.

    Attributes:
        oven_p, oven_q: pose of its frame in the world [m], wxyz; where it is observed, with an error that stays the
            same in the whole episode.
        door: angle of the door [rad], 0 when it is shut; where it is observed, that of the observed pose of the handle.
        door_speed: [rad/s], without error.
        wrists: positions of all wrists [m], world frame, in the order of the arms.
        tips_of_placer: positions of the right hand's fingertips [m], world frame.
        cube_p: centre of the cube [m], world frame.
        bar: ends of the axis of the handle's bar in the handle's frame, (2, 3) [m].
        bar_radius: [m].
        shut_q: orientation of the handle in the microwave's frame when the door is shut, wxyz (4,).
    """

    oven_p: Float[Tensor, "n 3"]
    oven_q: Float[Tensor, "n 4"]
    door: Float[Tensor, " n"]
    door_speed: Float[Tensor, " n"]
    wrists: Float[Tensor, "n arms 3"]
    tips_of_placer: Float[Tensor, "n fingers 3"]
    cube_p: Float[Tensor, "n 3"]
    bar: Float[Tensor, "2 3"]
    bar_radius: float
    shut_q: Float[Tensor, " 4"]

    def reobserved(self, located: Callable[[Pose], Pose]) -> "MicrowaveSnapshot":
        """The same with the observed pose of the microwave, the angle of the door that follows from it and from the
        observed pose of the handle, and the observed position of the cube."""
        oven_p, oven_q = located((self.oven_p, self.oven_q))
        shut = quaternion_multiply(oven_q, self.shut_q.expand_as(oven_q))
        turned = quaternion_multiply(quaternion_inverse(oven_q), relative_turn(shut, self.objects["microwave"].q))
        turned = quaternion_multiply(turned, oven_q)
        angle = -rotation_vector_from_quaternion(turned)[:, 2]  # the door opens against +z
        return replace(self, oven_p=oven_p, oven_q=oven_q, door=angle, cube_p=self.objects["cube"].p)


def relative_turn(a: Float[Tensor, "n 4"], b: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Rotation in the world that takes orientation a to b, wxyz."""
    return quaternion_multiply(b, quaternion_inverse(a))


def in_oven(s: MicrowaveSnapshot, point: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points of the world frame in the microwave's frame [m]."""
    return quaternion_apply(quaternion_inverse(s.oven_q), point - s.oven_p)


@derived
def cube_in_oven(s: MicrowaveSnapshot) -> Float[Tensor, "n 3"]:
    """Centre of the cube in the microwave's frame [m]."""
    return in_oven(s, s.cube_p)


@derived
def inside(s: MicrowaveSnapshot) -> Bool[Tensor, " n"]:
    """The centre of the cube is in the cavity, and at least half an edge from its front end. Asks for the right arm's
    view: the size is that of its object."""
    margin = s.object.half.amax(-1)
    p = cube_in_oven(s)
    (x0, x1), (y0, y1), (z0, z1) = CAVITY
    across = (p[:, 1] > y0) & (p[:, 1] < y1) & (p[:, 2] > z0) & (p[:, 2] < z1)
    return (p[:, 0] > x0 + margin) & (p[:, 0] < x1) & across


@derived
def hands_out(s: MicrowaveSnapshot) -> Bool[Tensor, " n"]:
    """Both wrists and all fingertips of the right hand are in front of the front plane; other links are not tested."""
    points = torch.cat([s.tips_of_placer, s.wrists], 1)
    q = quaternion_inverse(s.oven_q)[:, None].expand(-1, points.shape[1], -1)
    return quaternion_apply(q, points - s.oven_p[:, None])[..., 0].amax(-1) < 0.0


@derived
def handle_distance(s: MicrowaveSnapshot) -> Float[Tensor, "n fingers"]:
    """Distance of each of the left hand's fingertips from the surface of the handle's bar [m], negative inside."""
    return distance_to_segment(tips_in_object(s), s.bar[0], s.bar[1]) - s.bar_radius - s.hand.tip_radius


def is_left(s: Snapshot) -> bool:
    """Whether a snapshot is what the left arm sees."""
    return LEFT in s.hands


@derived
def region_distance(s: MicrowaveSnapshot) -> Float[Tensor, "n fingers"]:
    """Distance of an arm's fingertips from what it is to hold: the handle, or the cube [m]."""
    return handle_distance(s) if is_left(s) else box_distance(s)


@derived
def to_region(s: MicrowaveSnapshot) -> Float[Tensor, " n"]:
    """Distance of thumb and one more fingertip from what the arm is to hold [m]."""
    return thumb_and_finger(region_distance(s))


@derived
def oven_in_hand(s: MicrowaveSnapshot) -> Float[Tensor, "n 3"]:
    """Origin of the microwave's frame in the hand frame [m]."""
    return in_wrist(s, s.oven_p)


@derived
def into_oven_in_hand(s: MicrowaveSnapshot) -> Float[Tensor, "n 3"]:
    """Direction into the cavity in the hand frame [1]."""
    ahead = torch.tensor([1.0, 0.0, 0.0], device=s.oven_q.device).expand_as(s.oven_p)
    return turned_in_wrist(s, quaternion_apply(s.oven_q, ahead))


@derived
def object_in_oven(s: MicrowaveSnapshot) -> Float[Tensor, "n 3"]:
    """What the arm handles, the handle or the cube, in the microwave's frame [m]."""
    return in_oven(s, s.object.p)


@derived
def other_wrist_in_hand(s: MicrowaveSnapshot) -> Float[Tensor, "n 3"]:
    """The other arm's wrist in the hand frame [m]."""
    return in_wrist(s, s.wrists[:, 1 if is_left(s) else 0])
