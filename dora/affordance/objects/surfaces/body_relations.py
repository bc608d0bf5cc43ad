"""How closed bodies of one file lie to each other: one inside another, touching, or apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from dora.affordance.objects.signed_distance import ExactDistance
from dora.affordance.objects.solids import manifold_of

PROBES = 200
"""Largest number of vertices of a body by which it is decided whether it lies inside another."""
DEPTH = 1e-5
"""Depth in diagonals of the outer body from which a vertex counts as inside it [1]."""
GAP = 0.01
"""Gap in diagonals of all bodies up to which bodies count as touching [1]."""
LOOSE = 0.01
"""Share of the area up to which bodies that touch nothing are loose parts, such as floating bits of a scan [1]."""


@dataclass(frozen=True)
class Nesting:
    """Which bodies lie inside others, by index.

    Attributes:
        outer: bodies inside no other.
        cavities: for each of `outer` the bodies inside it whose faces point the other way.
        filled: all other bodies inside another.
    """

    outer: tuple[int, ...]
    cavities: tuple[tuple[int, ...], ...]
    filled: tuple[int, ...]


def nesting(bodies: Sequence[tuple[trimesh.Trimesh, int]]) -> Nesting:
    """Order of closed bodies, each with the sense in which its faces pointed: 1 outwards, -1 inwards, 0 unknown.

    A body counts as inside another if all its vertices are, up to `PROBES` of them. A body inside a cavity is filled.
    """
    by_size = sorted(range(len(bodies)), key=lambda i: -abs(bodies[i][0].volume))
    around = _around([mesh for mesh, _ in bodies])
    outer = [i for i, other in enumerate(around) if other is None]
    cavities: dict[int, list[int]] = {i: [] for i in outer}
    for i in outer:
        turned = [k for k in by_size if around[k] == i and bodies[k][1] * bodies[i][1] == -1]
        outermost = _around([bodies[k][0] for k in turned])
        cavities[i] = [k for k, other in zip(turned, outermost, strict=True) if other is None]
    hollow = {k for inside in cavities.values() for k in inside}
    filled = tuple(k for k, other in enumerate(around) if other is not None and k not in hollow)
    return Nesting(tuple(outer), tuple(tuple(cavities[i]) for i in outer), filled)


def inside_others(
    points: Float[np.ndarray, "n 3"], owner: Int[np.ndarray, " n"], meshes: Sequence[trimesh.Trimesh]
) -> Bool[np.ndarray, " n"]:
    """Whether points (n, 3) lie inside any closed body but the one that they belong to, whose index is `owner` (n,)."""
    found = np.zeros(len(points), bool)
    for i, mesh in enumerate(meshes):
        lower, upper = mesh.bounds
        near = np.flatnonzero(~found & (owner != i) & ((points > lower) & (points < upper)).all(1))
        found[near] = ExactDistance(mesh)(points[near]) < 0
    return found


def meetings(meshes: Sequence[trimesh.Trimesh]) -> int:
    """Number of pairs of bodies whose bounding boxes overlap."""
    bounds = np.stack([mesh.bounds for mesh in meshes])
    lower, upper = bounds[:, 0], bounds[:, 1]
    found = sum(int(((lower < upper[i]) & (lower[i] < upper)).all(1).sum()) for i in range(len(meshes)))
    return (found - len(meshes)) // 2


def loose_parts(meshes: Sequence[trimesh.Trimesh]) -> tuple[list[int], list[int], int]:
    """Bodies that are kept, small ones that touch nothing, and the number of groups of touching bodies among the kept.

    Args:
        meshes: closed bodies.
    """
    if len(meshes) == 1:
        return [0], [], 1
    bounds = np.stack([mesh.bounds for mesh in meshes])
    gap = GAP * float(np.linalg.norm(bounds[:, 1].max(0) - bounds[:, 0].min(0)))
    near = nx.utils.UnionFind(range(len(meshes)))
    solids = [manifold_of(mesh) for mesh in meshes]
    for i in range(len(meshes)):
        close = ((bounds[i, 0] - gap <= bounds[:, 1]) & (bounds[:, 0] <= bounds[i, 1] + gap)).all(1)
        for j in np.flatnonzero(close[:i]).tolist():
            if near[i] != near[j] and solids[i].min_gap(solids[j], 2 * gap) <= gap:
                near.union(i, j)
    groups = sorted(near.to_sets(), key=min)
    total = sum(mesh.area for mesh in meshes)
    loose = {i for group in groups if sum(meshes[k].area for k in group) <= LOOSE * total for i in group}
    kept = [i for i in range(len(meshes)) if i not in loose]
    return kept, sorted(loose), sum(1 for group in groups if not group & loose)


def _around(meshes: Sequence[trimesh.Trimesh]) -> list[int | None]:
    """For each closed body, the largest one inside no other in which it lies, by index; None for those in no other."""
    if not meshes:
        return []
    bounds = np.stack([mesh.bounds for mesh in meshes])
    probes = [np.array(mesh.vertices)[:: max(1, len(mesh.vertices) // PROBES)] for mesh in meshes]
    found: list[int | None] = [None] * len(meshes)
    left = np.argsort([-abs(mesh.volume) for mesh in meshes], kind="stable")
    while len(left):
        largest, left = int(left[0]), left[1:]
        within = ((bounds[left, 0] >= bounds[largest, 0]) & (bounds[left, 1] <= bounds[largest, 1])).all(1)
        within[within] = _inside([probes[i] for i in left[within]], meshes[largest])
        for i in left[within]:
            found[i] = largest
        left = left[~within]
    return found


def _inside(probes: Sequence[Float[np.ndarray, "n 3"]], other: trimesh.Trimesh) -> Bool[np.ndarray, " b"]:
    """Which of b bodies lie inside another, without touching it, given points of each of them."""
    exact, depth = ExactDistance(other), -DEPTH * other.scale
    found = exact(np.array([points[0] for points in probes]).reshape(-1, 3)) < depth
    some = np.flatnonzero(found).tolist()
    if some:
        starts = np.cumsum([0, *(len(probes[i]) for i in some)])[:-1]
        found[some] = np.logical_and.reduceat(exact(np.concatenate([probes[i] for i in some])) < depth, starts)
    return found
