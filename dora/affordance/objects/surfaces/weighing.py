"""Mass of an imported object, given or assumed: its geometry tells a solid from a vessel, a hollow body and a shell.

docs/objects.md states the rule.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from dora.affordance.objects.affordance_object import mass_properties
from dora.affordance.objects.signed_distance import ExactDistance
from dora.affordance.objects.solids import GOLDEN_ANGLE
from dora.affordance.objects.surface_repair import Repaired
from dora.errors import InputError

Kind = Literal["solid", "vessel", "hollow", "shell"]
"""What a body is taken for: solid, a vessel whose walls are modelled, closed around a cavity, or a sheet."""
SOLID_DENSITY, WALL_DENSITY = 600.0, 1000.0
"""Assumed densities of solids, that of wood, and of the walls of vessels, that of plastics [kg/m^3]."""
THINNEST, THICKEST = 0.001, 0.003
"""Range to which the thickness of a wall is limited for the estimate [m]; a sheet counts as `THICKEST`."""
MASSES = (1e-5, 100.0)
"""Range of a mass that may be given [kg]."""
DENSITIES = (1.0, 25_000.0)
"""Range of a density that may be given, from aerogel to osmium [kg/m^3]."""
PROBES, RAYS = 500, 32
"""Numbers of points in the convex hull, and of rays from each, by which the enclosed room is measured."""
CELLS, SAMPLES = 48, 300_000
"""Cells along the longest side of the mesh through which rays step, and surface points that mark them."""
NEAREST = 1.75
"""Distance at which a ray begins to look for the surface, in cells, so that its own cell does not count [1]."""
BLOCKED = 0.6
"""Share of the rays that meet the surface from which a point counts as enclosed [1]."""
SLIM = 1e-3
"""Least share of a hollow body that is wall, below which it counts as without thickness; also the thickness in
diagonals at which the inertia of a sheet is computed [1]."""
PRISM = np.array([[0, 1, 2], [5, 4, 3], [0, 3, 1], [1, 3, 4], [1, 4, 2], [2, 4, 5], [2, 5, 0], [0, 5, 3]])
"""Faces of a prism between a triangle and the same further down."""
HEAVY = 0.5
"""Assumed mass of a solid above which it is worth a remark that it may be hollow [kg]."""
NAMES: dict[Kind, str] = {
    "solid": "solid",
    "vessel": "thin-walled vessel",
    "hollow": "hollow body around a closed cavity",
    "shell": "shell, because its surface was open and has no thickness",
}
"""Name of each kind in sentences."""


@dataclass(frozen=True, eq=False)
class Weighing:
    """Mass of an object and how it was found.

    Attributes:
        mass: mass [kg].
        kind: what the object is taken for; that of its heaviest body if there are several.
        estimate: material of the estimate in words.
        source: what the mass comes from: an "estimate", or the "mass" or "density" that was given.
        weights: closed meshes of uniform density [m] with their masses [kg]; that of a cavity is negative.
    """

    mass: float
    kind: Kind
    estimate: str
    source: Literal["estimate", "mass", "density"]
    weights: tuple[tuple[trimesh.Trimesh, float], ...]

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Centre of mass (3,) [m]."""
        return mass_properties(self.weights)[1]

    @property
    def assumed(self) -> bool:
        """Whether the mass is an estimate."""
        return self.source == "estimate"

    def sentence(self) -> str:
        """How heavy the object is and why."""
        if not self.assumed:
            return f"{self.mass:.3g} kg by the {self.source} given, taken for a {NAMES[self.kind]}"
        doubt = ", less if it is hollow" if self.kind == "solid" and self.mass > HEAVY else ""
        return (
            f"{self.mass:.3g} kg assumed{doubt}: taken for a {NAMES[self.kind]}, {self.estimate}; "
            "--mass or --density gives the true one"
        )


def check_weight(path: Path, mass: float | None, density: float | None) -> None:
    """Refuse a mass and density together, and what no object has.

    Raises:
        InputError: both are given, or one is out of range.
    """
    if mass is not None and density is not None:
        raise InputError(f"both a mass and a density of {path} are given; give one of them.")
    for name, value, (low, high), unit in (("mass", mass, MASSES, "kg"), ("density", density, DENSITIES, "kg/m^3")):
        if value is not None and not low <= value <= high:
            raise InputError(f"the {name} of {path} is {value}; give a positive number, {low:g} to {high:g} {unit}.")


@dataclass(frozen=True, eq=False)
class _Part:
    """One body: what it is taken for, its material's volume [m^3], its mass [kg], wall [m], and what to weigh."""

    kind: Kind
    volume: float
    mass: float
    wall: float
    meshes: tuple[tuple[trimesh.Trimesh, float], ...]
    """Closed meshes with their signed shares of the mass [1]."""


