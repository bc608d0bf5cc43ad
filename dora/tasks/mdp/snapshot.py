"""What a one-arm task reads from the simulator: one frozen record per control step, world frame, SI units."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_inverse,
    quaternion_multiply,
    rotation_vector_from_quaternion,
)

FINGERS = ("thumb", "index", "middle", "ring", "pinky")
"""Finger order of every tensor with a finger axis."""
TIP_RADIUS = 0.011
"""Radius of a fingertip [m]."""


CONTACT_CLASSES = ("none", "palm", *FINGERS)
"""Names of the values of `Snapshot.contact_finger`."""


DERIVED, FROM_CONTACTS = "_derived", "_from_contacts"
"""Where a snapshot keeps what `derived` and `derived_from_contacts` functions have computed."""


@dataclass(frozen=True)
class Snapshot:
    """State of n environments after a control step. Poses are (position [m], quaternion wxyz).

    Attributes:
        arm_q: arm joints [rad].
        hand_q, hand_v: measured hand joints [rad], [rad/s].
        hand_target: commanded hand joints [rad].
        wrist_p, wrist_q, wrist_v, wrist_w: pose, linear [m/s] and angular velocity [rad/s] of the hand's base.
        tip_p, tip_q: fingertip poses.
        object_p, object_q, object_v, object_w: pose and velocities of the manipulated object.
        object_half: half extents of the object's box, or of its bounding box [m].
        start_p: object position at the start of the episode [m].
        touch: contact of each finger, then the palm, with the object during the last physics step.
        force: magnitude of those contacts' forces [N].
        supported: the object touches the world (table, stand).
        penetration: deepest overlap of hand and object, or of either with the world, now [m].
        max_penetration: the same, maximum over the episode [m].
        stage: index of the active stage; the number of stages when all are done.
        time: share of the episode that is over, 0 to 1.
        action, previous_action: last two actions, as given.
        goal_p, goal_q: wrist pose that the chosen candidate asks for now (it follows the object).
        goal_approach: unit direction of the wrist's last motion towards it, world frame.
        goal_pregrasp, goal_grasp: hand joints of that candidate [rad].
        near_p, near_q: the same poses for the nearest reachable candidates, the chosen one first.
        phase: the reference's phase, one-hot.
        correction: low-passed correction of the reference, in units of the bounds.
        contact_p: contact points of the hand on the object in the last physics step, object frame [m].
        contact_finger: what touches there: 0 nothing (an empty row), 1 palm, 2 thumb, ... 6 pinky.
    """

    arm_q: Float[Tensor, "n 7"]
    hand_q: Float[Tensor, "n 20"]
    hand_v: Float[Tensor, "n 20"]
    hand_target: Float[Tensor, "n 20"]
    wrist_p: Float[Tensor, "n 3"]
    wrist_q: Float[Tensor, "n 4"]
    wrist_v: Float[Tensor, "n 3"]
    wrist_w: Float[Tensor, "n 3"]
    tip_p: Float[Tensor, "n 5 3"]
    tip_q: Float[Tensor, "n 5 4"]
    object_p: Float[Tensor, "n 3"]
    object_q: Float[Tensor, "n 4"]
    object_v: Float[Tensor, "n 3"]
    object_w: Float[Tensor, "n 3"]
    object_half: Float[Tensor, "n 3"]
    start_p: Float[Tensor, "n 3"]
    touch: Bool[Tensor, "n 6"]
    force: Float[Tensor, "n 6"]
    supported: Bool[Tensor, " n"]
    penetration: Float[Tensor, " n"]
    max_penetration: Float[Tensor, " n"]
    stage: Int[Tensor, " n"]
    time: Float[Tensor, " n"]
    action: Float[Tensor, "n a"]
    previous_action: Float[Tensor, "n a"]
    goal_p: Float[Tensor, "n 3"]
    goal_q: Float[Tensor, "n 4"]
    goal_approach: Float[Tensor, "n 3"]
    goal_pregrasp: Float[Tensor, "n 20"]
    goal_grasp: Float[Tensor, "n 20"]
    near_p: Float[Tensor, "n k 3"]
    near_q: Float[Tensor, "n k 4"]
    phase: Float[Tensor, "n p"]
    correction: Float[Tensor, "n a"]
    contact_p: Float[Tensor, "n m 3"]
    contact_finger: Int[Tensor, "n m"]


S = TypeVar("S", bound=Snapshot)
"""A snapshot, perhaps one that a task has extended."""
Derived = Callable[[Any], Any]


def derived(function: Derived) -> Derived:
    """Computes a quantity of a snapshot once, however many terms, stages and observations ask for it.

    The quantity must not depend on `stage`, `phase` or `time`, which alone change when the machines advance.
    """
    return _once(function, DERIVED)


def derived_from_contacts(function: Derived) -> Derived:
    """The same for a quantity of contacts and the object's size alone, which the noise of sensors leaves as it is."""
    return _once(function, FROM_CONTACTS)


