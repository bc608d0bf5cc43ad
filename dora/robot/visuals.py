"""Model a robot's visual meshes from a table: `python -m dora.robot.visuals robots/diana7_hit`.

`visuals.yaml` lists the parts of each mesh in the link frame [m]: solids of revolution, rounded cylinders, tubes along
a spline, and convex hulls of spheres and rounded discs. Parts of one material become one smooth-shaded mesh in
`meshes/NAME.glb` with a PBR material.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from dora.digests import check_file
from dora.errors import InputError, command, shown
from dora.files import make_folder, renew_checksums, write_bytes
from dora.reading import read_yaml

Row = Mapping[str, Any]
"""One row of the table."""
MESH_NAME = re.compile(r"\w[\w.-]{0,199}")
"""Names of meshes: plain, so that their files lie in the folder `meshes` itself."""
AROUND = 40
"""Number of points around a circle."""
ALONG = 16
"""Number of cross-sections of a tube."""
FILLET_STEPS = 4
"""Number of straight pieces of a rounded edge."""
CREASE = np.radians(28.0)
"""Angle between two faces above which their common edge is shaded as an edge [rad]."""


def build_meshes(table: Row) -> dict[str, trimesh.Scene]:
    """One scene per mesh name of `visuals.yaml`, with one geometry per material.

    Raises:
        InputError: a part or material is missing a key or unknown.
    """
    try:
        materials = {name: _material(name, row) for name, row in table["materials"].items()}
        return {name: _scene(parts, materials) for name, parts in table["meshes"].items()}
    except KeyError as error:
        raise InputError(f"visuals.yaml names or lacks {error.args[0]!r}; correct it.") from error


def write_meshes(folder: Path) -> list[Path]:
    """Write `folder`/meshes/*.glb from `folder`/visuals.yaml and return their paths.

    Raises:
        InputError: as `build_meshes`, or a mesh has a name that is no plain one for a file; nothing is written then.
    """
    table = folder / "visuals.yaml"
    check_file(table)
    content = read_yaml(table, "table of visual meshes")
    try:
        scenes = build_meshes(content)
    except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{table} has a value that makes no mesh ({error}): correct it.") from error
    for name in scenes:
        if not isinstance(name, str) or not MESH_NAME.fullmatch(name):
            raise InputError(f"{table} names a mesh {shown(name)}; use letters, digits and _ . - after the first.")
    target = folder / "meshes"
    make_folder(target)
    paths = []
    for name, scene in scenes.items():
        path = target / f"{name}.glb"
        write_bytes(path, cast(bytes, scene.export(file_type="glb", include_normals=True)))
        paths.append(path)
    renew_checksums(paths)
    return paths


def lathe(profile: ArrayLike, at: ArrayLike, axis: ArrayLike) -> trimesh.Trimesh:
    """Solid of revolution of `profile`, rows (radius, height) in ascending order, about `axis` through `at` [m]."""
    radius, height = np.asarray(profile, dtype=float).T
    angle = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    points = np.concatenate(
        [radius[:, None, None] * ring, np.broadcast_to(height[:, None, None], (len(radius), AROUND, 1))], -1
    )
    return _rings(points @ _frame(axis).T + np.asarray(at, dtype=float))


def cylinder(p0: ArrayLike, p1: ArrayLike, radius: float, edge: float = 0.0) -> trimesh.Trimesh:
    """Cylinder from `p0` to `p1` whose two rims are rounded with radius `edge` [m]."""
    direction = np.subtract(p1, p0)
    length = float(np.linalg.norm(direction))
    bend = np.linspace(0, np.pi / 2, FILLET_STEPS + 1)
    rim = np.stack([radius - edge + edge * np.sin(bend), edge - edge * np.cos(bend)], -1)
    top = np.stack([rim[::-1, 0], length - rim[::-1, 1]], -1)
    return lathe(np.concatenate([rim, top]) if edge else [(radius, 0), (radius, length)], p0, direction)


def tube(points: ArrayLike, radii: ArrayLike) -> trimesh.Trimesh:
    """Round tube along a cubic spline through `points` (n, 3) with radii (n,) there, closed by flat ends [m]."""
    knots = np.asarray(points, dtype=float)
    parameter = np.r_[0.0, np.linalg.norm(np.diff(knots, axis=0), axis=1).cumsum()]
    samples = np.linspace(0, parameter[-1], ALONG)
    path = CubicSpline(parameter, knots, bc_type="natural")
    width = np.interp(samples, parameter, np.asarray(radii, dtype=float))
    centers, tangents = path(samples), path(samples, 1)
    angle = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    side = _frame(tangents[0])[:, 0]
    rings = []
    for center, tangent, r in zip(centers, tangents, width, strict=True):
        tangent = tangent / np.linalg.norm(tangent)
        side = side - tangent * (side @ tangent)
        side /= np.linalg.norm(side)
        up = np.cross(tangent, side)
        rings.append(center + r * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up))
    return _rings(np.stack(rings))


def hull(of: Sequence[Row]) -> trimesh.Trimesh:
    """Convex hull of balls {at, radius} and rounded discs {at, axis, radius, edge} [m]."""
    clouds = []
    for element in of:
        at, radius = np.asarray(element["at"], dtype=float), float(element["radius"])
        if "axis" in element:
            axis = np.asarray(element["axis"], dtype=float) / np.linalg.norm(element["axis"])
            edge = float(element.get("edge", 0.002))
            clouds.append(cylinder(at - edge * axis, at + edge * axis, radius, edge).vertices)
        else:
            clouds.append(at + radius * trimesh.creation.icosphere(subdivisions=2).vertices)
    return trimesh.convex.convex_hull(np.concatenate(clouds))


PARTS: dict[str, Callable[..., trimesh.Trimesh]] = {
    "lathe": lathe,
    "cylinder": cylinder,
    "tube": tube,
    "hull": hull,
}
"""Functions that make each kind of part."""


def _scene(parts: Sequence[Row], materials: Mapping[str, PBRMaterial]) -> trimesh.Scene:
    """A scene with one geometry per material."""
    groups: dict[str, list[trimesh.Trimesh]] = {}
    for part in parts:
        arguments = {key: value for key, value in part.items() if key not in ("part", "material")}
        groups.setdefault(part["material"], []).append(_shade(PARTS[part["part"]](**arguments)))
    scene = trimesh.Scene()
    for material, meshes in groups.items():
        vertices = np.concatenate([mesh.vertices for mesh in meshes])
        offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = np.concatenate([mesh.faces + first for mesh, first in zip(meshes, offsets, strict=False)])
        normals = np.concatenate([mesh.vertex_normals for mesh in meshes])
        whole = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
        whole.visual = TextureVisuals(material=materials[material])
        scene.add_geometry(whole, geom_name=material, node_name=material)
    return scene


def _shade(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with vertices split along creases, so that vertex normals are smooth elsewhere."""
    return trimesh.graph.smooth_shade(mesh, angle=CREASE, facet_minarea=None)


def _rings(rings: np.ndarray) -> trimesh.Trimesh:
    """Closed surface through rings (m, AROUND, 3), with flat fans at both ends."""
    count = len(rings)
    vertices = np.concatenate([rings.reshape(-1, 3), [rings[0].mean(0), rings[-1].mean(0)]])
    here = np.arange(count * AROUND).reshape(count, AROUND)
    after = np.roll(here, -1, axis=1)
    a, b, c, d = here[:-1], after[:-1], after[1:], here[1:]
    sides = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    bottom = np.stack([after[0], here[0], np.full(AROUND, len(vertices) - 2)], -1)
    top = np.stack([here[-1], after[-1], np.full(AROUND, len(vertices) - 1)], -1)
    return trimesh.Trimesh(vertices, np.concatenate([sides, bottom, top]), process=True)


def _frame(axis: ArrayLike) -> np.ndarray:
    """Rotation matrix (3, 3) whose third column is `axis`, normalised."""
    z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[(int(np.abs(z).argmax()) + 1) % 3], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], -1)


def _material(name: str, row: Row) -> PBRMaterial:
    """Opaque material; the table's colours are sRGB, those of glTF are linear."""
    color = [*(np.asarray(row["color"], dtype=float) ** 2.2), 1.0]
    return PBRMaterial(
        name=name, baseColorFactor=color, metallicFactor=row["metallic"], roughnessFactor=row["roughness"]
    )


@command
def main() -> None:
    """Write the meshes of every folder named on the command line."""
    if len(sys.argv) < 2:
        raise SystemExit("usage: python -m dora.robot.visuals FOLDER [FOLDER ...]")
    for folder in sys.argv[1:]:
        for path in write_meshes(Path(folder)):
            print(path, path.stat().st_size)


if __name__ == "__main__":
    sys.exit(main())
