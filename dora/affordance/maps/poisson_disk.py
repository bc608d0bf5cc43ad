"""Poisson-disk sampling: points spread evenly over a surface."""

from __future__ import annotations

import heapq

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

OVERSAMPLING = 5
"""Random points drawn per point kept."""
AREA_SAMPLES = 32
"""Random points per point kept, by which the areas are estimated."""
EXPONENT = 8.0
"""Exponent alpha of the weight of a neighbour, as in the source [1]."""
OPPOSITE = -0.3
"""Inner product of two normals below which the points lie on different sides of a wall [1]."""


def sample_evenly(
    mesh: trimesh.Trimesh, count: int, seed: int
) -> tuple[Float[np.ndarray, "p 3"], Int[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Exactly `count` points on a mesh, spread evenly by weighted sample elimination from random points.

    C. Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets", Eurographics 2015, equations 3 to 5.
    Points on the two sides of a thin wall are no neighbours.

    Args:
        mesh: the surface [m].
        count: number of points.
        seed: seed of the random points.

    Returns:
        Points in the frame of the mesh [m], the face of each, and the area that each represents [m^2]; the areas sum
        to that of the mesh.
    """
    rng = np.random.default_rng(seed)
    points, faces = trimesh.sample.sample_surface(mesh, OVERSAMPLING * count, seed=rng)[:2]
    normals = mesh.face_normals[faces]
    radius = float(np.sqrt(mesh.area / (2 * np.sqrt(3) * count)))
    kept = _eliminate(_crowding(points, normals, 2 * radius), count)
    others, other_faces = trimesh.sample.sample_surface(mesh, AREA_SAMPLES * count, seed=rng)[:2]
    tree = KDTree(np.concatenate([points[kept], radius * normals[kept]], axis=1))
    nearest = tree.query(np.concatenate([others, radius * mesh.face_normals[other_faces]], axis=1))[1]
    areas = np.bincount(nearest, minlength=count) * (mesh.area / len(others))
    return points[kept], faces[kept], areas


def _crowding(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], reach: float) -> csr_matrix:
    """(n, n) weights (1 - distance / reach)^alpha of pairs of points on the same side of the surface."""
    tree = KDTree(points)
    pairs = tree.query_pairs(reach, output_type="ndarray")
    first, second = pairs[np.einsum("nd,nd->n", normals[pairs[:, 0]], normals[pairs[:, 1]]) > OPPOSITE].T
    distance = np.linalg.norm(points[first] - points[second], axis=1)
    half = csr_matrix(((1 - distance / reach) ** EXPONENT, (first, second)), shape=(len(points), len(points)))
    return (half + half.T).tocsr()


def _eliminate(crowding: csr_matrix, count: int) -> Int[np.ndarray, " p"]:
    """Indices of the `count` points left when the point with the largest sum of weights is removed repeatedly."""
    weight = np.asarray(crowding.sum(axis=1)).ravel()
    left = len(weight)
    heap = [(-w, i) for i, w in enumerate(weight)]
    heapq.heapify(heap)
    alive = np.ones(left, bool)
    start, neighbour, value = crowding.indptr, crowding.indices, crowding.data
    while left > count:
        negative, i = heapq.heappop(heap)
        if -negative > weight[i]:
            heapq.heappush(heap, (-weight[i], i))
            continue
        alive[i] = False
        left -= 1
        row = slice(start[i], start[i + 1])
        weight[neighbour[row]] -= value[row]
    return np.flatnonzero(alive)
