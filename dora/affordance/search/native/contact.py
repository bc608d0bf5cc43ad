"""Contacts of the closing hand in compiled loops: normal and tangential springs with Coulomb friction.

When a sphere begins to touch the object, its tangential spring is anchored at that point of the object; the anchor
slides when the force reaches the friction limit. `dora.affordance.search.quasi_static_closing` describes the model.
"""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.search.native.compiling import inlined, native
from dora.affordance.search.native.field import distance_to, nearest_node_distance
from dora.affordance.search.native.hand import SMALLEST_LENGTH, add_force, point_of

STIFFNESS = 4e3
"""Stiffness of one sphere's contact, normal and tangential [N/m]; firm grasps overlap by millimetres."""
LARGEST_APPROACH = 6e-3
"""Upper bound of a sphere's approach to the object in one step, by which distant spheres are skipped [m]."""


class Contacts(NamedTuple):
    """Contact state of s spheres of the hand.

    `local` (s, 3) contact point in the frame of the sphere's body [m], `anchor` (s, 3) the point of the object to
    which the tangential spring is fixed, object frame [m], `touching` (s,), and `wait` (s,) steps to skip because the
    sphere is far from the object.
    """

    local: np.ndarray
    anchor: np.ndarray
    touching: np.ndarray
    wait: np.ndarray


@native
def object_contacts(hand, field, friction, contacts, poses, wrench):
    """Adds the contact forces of all spheres with the object to the wrenches on the bodies.

    Returns:
        Sum of the normal forces [N] and number of contacts.
    """
    body_of, centers, radii = hand.sphere_body, hand.sphere_local, hand.sphere_radius
    wait, touching = contacts.wait, contacts.touching
    total, count = 0.0, 0
    for s in range(len(body_of)):
        if wait[s] > 0:
            wait[s] -= 1
            continue
        body, radius = body_of[s], radii[s]
        point = point_of(poses, body, centers, s)
        beyond = nearest_node_distance(field, point) - radius - field.cull
        if beyond > 0.0:
            touching[s] = False
            wait[s] = int(beyond / LARGEST_APPROACH)
            continue
        value, slope = distance_to(field, point)
        depth = radius - value
        if depth <= 0.0:
            touching[s] = False
            continue
        length = max(math.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2), SMALLEST_LENGTH)
        n = (slope[0] / length, slope[1] / length, slope[2] / length)
        if not touching[s]:
            touching[s] = True
            _begin_contact(poses, body, point, n, radius, contacts.local, contacts.anchor, s)
        _add_contact_force(poses, body, s, n, STIFFNESS * depth, friction, contacts.local, contacts.anchor, wrench)
        total += STIFFNESS * depth
        count += 1
    return total, count


@inlined
def _add_contact_force(poses, body, s, n, normal, friction, local, anchor, wrench):
    """Adds the normal force `normal` [N] and the friction of one contact; moves the anchor when the contact slides."""
    here = point_of(poses, body, local, s)
    slip = (here[0] - anchor[s, 0], here[1] - anchor[s, 1], here[2] - anchor[s, 2])
    along = slip[0] * n[0] + slip[1] * n[1] + slip[2] * n[2]
    t = (slip[0] - along * n[0], slip[1] - along * n[1], slip[2] - along * n[2])
    size = STIFFNESS * math.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
    share = 1.0
    if size > friction * normal:
        share = friction * normal / size
        for i in range(3):
            anchor[s, i] = here[i] - share * t[i]
    k = share * STIFFNESS
    add_force(wrench, body, here, (k * t[0] - normal * n[0], k * t[1] - normal * n[1], k * t[2] - normal * n[2]))


@native
def table_contacts(body_of, centers, radius, plane, poses, wrench):
    """Adds the forces by which the table pushes spheres out."""
    nx, ny, nz, offset = plane[0], plane[1], plane[2], plane[3]
    for s in range(len(body_of)):
        body = body_of[s]
        point = point_of(poses, body, centers, s)
        depth = radius[s] - (nx * point[0] + ny * point[1] + nz * point[2] + offset)
        if depth > 0.0:
            k = -STIFFNESS * depth
            add_force(wrench, body, point, (k * nx, k * ny, k * nz))


@inlined
def _begin_contact(poses, body, point, n, radius, local, anchor, s):
    """Sets the anchor of a sphere that begins to touch, and the same point in the frame of the sphere's body."""
    for i in range(3):
        anchor[s, i] = point[i] - radius * n[i]
    for k in range(3):
        local[s, k] = 0.0
        for i in range(3):
            local[s, k] += poses[body, i, k] * (anchor[s, i] - poses[body, i, 3])
