"""Contacts of the closing hand in compiled loops: springs across and along the surface, with Coulomb friction.

A sphere that begins to touch the object holds on to a point of it until friction lets it slide;
`dora.affordance.search.quasi_static_closing` says what is modelled.
"""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.search.native.compiling import inlined, native
from dora.affordance.search.native.field import coarse, distance_to
from dora.affordance.search.native.hand import SMALL, point_of, push

STIFFNESS = 4e3
"""Of the contact of one sphere, across and along the surface [N/m]; grips overlap by millimetres then."""
APPROACH = 6e-3
"""Distance [m] that a sphere comes nearer to the object in one step at most; those far away wait."""


class Contacts(NamedTuple):
    """Of each sphere of the hand: its material point in contact, the object's point there, whether it touches, and
    how many steps it waits because it is far away."""

    local: np.ndarray
    anchor: np.ndarray
    touching: np.ndarray
    wait: np.ndarray


@native
def touch(hand, field, friction, contacts, poses, wrench):
    """Contacts of all spheres with the object: their forces go to the wrench; returns the sum of normal forces [N] and
    the number of contacts."""
    body_of, centers, radii = hand.sphere_body, hand.sphere_local, hand.sphere_radius
    wait, touching = contacts.wait, contacts.touching
    total, count = 0.0, 0
    for s in range(len(body_of)):
        if wait[s] > 0:
            wait[s] -= 1
            continue
        body, radius = body_of[s], radii[s]
        point = point_of(poses, body, centers, s)
        beyond = coarse(field, point) - radius - field.cull
        if beyond > 0.0:
            touching[s] = False
            wait[s] = int(beyond / APPROACH)
            continue
        value, slope = distance_to(field, point)
        depth = radius - value
        if depth <= 0.0:
            touching[s] = False
            continue
        length = max(math.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2), SMALL)
        n = (slope[0] / length, slope[1] / length, slope[2] / length)
        if not touching[s]:
            touching[s] = True
            _hold_on(poses, body, point, n, radius, contacts.local, contacts.anchor, s)
        _push_out(poses, body, s, n, STIFFNESS * depth, friction, contacts.local, contacts.anchor, wrench)
        total += STIFFNESS * depth
        count += 1
    return total, count


@inlined
def _push_out(poses, body, s, n, normal, friction, local, anchor, wrench):
    """A contact's normal force [N] and Coulomb friction, whose anchor follows when it slides."""
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
    push(wrench, body, here, (k * t[0] - normal * n[0], k * t[1] - normal * n[1], k * t[2] - normal * n[2]))


@native
def rest_on(body_of, centers, radius, plane, poses, wrench):
    """The table pushes spheres out."""
    nx, ny, nz, offset = plane[0], plane[1], plane[2], plane[3]
    for s in range(len(body_of)):
        body = body_of[s]
        point = point_of(poses, body, centers, s)
        depth = radius[s] - (nx * point[0] + ny * point[1] + nz * point[2] + offset)
        if depth > 0.0:
            k = -STIFFNESS * depth
            push(wrench, body, point, (k * nx, k * ny, k * nz))


@inlined
def _hold_on(poses, body, point, n, radius, local, anchor, s):
    """A sphere begins to touch: its material point and the object's point there."""
    for i in range(3):
        anchor[s, i] = point[i] - radius * n[i]
    for k in range(3):
        local[s, k] = 0.0
        for i in range(3):
            local[s, k] += poses[body, i, k] * (anchor[s, i] - poses[body, i, 3])
