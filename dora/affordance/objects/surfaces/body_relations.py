"""How closed bodies of one file lie to each other: one inside another, touching, or apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
import trimesh

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
    outer: list[int] = []
    cavities: dict[int, list[int]] = {}
    filled = []
    for i in by_size:
        around = next((j for j in outer if _inside(bodies[i][0], bodies[j][0])), None)
        if around is None:
            outer.append(i)
            cavities[i] = []
        elif bodies[i][1] * bodies[around][1] == -1 and not any(
            _inside(bodies[i][0], bodies[j][0]) for j in cavities[around]
        ):
            cavities[around].append(i)
        else:
            filled.append(i)
    outer.sort()
    return Nesting(tuple(outer), tuple(tuple(cavities[i]) for i in outer), tuple(filled))


def loose_parts(meshes: Sequence[trimesh.Trimesh]) -> tuple[list[int], list[int], int]:
    """Bodies that are kept, small ones that touch nothing, and the number of groups of touching bodies among the kept.

    Args:
        meshes: closed bodies.
    """
    if len(meshes) == 1:
        return [0], [], 1
    bounds = np.stack([mesh.bounds for mesh in meshes])
    gap = GAP * float(np.linalg.norm(bounds[:, 1].max(0) - bounds[:, 0].min(0)))
    near = nx.Graph()
    near.add_nodes_from(range(len(meshes)))
    solids = [manifold_of(mesh) for mesh in meshes]
    for i in range(len(meshes)):
        close = ((bounds[i, 0] - gap <= bounds[:, 1]) & (bounds[:, 0] <= bounds[i, 1] + gap)).all(1)
        for j in np.flatnonzero(close[:i]).tolist():
            if not nx.has_path(near, i, j) and solids[i].min_gap(solids[j], 2 * gap) <= gap:
                near.add_edge(i, j)
    groups = sorted(nx.connected_components(near), key=min)
    total = sum(mesh.area for mesh in meshes)
    loose = {i for group in groups if sum(meshes[k].area for k in group) <= LOOSE * total for i in group}
    kept = [i for i in range(len(meshes)) if i not in loose]
    return kept, sorted(loose), sum(1 for group in groups if not group & loose)


def _inside(body: trimesh.Trimesh, other: trimesh.Trimesh) -> bool:
    """Whether one body lies inside another, without touching it."""
    if (body.bounds[0] < other.bounds[0]).any() or (body.bounds[1] > other.bounds[1]).any():
        return False
    step = max(1, len(body.vertices) // PROBES)
    return bool((ExactDistance(other)(np.array(body.vertices)[::step]) < -DEPTH * other.scale).all())
