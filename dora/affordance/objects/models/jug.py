"""A jug: turned body with a pulled lip, and a swept handle wide enough for four fingers.

It stands on z = 0 about the z axis, handle towards +x, lip towards -x, until it is moved to its centre of mass.
"""

from __future__ import annotations

import itertools

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from dora.affordance.objects.affordance_object import AffordanceObject, Piece, assemble
from dora.affordance.objects.solids import (
    arc,
    capsule_between,
    ellipses,
    fitted,
    lathe,
    loft,
    simplified,
    spline,
    subtract,
    sweep,
    unite,
)
from dora.robot.shapes import Shape

MASS = 0.30
HEIGHT = 0.18
WALL = 0.0032
FLOOR = 0.005
FOOT_ROUNDING = 0.006
RADII = ((0.006, 0.0405), (0.055, 0.0475), (0.100, 0.0450), (0.145, 0.0392), (0.1784, 0.0420))
"""(height, outer radius) that the body passes through, from above the rounded foot to below the lip."""
RIM_BOTTOM = 0.166
"""Height above which the wall is the region "rim"."""
SPOUT_REACH, SPOUT_RISE = 0.26, 0.003
"""How far the lip is pulled out, as a share of the radius, and up."""
SPOUT_BOTTOM = 0.120
SPOUT_WIDTH = 0.36
"""Standard deviation [rad] of the pulled lip about -x."""
HANDLE_RADIUS = 0.009
HANDLE_FLARE = 1.18
"""Growth of the handle's radius where it meets the body."""
HANDLE_KNOTS = (
    (0.0375, 0.148), (0.052, 0.1535), (0.070, 0.1555), (0.086, 0.1495), (0.0945, 0.133),
    (0.0955, 0.110), (0.0945, 0.085), (0.0915, 0.062), (0.084, 0.043), (0.068, 0.032), (0.0445, 0.0305),
)  # fmt: skip
"""(x, z) that the handle's centre line passes through, from top to bottom."""
SECTIONS, RINGS, HANDLE_STEPS, HANDLE_POINTS = 48, 26, 48, 20
"""How finely the surface is divided."""
HULL_SECTIONS = 24
HULL_TOLERANCE = 0.0006
"""Largest distance of a slice's outline from the profile."""
FOOT_CLEARANCE = 0.0005
"""Height of the lowest hull above the table: the jug stands on the corners of its foot."""
FOOT_HALF = 0.0015
"""Half height of the foot."""
HULL_CUTS = (FOOT_CLEARANCE, 0.112, 0.147, HEIGHT)
"""Heights between which the filled body is taken for convex."""
CAPSULE_TOLERANCE = 0.003
"""How coarsely the handle's centre line is divided into capsules, which are then fitted to it."""
BODY, HANDLE, RIM = range(3)


def build() -> AffordanceObject:
    """The empty jug; its pieces and its `solid` have no cavity, so fingers stay out of it."""
    path, radius = _handle_path()
    handle = sweep(path, ellipses(radius, radius, HANDLE_POINTS))
    hollow = _pulled(lathe(_shell(), SECTIONS))
    filled = _pulled(lathe(_outside(), SECTIONS))
    core = lathe(_outside(WALL / 2), SECTIONS)
    mesh, part, _ = unite([hollow, subtract(handle, core)])
    height = mesh.triangles_center[:, 2]
    labels = np.where(part == 1, HANDLE, np.where(height > RIM_BOTTOM, RIM, BODY))
    corners = fitted(path, simplified(path, CAPSULE_TOLERANCE))
    capsules = [capsule_between(a, b, HANDLE_RADIUS) for a, b in itertools.pairwise(corners)]
    return assemble(
        "jug",
        mesh,
        labels,
        {"body": "BodyGrasp", "handle": "HandleGrasp", "rim": "RimGrasp"},
        target="handle",
        weights=[(mesh, MASS)],
        pieces=[
            *(Piece("body", shape) for shape in (*_hulls(), _foot())),
            *(Piece("handle", capsule) for capsule in capsules),
        ],
        solid=unite([filled, handle])[0],
        start_posture="above",
    )


