"""Evenly spread points on a surface."""

from __future__ import annotations

import heapq

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

OVERSAMPLING = 5
"""Random points drawn for every point kept."""
AREA_SAMPLES = 32
"""Random points per point kept, by which the areas are measured."""
EXPONENT = 8.0
"""Exponent of the weight of a neighbour, alpha of the source."""
OPPOSITE = -0.3
"""Points whose normals have a smaller inner product lie on different sides."""


def sample_evenly(
    mesh: trimesh.Trimesh, count: int, seed: int
) -> tuple[Float[np.ndarray, "p 3"], Int[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Exactly `count` points on a mesh, spread evenly: of many random points, the most crowded are taken away.

    Weighted sample elimination: C. Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets",
    Eurographics 2015, equations 3 to 5. The two sides of a thin wall do not crowd each other.

    Returns:
        points [m], the face of each, and the area [m^2] for which each stands; the areas sum to that of the mesh.
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
    """Weight (1 - distance / reach)^alpha of every pair of points on the same side of the surface."""
    tree = KDTree(points)
    pairs = tree.query_pairs(reach, output_type="ndarray")
    first, second = pairs[np.einsum("nd,nd->n", normals[pairs[:, 0]], normals[pairs[:, 1]]) > OPPOSITE].T
    distance = np.linalg.norm(points[first] - points[second], axis=1)
    half = csr_matrix(((1 - distance / reach) ** EXPONENT, (first, second)), shape=(len(points), len(points)))
    return (half + half.T).tocsr()


def _eliminate(crowding: csr_matrix, count: int) -> Int[np.ndarray, " p"]:
    """Indices of the `count` points left when the most crowded one goes, again and again."""
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
