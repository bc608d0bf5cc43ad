"""Repair of labelled triangle meshes into watertight ones, or the reason why that is impossible; lengths as given."""

from __future__ import annotations

from dataclasses import dataclass

import networkx as nx
import numpy as np
import trimesh
from jaxtyping import Int

from dora.affordance.objects.solids import unite
from dora.errors import InputError

MERGE_SHARE = 1e-6
"""Distance in diagonals of the mesh below which vertices are merged [1]."""
MOST_FILLED = 0.3
"""Largest ratio of the area of filled holes to that of the mesh [1]."""
DEBRIS = 0.01
"""Share of the area up to which a component that cannot be closed is dropped [1]."""
MOST_BODIES = 1000
"""Largest number of connected parts; each takes a few milliseconds [1]."""
LEAST_VOLUME = 1e-4
"""Smallest ratio of volume to area^1.5 [1]; a ball has 0.094, a sheet 0."""


@dataclass(frozen=True, eq=False)
class Repaired:
    """A watertight mesh, the label (f,) of each face, and descriptions of what was done to it."""

    mesh: trimesh.Trimesh
    labels: Int[np.ndarray, " f"]
    actions: tuple[str, ...]


def repair(mesh: trimesh.Trimesh, labels: Int[np.ndarray, " f"], name: str) -> Repaired:
    """Merge vertices, drop degenerate and double faces and debris, fill holes, turn faces outwards, unite bodies.

    A body inside another counts as solid, not as a cavity.

    Args:
        mesh: any triangles.
        labels: (f,) labels of its faces; faces that fill a hole take the label of a neighbour.
        name: name of the mesh in error messages.

    Raises:
        InputError: the surface cannot be closed, would be closed by too much new surface, or holds no volume.
    """
    mesh, labels, dropped = _clean(mesh, labels)
    bodies, debris, holes = [], 0, 0
    groups = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1)
    if len(groups) > MOST_BODIES:
        raise InputError(
            f"{name} falls into {len(groups)} parts that do not hang together, and may have {MOST_BODIES}: "
            "export closed surfaces, or drop loose faces in a mesh editor."
        )
    for group in groups:
        body = trimesh.Trimesh(mesh.vertices, mesh.faces[group], process=False)
        body.remove_unreferenced_vertices()
        try:
            closed = _closed(body, labels[group], mesh.area, name)
        except InputError:
            if body.area > DEBRIS * mesh.area:
                raise
            debris += 1
        else:
            bodies.append(closed)
            holes += closed.holes
    if not bodies:
        raise InputError(f"{name} is a cloud of loose faces: export one closed surface per body.")
    counts = {
        "dropped {} degenerate or double faces": dropped,
        "dropped {} loose scraps of surface": debris,
        "filled {} holes": holes,
        "turned {} bodies outwards": sum(body.turned for body in bodies),
        "united {} bodies": len(bodies) if len(bodies) > 1 else 0,
    }
    actions = tuple(text.format(count) for text, count in counts.items() if count)
    if len(bodies) == 1:
        return Repaired(bodies[0].mesh, bodies[0].labels, actions)
    return Repaired(*_united(bodies, name), actions)


@dataclass(frozen=True, eq=False)
class _Body:
    """A watertight body with outward faces, their labels, the holes filled, and whether its faces were turned."""

    mesh: trimesh.Trimesh
    labels: Int[np.ndarray, " f"]
    holes: int
    turned: bool


def _closed(body: trimesh.Trimesh, labels: np.ndarray, total_area: float, name: str) -> _Body:
    """One connected body, closed and oriented outwards; InputError if that is impossible."""
    area, holes = body.area, 0
    if not body.is_watertight:
        body, labels, holes = _fill(body, labels)
    if not body.is_watertight:
        raise InputError(
            f"{name} is not closed and its holes cannot be filled, since edges belong to more than two faces or "
            "holes touch: repair it in a mesh editor, for instance by remeshing, and try again."
        )
    if body.area - area > MOST_FILLED * total_area:
        raise InputError(
            f"{name} is open: closing its holes would add {(body.area - area) / total_area:.0%} to its surface; "
            "give the sheet a thickness or close it in a mesh editor."
        )
    before = body.faces.copy()
    body.fix_normals(multibody=False)
    if body.volume < LEAST_VOLUME * body.area**1.5:
        raise InputError(f"{name} encloses no volume: it is a sheet or folded into itself; give it a thickness.")
    return _Body(body, labels, holes, turned=not np.array_equal(before, body.faces))


def _clean(mesh: trimesh.Trimesh, labels: np.ndarray) -> tuple[trimesh.Trimesh, np.ndarray, int]:
    """The mesh with near vertices merged and degenerate and repeated faces dropped, and the number of those.

    Equal faces of opposite orientation stay: there two bodies touch. A closed mesh stays as it is, because merging
    would join touching bodies.
    """
    if mesh.is_watertight:
        return mesh, labels, 0
    places = np.round(mesh.vertices / (MERGE_SHARE * mesh.scale)).astype(np.int64)
    _, kept, merged = np.unique(places, axis=0, return_index=True, return_inverse=True)
    faces = merged.ravel()[mesh.faces]
    proper = (faces != np.roll(faces, 1, axis=1)).all(1)
    turn = (faces.argmin(1)[:, None] + np.arange(3)) % 3
    _, first = np.unique(np.take_along_axis(faces, turn, 1), axis=0, return_index=True)
    single = np.zeros(len(faces), bool)
    single[first] = True
    good = proper & single
    return trimesh.Trimesh(mesh.vertices[kept], faces[good], process=False), labels[good], int((~good).sum())


def _fill(mesh: trimesh.Trimesh, labels: np.ndarray) -> tuple[trimesh.Trimesh, np.ndarray, int]:
    """The mesh with every hole of simple rim closed by a fan around the rim's centre, and the number of holes."""
    mesh = mesh.copy()
    trimesh.repair.fix_winding(mesh)
    edges = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    face_of = dict(zip(map(tuple, mesh.edges.tolist()), mesh.edges_face.tolist(), strict=True))
    rims = nx.DiGraph(edges[:, ::-1].tolist())
    vertices, faces, new_labels = [np.array(mesh.vertices)], [np.array(mesh.faces)], [labels]
    holes = 0
    for rim in nx.weakly_connected_components(rims):
        around = rims.subgraph(rim)
        if any(d != 1 for _, d in around.out_degree()) or any(d != 1 for _, d in around.in_degree()):
            continue
        pairs = np.array(list(around.edges))
        middle = len(mesh.vertices) + holes
        vertices.append(mesh.vertices[list(rim)].mean(0, keepdims=True))
        faces.append(np.column_stack([pairs, np.full(len(pairs), middle)]))
        new_labels.append(labels[[face_of[b, a] for a, b in pairs.tolist()]])
        holes += 1
    closed = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    return closed, np.concatenate(new_labels), holes


def _united(bodies: list[_Body], name: str) -> tuple[trimesh.Trimesh, Int[np.ndarray, " f"]]:
    """The union of bodies, with the labels of its faces."""
    try:
        whole, part, face = unite([body.mesh for body in bodies])
    except ValueError as error:
        raise InputError(f"the bodies of {name} cannot be united ({error}): unite them in a mesh editor.") from error
    start = np.cumsum([0, *(len(body.labels) for body in bodies)])
    return whole, np.concatenate([body.labels for body in bodies])[start[part] + face]