def _outside(inset: float = 0.0) -> Float[np.ndarray, "n 2"]:
    """(radius, height) of the outer surface, from the axis at the foot to the axis at the lip."""
    height, radius = np.array(RADII).T
    side = np.linspace(height[0], height[-1], RINGS)
    side = np.stack([CubicSpline(height, radius)(side), side], -1)
    edge = side[0, 0] - FOOT_ROUNDING
    foot = arc((edge, FOOT_ROUNDING), FOOT_ROUNDING, -90.0, 0.0, 5)[:-1]
    lip = arc((side[-1, 0] - WALL / 2, side[-1, 1]), WALL / 2, 0.0, 90.0, 4)[1:]
    base = np.linspace(0, edge, 5)[:-1]
    outer = np.concatenate([np.stack([base, 0 * base], -1), foot, side, lip])
    outer[:, 0] = np.maximum(outer[:, 0] - inset, 0.0)
    lid = np.linspace(outer[-1, 0], 0, 5)[1:]
    return np.concatenate([outer, np.stack([lid, np.full(4, outer[-1, 1])], -1)])


def _shell() -> Float[np.ndarray, "n 2"]:
    """(radius, height) of the whole surface: outside up to the lip, inside down to the axis at the floor."""
    outer = _outside()[:-4]
    height, radius = np.array(RADII).T
    level = np.linspace(height[-1], FLOOR + FOOT_ROUNDING, RINGS)
    inside = np.stack([CubicSpline(height, radius)(level) - WALL, level], -1)
    lip = arc((inside[0, 0] + WALL / 2, inside[0, 1]), WALL / 2, 90.0, 180.0, 4)[1:-1]
    edge = inside[-1, 0] - FOOT_ROUNDING
    foot = arc((edge, FLOOR + FOOT_ROUNDING), FOOT_ROUNDING, 0.0, -90.0, 4)[1:]
    floor = np.linspace(edge, 0, 5)[1:]
    return np.concatenate([outer, lip, inside, foot, np.stack([floor, np.full(4, FLOOR)], -1)])


def _pulled(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with the lip pulled out and up around -x."""
    x, y, z = mesh.vertices.T
    rise = np.clip((z - SPOUT_BOTTOM) / (HEIGHT - SPOUT_BOTTOM), 0, 1)
    pull = rise**2 * (3 - 2 * rise) * np.exp(-((np.arctan2(y, -x) / SPOUT_WIDTH) ** 2) / 2)
    grow = 1 + SPOUT_REACH * pull
    radius = np.hypot(x, y) / RADII[-1][1]
    return trimesh.Trimesh(
        np.stack([x * grow, y * grow, z + SPOUT_RISE * pull * radius], -1), mesh.faces, process=False
    )


def _handle_path() -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, " m"]]:
    """Centre line of the handle and its radius."""
    x, z = spline(np.array(HANDLE_KNOTS), HANDLE_STEPS).T
    along = np.linspace(-1, 1, HANDLE_STEPS)
    return np.stack([x, 0 * x, z], -1), HANDLE_RADIUS * (1 + (HANDLE_FLARE - 1) * along**12)


def _hulls() -> list[trimesh.Trimesh]:
    """Convex slices of the filled body."""
    profile = _outside()[:-4]
    hulls = []
    for low, high in itertools.pairwise(HULL_CUTS):
        inner = profile[(profile[:, 1] > low) & (profile[:, 1] < high)]
        ends = [[np.interp(z, profile[:, 1], profile[:, 0]), z] for z in (low, high)]
        rings = simplified(np.concatenate([ends[:1], inner, ends[1:]]), HULL_TOLERANCE)
        angle = np.linspace(0, 2 * np.pi, HULL_SECTIONS, endpoint=False)
        circle = np.stack([np.cos(angle), np.sin(angle)], -1)
        points = np.concatenate(
            [rings[:, None, :1] * circle, np.broadcast_to(rings[:, None, 1:], (len(rings), HULL_SECTIONS, 1))], -1
        )
        hulls.append(trimesh.convex.convex_hull(_pulled(loft(points)).vertices))
    return hulls


def _foot() -> Shape:
    """A box with one corner below the handle, towards which the centre of mass is off the axis.

    Of the many corners of a round foot PhysX keeps four contacts, now these and now those, some of them in the air: a
    jug whose contacts are made anew would rock on the other ones.
    """
    half = (RADII[0][1] - FOOT_ROUNDING) / np.sqrt(2)
    eighth = np.pi / 8  # half of the turn, as quaternions have it
    return Shape("box", (0.0, 0.0, FOOT_HALF), (float(np.cos(eighth)), 0.0, 0.0, float(np.sin(eighth))),
                 (float(half), float(half), FOOT_HALF))  # fmt: skip
