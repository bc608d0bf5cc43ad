"""The references of the two arms: one opens the door and holds it, the other waits for it with the cube.

The left wrist moves as if it were fixed to the door, at most `lead` ahead of it. The right hand grasps the cube, turns
it so that the fingers point into the cavity, waits in front until the door is open far enough, puts the cube in, opens,
draws back against the direction of its approach, and leaves.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.geometry.poses import Pose, compose, relative
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_from_yaw,
    quaternion_multiply,
)
from dora.tasks.guidance.waypoints import Kept, Waypoint
from dora.tasks.microwave.snapshot import MicrowaveSnapshot, relative_turn


@dataclass(frozen=True, kw_only=True)
class OpenSettings:
    """Numbers of the reference that opens the door."""

    standoff: float = 0.10
    """Distance from the candidate's wrist position before the approach [m]."""
    clearance: float = 0.10
    """Distance by which the via point is farther from the door [m]."""
    speed: float = 0.45
    """Speed of the wrist on the way to the handle [m/s]."""
    descent: float = 0.15
    """Speed of the approach [m/s]."""
    closing_time: float = 0.6
    """Time from the pre-grasp to the closed hand [s]."""
    pull: float = 0.20
    """Speed of the wrist along the arc of the handle [m/s]."""
    lead: float = 0.16
    """Angle by which the wrist is led ahead of the door [rad]."""
    target: float = 1.45
    """Angle to which the door is opened [rad]."""
    lost: float = 0.08
    """Distance of the wrist from the candidate's live goal at which the handle has been lost [m]."""
    slack: float = 0.25
    """Angle that may be missing to the target when a lost handle is not grasped again [rad]."""


@dataclass(frozen=True, kw_only=True)
class PlaceSettings:
    """Numbers of the reference that puts the cube inside."""

    standoff: float = 0.10
    """Distance from the candidate's wrist position before the approach [m]."""
    speed: float = 0.45
    """Speed of the wrist in the open [m/s]."""
    descent: float = 0.15
    """Speed of the approach [m/s]."""
    closing_time: float = 0.6
    """Time between the open and the closed hand [s]."""
    raised: float = 0.035
    """Height of the cube above its place on the floor of the cavity while it is carried in [m]."""
    front: float = 0.17
    """Distance of the cube's centre from the front plane where the hand waits for the door [m]."""
    depth: float = 0.12
    """Depth at which the cube is put down [m]."""
    carry_at: float = 1.15
    """Angle of the door from which the cube is carried before the cavity: until then the left hand is in that place
    [rad]."""
    open_at: float = 1.2
    """Angle of the door from which the cube is carried in [rad]."""
    insertion: float = 0.25
    """Speed on the way in and out [m/s]."""
    lowering: float = 0.06
    """Speed at which the cube is lowered [m/s]."""
    above_floor: float = 0.004
    """Height above the floor at which it is let go [m]."""
    back_off: float = 0.07
    """Way against the approach after the hand has opened, before it leaves; straight out it would drag the cube [m]."""
    lost: float = 0.06
    """Distance of the wrist from the candidate's live goal at which the cube has been lost [m]."""


def before(s: MicrowaveSnapshot, _: Kept, back: float) -> Pose:
    """The candidate's wrist pose, drawn back against its approach [m]."""
    return s.goal.p - back * s.goal.approach, s.goal.q


def grasped(s: MicrowaveSnapshot, kept: Kept) -> Pose:
    """The candidate's wrist pose when the hand began to close."""
    return kept.goal


def opening(c: OpenSettings, hinge: Float[Tensor, " 3"]) -> list[Waypoint]:
    """The way of the arm that opens the door.

    Args:
        c: its numbers.
        hinge: a point of the hinge's axis in the microwave's frame [m].
    """

    def led(s: MicrowaveSnapshot, _: Kept) -> Pose:
        return with_door(s, hinge, (c.target - s.door).clamp(-c.lead, c.lead))

    def lost(s: MicrowaveSnapshot) -> Tensor:
        gone = (s.goal.p - s.hand.wrist_p).norm(dim=-1) > c.lost
        return gone & (s.door < c.target - c.slack)

    far = c.standoff + c.clearance
    return [
        Waypoint("via", partial(before, back=far), c.speed, arrived=(0.06, 0.4)),
        Waypoint("approach", partial(before, back=c.standoff), c.speed),
        Waypoint("descend", partial(before, back=0.0), c.descent, arrived=(0.012, 0.1)),
        Waypoint("close", grasped, c.descent, closed=1.0, keep=True, lost=lost, patience=0.2),
        Waypoint("pull", led, c.pull, closed=1.0, lost=lost),
    ]


