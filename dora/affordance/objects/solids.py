"""Solids by revolution, sweep and loft, and their union, which keeps the origin of every face; lengths in [m]."""

from __future__ import annotations

from collections.abc import Sequence

import manifold3d
import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from dora.geometry.rotations import quaternion_from_matrix
from dora.robot.shapes import Shape

AROUND = 24
"""Number of divisions around a cylinder or capsule as a mesh."""
FIT_STEPS = 20
"""Number of steps of the fit; more of them move corners along the path without reducing the distance."""
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)
"""Angle between successive directions of a spiral that spreads evenly over a sphere [rad]."""


def lathe(profile: Float[np.ndarray, "n 2"], sections: int) -> trimesh.Trimesh:
    """Solid of revolution about z of a profile of (radius, height) points that begins and ends on the axis [m]."""
    return outward(trimesh.creation.revolve(profile, sections=sections))


def loft(rings: Float[np.ndarray, "m n 3"]) -> trimesh.Trimesh:
    """Solid through m closed rings of n points each, with flat ends [m]."""
    m, n, _ = rings.shape
    here, there = np.arange(n), np.roll(np.arange(n), -1)
    start = n * np.arange(m - 1)[:, None]
    sides = [
        np.stack([start + here, start + there, start + n + here], -1),
        np.stack([start + there, start + n + there, start + n + here], -1),
    ]
    first, last = m * n, m * n + 1
    ends = [
        np.stack([np.full(n, first), there, here], -1),
        np.stack([np.full(n, last), (m - 1) * n + here, (m - 1) * n + there], -1),
    ]
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(1)])
    faces = np.concatenate([each.reshape(-1, 3) for each in (*sides, *ends)])
    return outward(trimesh.Trimesh(vertices, faces, process=False))


def sweep(path: Float[np.ndarray, "m 3"], outline: Float[np.ndarray, "m n 2"]) -> trimesh.Trimesh:
    """Solid of outlines along a path in a plane of constant y; (u, v) are along the path's normal and along y [m]."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.array([0.0, 1.0, 0.0])
    normal = np.cross(across, tangent)
    return loft(path[:, None] + outline[..., :1] * normal[:, None] + outline[..., 1:] * across)


def ellipses(
    half_u: Float[np.ndarray, " m"], half_v: Float[np.ndarray, " m"], points: int, power: float = 2.0
) -> Float[np.ndarray, "m n 2"]:
    """Superellipses |u / half_u|^power + |v / half_v|^power = 1 [m]; power 2 gives an ellipse."""
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], -1)
    unit = np.sign(unit) * np.abs(unit) ** (2 / power)
    return unit * np.stack([half_u, half_v], -1)[:, None]


def spline(knots: Float[np.ndarray, "k d"], points: int) -> Float[np.ndarray, "m d"]:
    """Points at equal parameters of a cubic spline through knots, parametrised by chord length."""
    length = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    parameter = np.concatenate([[0.0], np.cumsum(length)])
    return CubicSpline(parameter, knots)(np.linspace(0, parameter[-1], points))


def arc(center: tuple[float, float], radius: float, start: float, end: float, points: int) -> Float[np.ndarray, "m 2"]:
    """Points of a circle [m] from one angle [deg] to another."""
    angle = np.radians(np.linspace(start, end, points))
    return np.stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle)], -1)


def chamfered_box(size: Sequence[float], chamfer: float, subdivisions: int = 0) -> trimesh.Trimesh:
    """A box with chamfered edges, centred at the origin; `size` along x, y, z and `chamfer` in [m]."""
    half, corners = np.asarray(size) / 2, trimesh.creation.box().vertices * 2
    points = np.concatenate([corners * (half - chamfer * (1 - np.eye(3)[axis])) for axis in range(3)])
    mesh = trimesh.convex.convex_hull(points)
    for _ in range(subdivisions):
        mesh = mesh.subdivide()
    return outward(mesh)


def capsule_between(start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"], radius: float) -> Shape:
    """The capsule of a radius [m] with the centres of its caps at two points (3,) [m]."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    axis = axis / length
    other = np.eye(3)[np.abs(axis).argmin()]
    second = np.cross(other, axis)
    second /= np.linalg.norm(second)
    turn = torch.tensor(np.stack([axis, second, np.cross(axis, second)], -1))
    w, x, y, z = quaternion_from_matrix(turn).tolist()
    px, py, pz = ((start + end) / 2).tolist()
    return Shape("capsule", (px, py, pz), (w, x, y, z), (radius, length / 2))


