"""The handle of a microwave's door: a vertical bar on two posts, on a piece of the door.

The door's outer surface is the plane x = 0 and the bar stands along z at +x, until it is moved to its centre of mass.
"""

from __future__ import annotations

import math

import numpy as np
import trimesh

from dora.affordance.objects.affordance_object import AffordanceObject, Piece, assemble, moved
from dora.affordance.objects.solids import capsule_between, chamfered_box, ellipses, sweep, unite
from dora.robot.shapes import Shape

BAR_MASS, DOOR_MASS = 0.16, 0.18
DOOR = (0.014, 0.070, 0.250)
CHAMFER = 0.002
BAR_RADIUS, BAR_HALF_LENGTH = 0.008, 0.092
"""The half length excludes the round ends."""
BAR_X = 0.048
"""Distance of the bar's axis from the door: 40 mm of room for fingers."""
POST_RADIUS, POST_Z, POST_DEPTH = 0.0065, 0.080, 0.004
"""The posts start inside the door at this depth."""
ON_BACK = (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0)
"""Quaternion (wxyz) that turns +x up."""
POINTS, DOME, STEPS = 24, 6, 40
"""Divisions around the bar, over a round end, and along the bar."""
HANDLE, DOOR_REGION = range(2)


def build() -> AffordanceObject:
    """The handle; it rests on the back of the door, bar above."""
    bar = _rounded_bar()
    posts = [_post(z) for z in (-POST_Z, POST_Z)]
    door = moved(chamfered_box(DOOR, CHAMFER, subdivisions=3), np.array([-DOOR[0] / 2, 0, 0]))
    mesh, part, _ = unite([door, bar, *posts])
    handle = unite([bar, *posts])[0]
    ends = np.array([[BAR_X, 0, -BAR_HALF_LENGTH], [BAR_X, 0, BAR_HALF_LENGTH]])
    feet = [np.array([[-POST_DEPTH, 0, z], [BAR_X, 0, z]]) for z in (-POST_Z, POST_Z)]
    x, y, z = (size / 2 for size in DOOR)
    return assemble(
        "microwave",
        mesh,
        np.where(part == 0, DOOR_REGION, HANDLE),
        {"handle": "HandleGrasp", "door": "BodyGrasp"},
        target="handle",
        weights=[(handle, BAR_MASS), (door, DOOR_MASS)],
        pieces=[
            Piece("handle", capsule_between(ends[0], ends[1], BAR_RADIUS)),
            *(Piece("handle", capsule_between(foot[0], foot[1], POST_RADIUS)) for foot in feet),
            Piece("door", Shape("box", (-x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (x, y, z))),
        ],
        rest=ON_BACK,
        placement="fixture",
    )


def _rounded_bar() -> trimesh.Trimesh:
    """The bar with round ends."""
    angle = np.linspace(0.06, np.pi / 2, DOME)
    cap_z, cap_r = BAR_RADIUS * np.cos(angle), BAR_RADIUS * np.sin(angle)
    straight = np.linspace(-BAR_HALF_LENGTH, BAR_HALF_LENGTH, STEPS)
    z = np.concatenate([straight[0] - cap_z[:-1], straight, straight[-1] + cap_z[-2::-1]])
    radius = np.concatenate([cap_r[:-1], np.full(STEPS, BAR_RADIUS), cap_r[-2::-1]])
    return sweep(np.stack([0 * z + BAR_X, 0 * z, z], -1), ellipses(radius, radius, POINTS))


def _post(z: float) -> trimesh.Trimesh:
    """One post, from inside the door to the bar's axis."""
    x = np.linspace(-POST_DEPTH, BAR_X, 10)
    radius = np.full(len(x), POST_RADIUS)
    return sweep(np.stack([x, 0 * x, 0 * x + z], -1), ellipses(radius, radius, POINTS))
