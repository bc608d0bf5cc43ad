"""Faces that a surface should not have, such as repeated ones and back sides, and which faces are neighbours."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Bool, Int

MERGE_SHARE = 1e-6
"""Distance in diagonals of the mesh below which vertices are merged [1]."""

ANGLE_DIGITS = 6
"""Decimal digits of a turn to which angles between faces are compared."""


def clean(mesh: trimesh.Trimesh, labels: Int[np.ndarray, " f"]) -> tuple[trimesh.Trimesh, Int[np.ndarray, " n"], int]:
    """The mesh with near vertices merged and faces dropped that are no surface, and the number of those.

    Dropped are degenerate faces, all but one of equal faces, and of pairs of opposite orientation either one, where
    they are the two sides of a sheet, or both, where two bodies touch. A closed mesh stays as it is, because merging
    would join touching bodies.

    Args:
        mesh: any triangles.
        labels: (f,) labels of its faces.
    """
    if mesh.is_watertight:
        return mesh, labels, 0
    places = np.round(mesh.vertices / (MERGE_SHARE * mesh.scale)).astype(np.int64)
    _, kept, merged = np.unique(places, axis=0, return_index=True, return_inverse=True)
    faces = merged.ravel()[mesh.faces]
    proper = (faces != np.roll(faces, 1, axis=1)).all(1)
    turn = (faces.argmin(1)[:, None] + np.arange(3)) % 3
    good = proper & _first_of_each(np.take_along_axis(faces, turn, 1))
    good[np.flatnonzero(good)[_superfluous(faces[good])]] = False
    return trimesh.Trimesh(mesh.vertices[kept], faces[good], process=False), labels[good], int((~good).sum())


def adjacency(mesh: trimesh.Trimesh) -> Int[np.ndarray, "n 2"]:
    """Pairs of faces that are neighbours on the surface of one body.

    Edges of two faces give a pair each. At an edge of more faces, where bodies touch, two faces are a pair if there is
    material between them. Such an edge gives no pair if the faces around it do not alternate in orientation.
    """
    edges = mesh.edges_sorted
    _, edge_of, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    crowded = np.flatnonzero(counts[edge_of.ravel()] > 2)
    if not len(crowded):
        return mesh.face_adjacency
    crowded = crowded[np.argsort(edge_of.ravel()[crowded], kind="stable")]
    starts = np.flatnonzero(np.diff(edge_of.ravel()[crowded], prepend=-1))
    outwards = 1 if mesh.volume >= 0 else -1
    found = [pair for rows in np.split(crowded, starts[1:]) for pair in _around(mesh, rows, outwards)]
    return np.concatenate([mesh.face_adjacency, np.array(found, np.int64).reshape(-1, 2)])


def _around(mesh: trimesh.Trimesh, rows: Int[np.ndarray, " k"], outwards: int) -> list[tuple[int, int]]:
    """Pairs of faces around one edge, which is given as its `rows` of `mesh.edges`; none if there is no clear order."""
    faces, (first, second) = mesh.edges_face[rows], mesh.edges_sorted[rows[0]]
    start = mesh.vertices[first]
    axis = mesh.vertices[second] - start
    axis = axis / np.linalg.norm(axis)
    third = mesh.faces[faces].sum(1) - first - second
    away = mesh.vertices[third] - start
    away -= np.outer(away @ axis, axis)
    side = np.cross(axis, away[0])
    angle = np.arctan2(away @ side / np.linalg.norm(away[0]), away @ away[0] / np.linalg.norm(away[0]))
    turns = np.round(angle / (2 * np.pi), ANGLE_DIGITS) % 1
    ahead = outwards * np.where(mesh.edges[rows, 0] == first, 1, -1)
    order = np.lexsort((-ahead, turns))
    if len(rows) % 2 or (ahead[order] + ahead[np.roll(order, 1)]).any():
        return []
    return [(int(faces[order[i]]), int(faces[order[i - 1]])) for i in range(len(order)) if ahead[order[i]] == 1]


def _first_of_each(rows: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Mask of the first of equal rows."""
    _, first = np.unique(rows, axis=0, return_index=True)
    single = np.zeros(len(rows), bool)
    single[first] = True
    return single


def _superfluous(faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Mask of the back sides of sheets and of the walls in which bodies touch, among distinct proper faces.

    Faces of opposite orientation with the same corners are a pair. Pairs that share edges form a patch. Where other
    faces begin at every edge of a patch's outline it is a wall between bodies, else a sheet with two sides.
    """
    drop = np.zeros(len(faces), bool)
    _, front, pair, counts = np.unique(
        np.sort(faces, 1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    twins = np.flatnonzero(counts == 2)
    if not len(twins):
        return drop
    edges, edge_of = np.unique(_edges(faces), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(-1, 3)
    every = np.bincount(edge_of.ravel(), minlength=len(edges))
    own = edge_of[front[twins]]
    within = np.bincount(own.ravel(), minlength=len(edges))
    rows = np.repeat(np.arange(len(twins)), 3)
    order = np.argsort(own.ravel(), kind="stable")
    same = np.flatnonzero(np.diff(own.ravel()[order]) == 0)
    links = np.column_stack([rows[order][same], rows[order][same + 1]])
    patch = trimesh.graph.connected_component_labels(links, node_count=len(twins))
    open_end = ((within[own] == 1) & (every[own] == 2)).any(1)
    outlined = (within[own] == 1).any(1)
    sheet = np.bincount(patch, open_end) > 0
    closed = np.bincount(patch, outlined) == 0
    both = ~(sheet | closed)[patch]
    members = pair.ravel()
    drop[np.isin(members, twins[both])] = True
    single = np.isin(members, twins[~both])
    single[front] = False
    return drop | single


def _edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """The three edges of every face, each with its lower corner first."""
    return np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