def shape_mesh(shape: Shape) -> trimesh.Trimesh:
    """A collision primitive as a watertight mesh, in the frame of the primitive's pose [m]."""
    if shape.kind == "box":
        mesh = trimesh.creation.box(extents=[2 * half for half in shape.size])
    elif shape.kind == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=shape.size[0])
    else:
        radius, height = shape.size[0], 2 * shape.size[1]
        round_ends = shape.kind == "capsule"
        mesh = (
            trimesh.creation.capsule(radius=radius, height=height, count=[AROUND, AROUND])
            if round_ends
            else trimesh.creation.cylinder(radius=radius, height=height, sections=AROUND)
        )
        mesh = trimesh.Trimesh(mesh.vertices[:, [2, 0, 1]], mesh.faces, process=False)
    turn = trimesh.transformations.quaternion_matrix(shape.quaternion)[:3, :3]
    return trimesh.Trimesh(mesh.vertices @ turn.T + shape.position, mesh.faces, process=False)


def simplified(path: Float[np.ndarray, "m d"], tolerance: float) -> Float[np.ndarray, "k d"]:
    """Points of a path whose polyline stays within `tolerance` of it, by the Ramer-Douglas-Peucker algorithm."""
    start, end = path[0], path[-1]
    chord = end - start
    along = np.clip((path - start) @ chord / (chord @ chord), 0, 1)
    distance = np.linalg.norm(path - start - along[:, None] * chord, axis=1)
    split = int(distance.argmax())
    if distance[split] <= tolerance:
        return path[[0, -1]]
    return np.concatenate([simplified(path[: split + 1], tolerance)[:-1], simplified(path[split:], tolerance)])


def fitted(path: Float[np.ndarray, "m d"], corners: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k d"]:
    """Corners of the polyline with the least-squares distance to a path; the first and the last stay."""

    def polyline(inner: np.ndarray) -> np.ndarray:
        return np.concatenate([corners[:1], inner.reshape(-1, corners.shape[1]), corners[-1:]])

    def distance(inner: np.ndarray) -> np.ndarray:
        points = polyline(inner)
        start, chord = points[:-1], np.diff(points, axis=0)
        along = np.einsum("mkd,kd->mk", path[:, None] - start, chord) / np.einsum("kd,kd->k", chord, chord)
        return np.linalg.norm(path[:, None] - start - np.clip(along, 0, 1)[..., None] * chord, axis=-1).min(1)

    return polyline(least_squares(distance, corners[1:-1].ravel(), max_nfev=FIT_STEPS).x)


def hull_of(points: Float[np.ndarray, "n 3"], vertices: int) -> trimesh.Trimesh:
    """Convex hull of points (n, 3) with at most `vertices` vertices, the extreme ones in evenly spread directions."""
    hull = trimesh.convex.convex_hull(points)
    if len(hull.vertices) <= vertices:
        return hull
    height = 1 - (2 * np.arange(vertices) + 1) / vertices
    turn = GOLDEN_ANGLE * np.arange(vertices)
    radius = np.sqrt(1 - height**2)
    directions = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], -1)
    chosen = np.unique((hull.vertices @ directions.T).argmax(0))
    return trimesh.convex.convex_hull(hull.vertices[chosen])


def unite(
    parts: Sequence[trimesh.Trimesh],
) -> tuple[trimesh.Trimesh, Int[np.ndarray, " f"], Int[np.ndarray, " f"]]:
    """The union of watertight parts, and for each of its faces the index of its part and of the face in that part.

    Raises:
        ValueError: a part is not closed.
    """
    first = manifold3d.Manifold.reserve_ids(len(parts))
    solids = [manifold_of(part, first + index) for index, part in enumerate(parts)]
    raw = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh64()
    runs = np.diff(raw.run_index).astype(np.int64) // 3
    part = np.repeat(np.array(raw.run_original_id, np.int64) - first, runs)
    return _trimesh(raw), part, np.array(raw.face_id, np.int64)


def subtract(body: trimesh.Trimesh, tool: trimesh.Trimesh) -> trimesh.Trimesh:
    """The difference of two watertight meshes: the body without the inside of the tool."""
    return _trimesh((manifold_of(body) - manifold_of(tool)).to_mesh64())


def outward(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with its faces oriented outwards; changed in place."""
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def manifold_of(mesh: trimesh.Trimesh, identity: int = 0) -> manifold3d.Manifold:
    """A watertight mesh for manifold3d, whose results refer to its faces by `identity` and face index.

    Raises:
        ValueError: it is not closed.
    """
    raw = manifold3d.Mesh64(
        np.array(mesh.vertices, np.float64, order="C"),
        np.array(mesh.faces, np.uint64, order="C"),
        run_index=np.array([0, 3 * len(mesh.faces)], np.uint64),
        run_original_id=np.array([identity], np.uint32),
        face_id=np.arange(len(mesh.faces), dtype=np.uint64),
    )
    solid = manifold3d.Manifold(raw)
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"not a closed surface: {solid.status()}")
    return solid


def _trimesh(raw: manifold3d.Mesh64) -> trimesh.Trimesh:
    """A result of manifold3d as a mesh."""
    return trimesh.Trimesh(raw.vert_properties[:, :3], raw.tri_verts.astype(np.int64), process=False)