def with_door(s: MicrowaveSnapshot, hinge: Float[Tensor, " 3"], angle: Float[Tensor, " n"]) -> Pose:
    """The candidate's wrist pose when the door has opened by a further angle (n,) [rad]."""
    axis = torch.zeros_like(s.oven_p)
    axis[:, 2] = -angle
    turn = quaternion_from_rotation_vector(quaternion_apply(s.oven_q, axis))
    at = s.oven_p + quaternion_apply(s.oven_q, hinge.expand_as(s.oven_p))
    return at + quaternion_apply(turn, s.goal.p - at), quaternion_multiply(turn, s.goal.q)


def placing(c: PlaceSettings, floor: float) -> list[Waypoint]:
    """The way of the arm that puts the cube inside.

    Args:
        c: its numbers.
        floor: height of the cavity's floor in the microwave's frame [m].
    """

    def carried_to(s: MicrowaveSnapshot, kept: Kept, x: float, height: float) -> Pose:
        turn = entry_turn(s, kept)
        q = quaternion_multiply(turn, kept.object[1])
        z = floor + s.object.half[:, 2] + height
        place = torch.stack([torch.full_like(z, x), torch.zeros_like(z), z], -1)
        return compose((s.oven_p + quaternion_apply(s.oven_q, place), q), relative(kept.object, kept.goal))

    def up(s: MicrowaveSnapshot, kept: Kept) -> Pose:
        p = kept.goal[0].clone()
        p[:, 2] += (s.oven_p[:, 2] + floor + s.object.half[:, 2] + c.raised) - kept.object[0][:, 2]
        return p, kept.goal[1]

    def back(s: MicrowaveSnapshot, kept: Kept) -> Pose:
        p, q = lowered(s, kept)
        approach = quaternion_apply(relative_turn(kept.goal[1], q), kept_approach(s, kept))
        return p - c.back_off * approach, q

    def kept_approach(s: MicrowaveSnapshot, kept: Kept) -> Tensor:
        """Direction of the approach in the world when the hand closed: the candidate's, turned with the cube since."""
        return quaternion_apply(relative_turn(s.object.q, kept.object[1]), s.goal.approach)

    def out(s: MicrowaveSnapshot, kept: Kept) -> Pose:
        """From where the hand has drawn back straight out of the cavity."""
        p, q = back(s, kept)
        way = torch.zeros_like(p)
        way[:, 0] = -(c.depth + c.front)
        return p + quaternion_apply(s.oven_q, way), q

    def opened(s: MicrowaveSnapshot, angle: float) -> Bool[Tensor, " n"]:
        return s.door > angle

    lowered = partial(carried_to, x=c.depth, height=c.above_floor)
    lost = _dropped(c.lost)
    way_in = partial(carried_to, x=c.depth, height=c.raised)
    return [
        Waypoint("reach", partial(before, back=c.standoff), c.speed),
        Waypoint("descend", partial(before, back=0.0), c.descent, arrived=(0.008, 0.08)),
        Waypoint("close", grasped, c.descent, closed=1.0, keep=True, patience=0.2),
        Waypoint("raise", up, 0.25, closed=1.0, arrived=(0.05, 0.3), lost=lost),
        Waypoint(
            "carry",
            partial(carried_to, x=-c.front, height=c.raised),
            c.speed,
            closed=1.0,
            lost=lost,
            ready=partial(opened, angle=c.carry_at),
        ),
        Waypoint("insert", way_in, c.insertion, closed=1.0, lost=lost, ready=partial(opened, angle=c.open_at)),
        Waypoint("lower", lowered, c.lowering, closed=1.0, patience=0.3),
        Waypoint("release", lowered, c.lowering, patience=0.1),
        Waypoint("back off", back, c.descent, arrived=(0.03, 0.3)),
        Waypoint("leave", out, c.insertion),
    ]


def _dropped(limit: float) -> Callable[[MicrowaveSnapshot], Bool[Tensor, " n"]]:
    """Whether the wrist is farther than `limit` [m] from where the candidate has it at the cube."""
    return lambda s: (s.goal.p - s.hand.wrist_p).norm(dim=-1) > limit


def entry_turn(s: MicrowaveSnapshot, kept: Kept) -> Float[Tensor, "n 4"]:
    """Turn about the vertical that makes the fingers of the grasped pose point into the cavity, wxyz."""
    ahead = torch.tensor([1.0, 0.0, 0.0], device=s.oven_q.device).expand_as(s.oven_p)
    fingers = torch.tensor([0.0, 0.0, 1.0], device=s.oven_q.device).expand_as(s.oven_p)
    into, now = quaternion_apply(s.oven_q, ahead), quaternion_apply(kept.goal[1], fingers)
    yaw = torch.atan2(into[:, 1], into[:, 0]) - torch.atan2(now[:, 1], now[:, 0])
    return quaternion_from_yaw(torch.remainder(yaw + torch.pi, 2 * torch.pi) - torch.pi)
