"""A claw hammer: oval wooden handle along z, steel head at its upper end, striking face towards +x, claw towards -x.

The handle's lower end is z = 0, until the hammer is moved to its centre of mass.
"""

from __future__ import annotations

import math

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from dora.affordance.objects.affordance_object import AffordanceObject, Piece, assemble, moved
from dora.affordance.objects.solids import (
    capsule_between,
    chamfered_box,
    ellipses,
    hull_of,
    lathe,
    loft,
    spline,
    subtract,
    sweep,
    unite,
)

HEAD_MASS, HANDLE_MASS = 0.20, 0.08
FRICTION = 0.9
HEAD_Z = 0.262
"""Height of the striking axis."""
SHOULDER_Z = 0.238
"""Height at which the handle begins to narrow into the head's eye; its capsules end there."""
HANDLE_PROFILE = (
    (0.0, 0.0060, 0.0030), (0.0012, 0.0105, 0.0065), (0.004, 0.0142, 0.0092), (0.010, 0.0163, 0.0108),
    (0.020, 0.0167, 0.0110), (0.075, 0.0158, 0.0108), (0.120, 0.0160, 0.0110), (0.180, 0.0150, 0.0104),
    (SHOULDER_Z, 0.0142, 0.0100),
    (0.246, 0.0110, 0.0085), (0.250, 0.0090, 0.0070), (0.2755, 0.0090, 0.0070),
)  # fmt: skip
"""(height, half width along x, half width along y): round butt, grip, neck, and the tenon in the head's eye."""
POLL_PROFILE = (
    (-0.008, 0.0088), (0.012, 0.0085), (0.017, 0.0087), (0.023, 0.0100),
    (0.027, 0.0110), (0.0405, 0.0110), (0.042, 0.0095),
)  # fmt: skip
"""(x, radius) of the round front of the head, ending in a chamfered striking face."""
FACE_X = POLL_PROFILE[-1][0]
CHEEK = (0.028, 0.022, 0.026)
CHEEK_CHAMFER = 0.003
CLAW_PATH = ((-0.006, 0.0015), (-0.018, 0.0015), (-0.030, -0.001), (-0.042, -0.0065), (-0.053, -0.0160))
"""(x, height above the striking axis) of the claw's middle."""
CLAW_THICKNESS = ((0.0, 0.0075), (0.35, 0.0055), (0.7, 0.0032), (1.0, 0.0012))
"""(share of the claw's length, half thickness)."""
CLAW_HALF_WIDTH = (0.0095, 0.0110)
"""At its root and at its tip."""
NOTCH = (-0.028, 0.0045)
"""x of the end of the slot between the prongs, and its half width at the tip."""
CLAW_CUT, CLAW_OVERLAP, HULL_VERTICES = -0.031, 0.002, 64
"""x at which the claw's two hulls meet, half of their overlap, and their most vertices."""
CLAW_STEPS, POINTS = 16, 32
CAPSULE_RADIUS, CAPSULE_OFFSET = 0.0105, 0.005
"""Two parallel capsules, offset to both sides along x, stand for the oval handle."""
ON_SIDE = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Quaternion (wxyz) that turns +y up."""
HANDLE, HEAD, FACE = range(3)


def build() -> AffordanceObject:
    """The hammer; it rests on its side."""
    handle = _handle()
    poll, cheek, claw = _head_parts()
    mesh, part, _ = unite([handle, poll, cheek, claw])
    head = subtract(unite([poll, cheek, claw])[0], handle)
    x, _, z = mesh.triangles_center.T
    striking, gripped = (part == 1) & (x > FACE_X - 1e-4), (part == 0) & (z < HEAD_Z)
    low, high = CAPSULE_RADIUS, SHOULDER_Z
    capsules = [
        capsule_between(np.array([x, 0, low]), np.array([x, 0, high]), CAPSULE_RADIUS)
        for x in (-CAPSULE_OFFSET, CAPSULE_OFFSET)
    ]
    return assemble(
        "hammer",
        mesh,
        np.where(gripped, HANDLE, np.where(striking, FACE, HEAD)),
        {"handle": "HandleGrasp", "head": "HeadGrasp", "face": "FaceGrasp"},
        target="handle",
        weights=[(handle, HANDLE_MASS), (head, HEAD_MASS)],
        pieces=[
            *(Piece("handle", capsule) for capsule in capsules),
            *(
                Piece("head", hull_of(part, HULL_VERTICES))
                for part in (poll.vertices, cheek.vertices, *_claw_halves(claw))
            ),
        ],
        rest=ON_SIDE,
        friction=FRICTION,
        placement="air",
    )


def _handle() -> trimesh.Trimesh:
    """The wooden handle with its tenon."""
    height, half_x, half_y = np.array(HANDLE_PROFILE).T
    z = np.unique(np.concatenate([height, np.linspace(0.02, height[-1], 60)]))
    widths = PchipInterpolator(height, np.stack([half_x, half_y], -1))(z)
    ring = ellipses(widths[:, 0], widths[:, 1], POINTS)
    return loft(np.concatenate([ring, np.broadcast_to(z[:, None, None], (*ring.shape[:2], 1))], -1))


def _head_parts() -> tuple[trimesh.Trimesh, trimesh.Trimesh, trimesh.Trimesh]:
    """Round front, cheek around the eye, and claw, overlapping."""
    return _poll(), moved(chamfered_box(CHEEK, CHEEK_CHAMFER, subdivisions=2), np.array([0, 0, HEAD_Z])), _claw()


def _poll() -> trimesh.Trimesh:
    """The turned front, along x."""
    x, radius = np.array(POLL_PROFILE).T
    along = np.unique(np.concatenate([x, np.linspace(x[0], x[-2], 16)]))
    side = np.stack([PchipInterpolator(x, radius)(along), along], -1)
    disc = np.linspace(side[-1, 0], 0, 4)[1:]
    profile = np.concatenate([[[0, x[0]]], side, np.stack([disc, np.full(3, x[-1])], -1)])
    turned = lathe(profile, POINTS)
    return trimesh.Trimesh(turned.vertices[:, [2, 0, 1]] + [0, 0, HEAD_Z], turned.faces, process=False)


def _claw() -> trimesh.Trimesh:
    """The curved, tapering claw with a slot for nails."""
    x, z = spline(np.array(CLAW_PATH), CLAW_STEPS).T
    share = np.linspace(0, 1, CLAW_STEPS)
    thickness = PchipInterpolator(*np.array(CLAW_THICKNESS).T)(share)
    width = np.linspace(*CLAW_HALF_WIDTH, CLAW_STEPS)
    path = np.stack([x, 0 * x, z + HEAD_Z], -1)
    blade = sweep(path, ellipses(thickness, width, POINTS, power=5.0))
    return subtract(blade, _wedge())


def _claw_halves(claw: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the claw's root and of its tip: one hull would fill its curve."""
    x = claw.vertices[:, 0]
    return claw.vertices[x >= CLAW_CUT - CLAW_OVERLAP], claw.vertices[x <= CLAW_CUT + CLAW_OVERLAP]


def _wedge() -> trimesh.Trimesh:
    """What the slot takes away: a prism along z with its edge towards the head."""
    apex, half = NOTCH
    end = CLAW_PATH[-1][0] - 0.005
    reach = half * (end - apex) / (CLAW_PATH[-1][0] - apex)
    corners: Float[np.ndarray, "3 2"] = np.array([[apex, 0], [end, reach], [end, -reach]])
    points = [[x, y, z] for x, y in corners for z in (HEAD_Z - 0.05, HEAD_Z + 0.05)]
    return trimesh.convex.convex_hull(np.array(points))