def weigh(repaired: Repaired, mass: float | None = None, density: float | None = None) -> Weighing:
    """Mass of a repaired mesh [m], and its distribution, which does not depend on the mass that is given.

    Args:
        repaired: the mesh, with the bodies and cavities of which it was made.
        mass: mass [kg]; an estimate if None.
        density: density of the material [kg/m^3], instead of a mass.
    """
    if any(repaired.cavities) or any(body.sheet is not None for body in repaired.bodies):
        parts = [
            _sheet(body.sheet) if body.sheet is not None else _closed(body.mesh, cavities)
            for body, cavities in zip(repaired.bodies, repaired.cavities, strict=True)
        ]
    else:
        parts = [_closed(repaired.mesh, ())]
    estimate = sum(part.mass for part in parts)
    total = mass or (density or 0.0) * sum(part.volume for part in parts) or estimate
    weights = [(mesh, part.mass * share * total / estimate) for part in parts for mesh, share in part.meshes]
    heaviest = max(parts, key=lambda part: part.mass)
    material = (
        f"{SOLID_DENSITY:.0f} kg/m^3"
        if heaviest.kind == "solid"
        else f"walls of {1000 * heaviest.wall:.1f} mm and {WALL_DENSITY:.0f} kg/m^3"
    )
    source = "mass" if mass is not None else "density" if density is not None else "estimate"
    return Weighing(float(total), heaviest.kind, material, source, tuple(weights))


def _sheet(sheet: trimesh.Trimesh) -> _Part:
    """An open surface without thickness: a shell as thick as `THICKEST`."""
    volume = float(sheet.area) * THICKEST
    return _Part("shell", volume, volume * WALL_DENSITY, THICKEST, ((thickened(sheet), 1.0),))


def _closed(body: trimesh.Trimesh, cavities: tuple[trimesh.Trimesh, ...]) -> _Part:
    """A closed body without its closed cavities: hollow or a vessel if it encloses more room than material."""
    room = sum(float(cavity.volume) for cavity in cavities)
    volume = float(body.volume) - room
    if volume < SLIM * body.volume:
        return replace(_sheet(body), kind="hollow")
    area = float(body.area) + sum(float(cavity.area) for cavity in cavities)
    shares = ((body, float(body.volume) / volume), *((each, -float(each.volume) / volume) for each in cavities))
    kind: Kind = "hollow" if room >= volume else "vessel" if enclosed_room(body) >= volume else "solid"
    if kind == "solid":
        return _Part(kind, volume, volume * SOLID_DENSITY, 0.0, shares)
    wall = float(np.clip(2 * volume / area, THINNEST, THICKEST))
    return _Part(kind, volume, area / 2 * wall * WALL_DENSITY, wall, shares)


def enclosed_room(mesh: trimesh.Trimesh) -> float:
    """Volume of the room around which a closed surface reaches, such as the inside of an open cup [m^3].

    A point of the convex hull outside of the material is in that room if `BLOCKED` of the rays from it meet the
    surface. Where the hull holds less room than material the answer is 0, without looking closer.

    Args:
        mesh: watertight surface [m].
    """
    hull = mesh.convex_hull
    if hull.volume < 2 * mesh.volume:
        return 0.0
    inside = _points_in(hull)
    outside = inside[ExactDistance(mesh)(inside) > 0]
    return float(hull.volume) * float((_blocked(mesh, outside) >= BLOCKED).sum()) / len(inside)


def _blocked(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Share (n,) of the rays from points (n, 3) that meet the surface; rays step through cells that hold surface."""
    lower, side = mesh.bounds[0], float(mesh.extents.max()) / CELLS
    surface = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0]
    holds = np.zeros((CELLS + 1,) * 3, bool)
    holds[tuple(((surface - lower) / side).astype(int).T)] = True
    met = np.zeros((len(points), RAYS), bool)
    for step in np.arange(NEAREST, 2 * CELLS):
        place = (points[:, None] + step * side * _spiral(RAYS) - lower) / side
        cell = np.floor(place).astype(int)
        within = ((cell >= 0) & (cell <= CELLS)).all(-1)
        met |= within & holds[tuple(np.moveaxis(np.clip(cell, 0, CELLS), -1, 0))]
    return met.mean(1)


def thickened(sheet: trimesh.Trimesh) -> trimesh.Trimesh:
    """A thin prism below every triangle of an open surface, for its centre of mass and inertia alone.

    Args:
        sheet: f triangles with outward normals [m].
    """
    above = sheet.triangles
    below = above - SLIM * sheet.scale * sheet.face_normals[:, None]
    corners = np.concatenate([above, below], axis=1).reshape(-1, 3)
    faces = 6 * np.arange(len(above))[:, None, None] + PRISM
    return trimesh.Trimesh(corners, faces.reshape(-1, 3), process=False)


def _points_in(hull: trimesh.Trimesh) -> Float[np.ndarray, "n 3"]:
    """Points (n, 3) spread at random in a convex hull, always the same ones [m]."""
    lower, upper = hull.bounds
    points = np.random.default_rng(0).uniform(lower, upper, (4 * PROBES, 3))
    offsets = np.einsum("nd,nd->n", hull.face_normals, hull.triangles[:, 0])
    within: Bool[np.ndarray, " n"] = (points @ hull.face_normals.T < offsets).all(1)
    return points[within][:PROBES]


def _spiral(count: int) -> Float[np.ndarray, "n 3"]:
    """Unit vectors (n, 3) spread evenly over a sphere."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn, radius = GOLDEN_ANGLE * np.arange(count), np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], -1)
