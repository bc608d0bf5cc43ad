"""One part of an evaluation of the energy again and again, to measure how long it takes and to see what it does."""

import numpy as np

from dora.affordance.search.native.compiling import native
from dora.affordance.search.native.energy import (
    CLOSING,
    CLOSURE,
    LIMITS,
    SELF,
    adam_step,
    closing,
    closure,
    contact_terms,
    limits,
    make_room,
    sphere_terms,
)
from dora.affordance.search.native.hand import forward, pull_back, self_penetration

PARTS = (
    "forward_kinematics",
    "distance_region",
    "closure",
    "closing",
    "penetration_table",
    "self_penetration",
    "limits",
    "gradient",
    "adam",
)
"""`distance_region` includes looking up the field at the contact points, of which closure is made, too; `closing` is
without the kinematics of the closed hand; `gradient` leads from forces on bodies to wrist and joints."""
_FORWARD, _TOUCH, _CLOSURE, _CLOSING, _SPHERES, _SELF, _LIMITS, _GRADIENT, _ADAM = range(len(PARTS))


@native
def repeat(part, times, hand, field, weights, plane, adam, wrist, joints, contacts):
    """Does one of `PARTS` (its index) `times` times for every candidate; arguments as of `descend`.

    Returns:
        The terms (c, terms) and the gradient (c, 6 + a) that the part makes, sums over `times` where it adds to them.
        `gradient` works on the forces of distance and region, `adam` on a gradient of ones, which it makes a step.
    """
    count, actuated = joints.shape
    terms, gradient = np.zeros((count, len(weights))), np.zeros((count, 6 + actuated))
    room, forces = make_room(hand, field, contacts.shape[1]), np.zeros((len(hand.axes) + 1, 6))
    pose, angles, mean, square = np.zeros((3, 4)), np.zeros(actuated), np.zeros(6 + actuated), np.zeros(6 + actuated)
    for row in range(count):
        pose[:], angles[:], mean[:], square[:] = wrist[row, :3], joints[row], 0.0, 0.0
        room.wrench[:] = 0.0
        forward(hand, pose, angles, 0.0, room.angles, room.poses)
        contact_terms(hand, field, weights, contacts[row], room, terms[row])
        terms[row], forces[:] = 0.0, room.wrench
        for _ in range(times):
            if part == _FORWARD:
                forward(hand, pose, angles, 0.0, room.angles, room.poses)
            elif part == _TOUCH:
                contact_terms(hand, field, weights, contacts[row], room, terms[row])
            elif part == _CLOSURE:
                terms[row, CLOSURE] = closure(1.0, hand.contact_body, contacts[row], room)
            elif part == _CLOSING:
                terms[row, CLOSING] = closing(hand, field, 1.0, room.poses, contacts[row], room.wrench)
            elif part == _SPHERES:
                sphere_terms(hand, field, weights, plane, room.poses, terms[row], room.wrench)
            elif part == _SELF:
                terms[row, SELF] = self_penetration(hand, 1.0, 0.0, room.poses, room.ends, room.wrench)
            elif part == _LIMITS:
                terms[row, LIMITS] = limits(hand, 1.0, room.angles, gradient[row])
            elif part == _GRADIENT:
                room.wrench[:] = forces
                pull_back(hand, room.poses, room.wrench, gradient[row])
            elif part == _ADAM:
                gradient[row] = 1.0
                adam_step(adam, 0, pose, angles, gradient[row], mean, square)
    return terms, gradient