def _once(function: Derived, place: str) -> Derived:
    @wraps(function)
    def once(s: Snapshot) -> Any:
        known = s.__dict__.setdefault(place, {})
        if function not in known:
            known[function] = function(s)
        return known[function]

    return once


def advanced(s: S, **changes: Tensor) -> S:
    """The snapshot with another `stage`, `phase` or `time`; what was derived from it stays."""
    if not set(changes) <= {"stage", "phase", "time"}:
        raise ValueError(f"only stage, phase and time may change, not {sorted(changes)}")
    return _sharing(s, replace(s, **changes), DERIVED, FROM_CONTACTS)


def observed(s: S, **changes: Tensor) -> S:
    """The snapshot with noise in poses and joints; what was derived from contacts alone stays."""
    return _sharing(s, replace(s, **changes), FROM_CONTACTS)


def _sharing(old: S, new: S, *places: str) -> S:
    for place in places:
        new.__dict__[place] = old.__dict__.setdefault(place, {})
    return new


def in_wrist(s: Snapshot, point: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """World point -> hand-base frame [m]."""
    return quaternion_apply(quaternion_inverse(s.wrist_q), point - s.wrist_p)


def turned_in_wrist(s: Snapshot, vector: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """World direction -> hand-base frame (unit unchanged)."""
    return quaternion_apply(quaternion_inverse(s.wrist_q), vector)


@derived
def tips_in_object(s: Snapshot) -> Float[Tensor, "n 5 3"]:
    """Fingertips in the object frame [m]."""
    q = quaternion_inverse(s.object_q)[:, None].expand(-1, 5, -1)
    return quaternion_apply(q, s.tip_p - s.object_p[:, None])


@derived
def goal_error(s: Snapshot) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Position [m] and rotation vector [rad] from the wrist to the candidate's goal, in the hand-base frame."""
    turn = quaternion_multiply(quaternion_inverse(s.wrist_q), s.goal_q)
    return in_wrist(s, s.goal_p), rotation_vector_from_quaternion(turn)


@derived
def near_errors(s: Snapshot) -> Float[Tensor, "n k 6"]:
    """Position [m] and rotation vector [rad] from the wrist to each of the near candidates, in the hand-base frame."""
    back = quaternion_inverse(s.wrist_q)[:, None].expand_as(s.near_q)
    shift = quaternion_apply(back, s.near_p - s.wrist_p[:, None])
    return torch.cat([shift, rotation_vector_from_quaternion(quaternion_multiply(back, s.near_q))], -1)


@derived
def lifted(s: Snapshot) -> Float[Tensor, " n"]:
    """Height of the object above its start [m]."""
    return s.object_p[:, 2] - s.start_p[:, 2]


@derived
def opposed(s: Snapshot) -> Bool[Tensor, " n"]:
    """The thumb and at least one more finger touch the object."""
    return s.touch[:, 0] & s.touch[:, 1:5].any(-1)
