"""The hand's collision shapes as capsules, as spheres on their axes, and as points with normals on the palmar side.

Everything is computed once per robot, in NumPy, in the frames of the bodies of `dora.affordance.hand.hand_model`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh

from dora.errors import InputError
from dora.geometry.rotations import matrix_from_quaternion
from dora.robot import Shape

SAGITTA = 6e-4
"""Largest depth of the groove between neighbouring spheres on a capsule's axis [m]."""
PALMAR_COSINE = 0.6
"""Smallest cosine between a contact point's normal and the palmar direction of its link [1]."""
SAMPLE_DENSITY = 1e6
"""Density of surface samples from which contact points are chosen [1/m^2]."""
BURIED = -2e-4
"""Signed distance to another shape of the straight hand below which a surface sample is no contact point [m]."""

THIN = 1e-3
"""Radius below which a capsule is enlarged to sample its surface [m]."""
MOST_CAPSULES = 300
"""Largest number of capsules of a hand, and of one box or flat cylinder [1]."""


@dataclass(frozen=True, eq=False)
class Capsule:
    """The points within `radius` [m] of the segment from `start` (3,) to `end` (3,), in the frame of `body` [m]."""

    body: int
    link: str
    start: np.ndarray
    end: np.ndarray
    radius: float

    def spheres(self, sagitta: float = SAGITTA) -> np.ndarray:
        """Centres (n, 3) of spheres on the axis whose union is at most `sagitta` [m] thinner than the capsule [m]."""
        return np.linspace(self.start, self.end, self.sphere_count(sagitta))

    def sphere_count(self, sagitta: float = SAGITTA) -> int:
        """Number of those spheres; neighbours touch at least, however thin the capsule is."""
        depth = min(sagitta, self.radius)
        return math.ceil(self.length / (2 * math.sqrt(depth * (2 * self.radius - depth)))) + 1 if self.length > 0 else 1

    @property
    def length(self) -> float:
        """Length of the axis [m]."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def area(self) -> float:
        """Area of the surface [m^2]."""
        return 2 * math.pi * self.radius * (2 * self.radius + self.length)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (n,) of points (n, 3) to the surface, negative inside [m]."""
        return np.linalg.norm(points - self.nearest(points), axis=1) - self.radius

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the axis that are nearest to points (n, 3) [m]."""
        axis = self.end - self.start
        share = (points - self.start) @ axis / max(float(axis @ axis), 1e-18)
        return self.start + np.clip(share, 0.0, 1.0)[:, None] * axis


def capsules_of(shape: Shape, body: int, link: str, pose: np.ndarray) -> list[Capsule]:
    """A collision shape of `link` as inscribed capsules; `pose` (4, 4) is that of the link in its body [m].

    Exact for capsules and spheres. A cylinder becomes the longest capsule inside it, a flat one a row of capsules
    across it, with half its thickness as radius; a box becomes a row of capsules along its longest side, with its
    smallest half side as radius. Only the edges are lost.

    Raises:
        InputError: a thin box or cylinder would become more than `MOST_CAPSULES`.
    """
    turn = pose[:3, :3] @ matrix_from_quaternion(torch.tensor(shape.quaternion, dtype=torch.float64)).numpy()
    center = pose[:3, :3] @ np.asarray(shape.position) + pose[:3, 3]
    if shape.kind == "box":
        return _box(np.asarray(shape.size), center, turn, body, link)
    radius = shape.size[0]
    half = 0.0 if shape.kind == "sphere" else shape.size[1]
    if shape.kind == "cylinder" and half < radius:
        return _disc(radius, half, center, turn, body, link)
    if shape.kind == "cylinder":
        half -= radius
    reach = turn @ np.array([half, 0.0, 0.0])
    return [Capsule(body, link, center - reach, center + reach, radius)]


def _box(half: np.ndarray, center: np.ndarray, turn: np.ndarray, body: int, link: str) -> list[Capsule]:
    thin, middle, long = np.argsort(half)
    radius = float(half[thin])
    reach = turn[:, long] * (half[long] - radius)
    offsets = [
        row * (half[middle] - radius) * turn[:, middle] for row in _rows(float(half[middle]), radius, "box", link)
    ]
    return [Capsule(body, link, center + offset - reach, center + offset + reach, radius) for offset in offsets]


def _disc(radius: float, thin: float, center: np.ndarray, turn: np.ndarray, body: int, link: str) -> list[Capsule]:
    """A flat cylinder about its x axis as capsules along y, side by side along z."""
    inner, found = radius - thin, []
    for row in _rows(radius, thin, "cylinder", link):
        offset, reach = row * inner * turn[:, 2], inner * math.sqrt(1 - row * row) * turn[:, 1]
        found.append(Capsule(body, link, center + offset - reach, center + offset + reach, thin))
    return found


def _rows(half: float, radius: float, kind: str, link: str) -> np.ndarray:
    """Places -1 to 1 of capsules with this radius side by side, which together are 2 `half` wide [m]."""
    count = math.ceil((half - radius) / radius) + 1
    if count > MOST_CAPSULES:
        raise InputError(
            f"a collision {kind} of the link {link!r} is {2 * radius:g} m thin, so that it needs {count} capsules, and "
            f"{MOST_CAPSULES} are allowed: make it thicker or narrower in the URDF."
        )
    return np.linspace(-1.0, 1.0, count) if count > 1 else np.zeros(1)


def palmar_points(
    capsules: Sequence[Capsule], palmar: np.ndarray, count: int, tip: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Up to `count` evenly spread points (n, 3) and outward unit normals (n, 3) on the palmar side of one body.

    Args:
        capsules: all capsules of the body; points inside another of them are left out.
        palmar: (3,) unit normal of the palmar side, in the body's frame.
        count: largest number of points.
        tip: (3,) unit direction towards the fingertip for the last link, towards which normals may lean; else None.

    Returns:
        Points and normals, in the body's frame [m].
    """
    facing = palmar if tip is None else (palmar + 0.5 * tip) / np.linalg.norm(palmar + 0.5 * tip)
    found_points, found_normals = [], []
    for index, capsule in enumerate(capsules):
        points, normals = _surface(capsule)
        keep = normals @ facing > PALMAR_COSINE
        for other_index, other in enumerate(capsules):
            if other_index != index:
                keep &= other.distance(points) > BURIED
        found_points.append(points[keep])
        found_normals.append(normals[keep])
    points, normals = np.concatenate(found_points), np.concatenate(found_normals)
    chosen = farthest_points(points, count)
    return points[chosen], normals[chosen]


def _surface(capsule: Capsule) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) [m] and normals (n, 3) on the surface of a capsule, sampled with a fixed seed."""
    axis, length = capsule.end - capsule.start, capsule.length
    scale = 1.0 if capsule.radius > THIN else THIN / capsule.radius  # trimesh takes tiny triangles for none
    mesh = trimesh.creation.capsule(height=scale * length, radius=scale * capsule.radius, count=[16, 16])
    turn = trimesh.geometry.align_vectors([0, 0, 1], axis / length) if length > 0 else np.eye(4)
    pose = np.array(turn, dtype=float)
    pose[:3, 3] = 0.5 * (capsule.start + capsule.end) * scale
    mesh.apply_transform(pose)
    count = max(64, int(mesh.area / scale**2 * SAMPLE_DENSITY))
    points = trimesh.sample.sample_surface(mesh, count, seed=0)[0] / scale
    center = capsule.nearest(points)
    normals = (points - center) / np.linalg.norm(points - center, axis=1, keepdims=True)
    return center + capsule.radius * normals, normals


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices (min(count, n),) of points (n, 3) by farthest-point sampling, which starts at index 0."""
    if not len(points):
        return np.zeros(0, dtype=int)
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)
