"""Repair of labelled triangle meshes into watertight ones, or the reason why that is impossible; lengths as given."""

from __future__ import annotations

from dataclasses import dataclass, replace

import networkx as nx
import numpy as np
import trimesh
from jaxtyping import Int

from dora.affordance.objects.solids import unite
from dora.affordance.objects.surfaces.body_relations import Nesting, inside_others, loose_parts, meetings, nesting
from dora.affordance.objects.surfaces.face_cleaning import adjacency, clean
from dora.errors import InputError

MOST_FILLED, MOST_FILLED_DEEP = 0.53, 0.65
"""Largest ratios of the area that closes openings to that of the mesh, of shallow and of deep ones [1]."""
DEEP = 0.06
"""Ratio of volume to area^1.5 from which what is closed is deep; half a ball has 0.072, a shallow tray 0.04 [1]."""
MOST_OUTSIDE = 0.005
"""Largest ratio of the area of what closes holes, but lies outside of their rims, to that of the mesh [1]."""
SCRAP = 0.05
"""Share of the area up to which a component that cannot be closed, or is flat, is dropped [1]."""
MOST_SCRAPS = 0.2
"""Share of the area above which all that is dropped, loose bodies included, are no scraps any more [1]."""
MOST_BODIES = 1000
"""Largest number of connected parts; each takes a few milliseconds [1]."""
MOST_MEETINGS = 20_000
"""Largest number of pairs of bodies whose bounding boxes overlap; uniting takes up to 0.3 ms for each [1]."""
LEAST_VOLUME = 1e-4
"""Smallest ratio of volume to area^1.5 [1]; a ball has 0.094, a sheet 0."""
FLAT = 0.015
"""The same ratio below which an open scrap counts as flat [1]; a square bent by a tenth of its side has 0.012."""
INSIDE = 0.01
"""Share of the area from which a body inside another is worth a remark [1]."""
FEWEST_FACES = 4
"""Fewest faces of a closed surface [1]."""
WIDE = 0.05
"""Share of a body's area from which closed openings are more than damage: the body was modelled as a sheet [1]."""
MOUTH_SHARE, MOUTH_EDGES, MOUTH_ROUNDNESS, MOUTH_BEND = 0.005, 12, 0.05, 0.02
"""A smaller opening is the mouth of a sheet, too, if its rim is modelled: its least share of the area, edges, area per
squared circumference (a circle has 0.08) [1], and its largest deviation from a plane per circumference [1]."""


@dataclass(frozen=True, eq=False)
class Body:
    """A watertight body with outward faces.

    Attributes:
        mesh: the closed surface.
        labels: (f,) label of each face.
        holes: number of small holes that were filled.
        mouths: number of wide openings that were closed.
        added: area that closed the openings.
        sheet: the surface without what closed its openings, if it was open by more than damage; else None.
        turned: whether its faces were turned outwards.
        sense: 1 if the faces pointed outwards, -1 if inwards, 0 if that differed from face to face.
    """

    mesh: trimesh.Trimesh
    labels: Int[np.ndarray, " f"]
    holes: int
    mouths: int
    added: float
    sheet: trimesh.Trimesh | None
    turned: bool
    sense: int


@dataclass(frozen=True, eq=False)
class Repaired:
    """A watertight mesh and how it came about.

    Attributes:
        mesh: the closed surface with outward faces.
        labels: (f,) label of each face.
        actions: descriptions of what was done to the mesh.
        bodies: the bodies that were united.
        cavities: closed cavities of each body, as bodies with outward faces; the mesh does not have them.
    """

    mesh: trimesh.Trimesh
    labels: Int[np.ndarray, " f"]
    actions: tuple[str, ...]
    bodies: tuple[Body, ...]
    cavities: tuple[tuple[trimesh.Trimesh, ...], ...]


def repair(mesh: trimesh.Trimesh, labels: Int[np.ndarray, " f"], name: str) -> Repaired:
    """Merge vertices, drop degenerate and double faces and scraps, close openings, turn faces outwards, unite bodies.

    A body inside another is filled; if its faces point the other way it is a cavity and counts in `cavities`.

    Args:
        mesh: any triangles.
        labels: (f,) labels of its faces; faces that close an opening take the label of a neighbour.
        name: name of the mesh in error messages.

    Raises:
        InputError: the surface cannot be closed, would be closed by too much new surface, or holds no volume.
    """
    mesh, labels, dropped = clean(mesh, labels)
    bodies, scraps = _bodies(mesh, labels, name)
    bodies = _without_buried_openings(bodies)
    found = nesting([(body.mesh, body.sense) for body in bodies])
    outer = [bodies[i] for i in found.outer]
    if (pairs := meetings([body.mesh for body in outer])) > MOST_MEETINGS:
        raise InputError(
            f"{name} has {len(outer)} bodies, {pairs} pairs of which overlap or may do so, and may have "
            f"{MOST_MEETINGS}: unite them in a mesh editor."
        )
    kept, loose, clusters = loose_parts([body.mesh for body in outer])
    scraps += [outer[i].mesh.area for i in loose]
    _check_dropped([outer[i].mesh for i in kept], scraps, mesh.area, name)
    outer, cavities = [outer[i] for i in kept], [found.cavities[i] for i in kept]
    filled = [bodies[i].mesh.area for i in found.filled if bodies[i].mesh.area > INSIDE * mesh.area]
    actions = _actions(outer, found, dropped, scraps, mesh.area, clusters, len(filled))
    whole = (outer[0].mesh, outer[0].labels) if len(outer) == 1 else _united(outer, name)
    hollow = tuple(tuple(bodies[i].mesh for i in inside) for inside in cavities)
    return Repaired(*whole, actions, tuple(outer), hollow)


def _bodies(mesh: trimesh.Trimesh, labels: np.ndarray, name: str) -> tuple[list[Body], list[float]]:
    """The connected parts of a surface, closed, and the areas of those that are scraps."""
    bodies, scraps = [], []
    groups = trimesh.graph.connected_components(adjacency(mesh), nodes=np.arange(len(mesh.faces)), min_len=1)
    if len(groups) > MOST_BODIES:
        raise InputError(
            f"{name} falls into {len(groups)} parts that do not hang together, and may have {MOST_BODIES}: "
            "export closed surfaces, or drop loose faces in a mesh editor."
        )
    for group in groups:
        area = float(mesh.area_faces[group].sum())
        small = area <= SCRAP * mesh.area
        if small and len(group) < FEWEST_FACES:
            scraps.append(area)
            continue
        part = trimesh.Trimesh(mesh.vertices, mesh.faces[group], process=False)
        part.remove_unreferenced_vertices()
        try:
            body = _closed(part, labels[group], mesh.area, name)
        except InputError:
            if not small:
                raise
            scraps.append(area)
        else:
            if small and body.added and body.mesh.volume < FLAT * body.mesh.area**1.5:
                scraps.append(area)
            else:
                bodies.append(body)
    if not bodies:
        raise InputError(f"{name} is a cloud of loose faces: export one closed surface per body.")
    _check_dropped([body.mesh for body in bodies], scraps, mesh.area, name)
    return bodies, scraps


def _check_dropped(kept: list[trimesh.Trimesh], scraps: list[float], area: float, name: str) -> None:
    """Refuses to drop more than `MOST_SCRAPS` of an area, or of what would be left of it without bodies in others."""
    share = sum(scraps) / min(area, sum(scraps) + sum(float(mesh.area) for mesh in kept))
    if share > MOST_SCRAPS:
        raise InputError(
            f"{name} falls into {len(kept)} bodies and {len(scraps)} loose scraps, which are {share:.0%} of its "
            "surface: join them in a mesh editor, for instance by remeshing."
        )


def _actions(
    outer: list[Body], found: Nesting, dropped: int, scraps: list[float], area: float, clusters: int, inside: int
) -> tuple[str, ...]:
    """Descriptions of what was done, without those that do not apply."""
    mouths = sum(body.mouths for body in outer)
    cavities = sum(len(each) for each in found.cavities)
    added = sum(body.added for body in outer if body.sheet is not None) / area
    scrap, wide = f"surface ({sum(scraps) / area:.1%} of it)", f"a surface without thickness (+{added:.0%} of surface)"
    solid = "it is treated as solid, hands stay out of it, and it weighs as a shell"
    done = (
        (dropped, "dropped a degenerate or double face", "dropped {} degenerate or double faces"),
        (len(scraps), f"dropped a loose scrap of {scrap}", f"dropped {{}} loose scraps of {scrap}"),
        (sum(body.holes for body in outer), "filled a hole", "filled {} holes"),
        (mouths, f"closed a wide opening of {wide}: {solid}", f"closed {{}} wide openings of {wide}: {solid}"),
        (sum(body.turned for body in outer), "turned a body outwards", "turned {} bodies outwards"),
        (
            cavities,
            "found a closed cavity, which weighs nothing and which hands do not enter",
            "found {} closed cavities, which weigh nothing and which hands do not enter",
        ),
        (
            inside,
            "filled a body inside another, whose faces point the same way: turn these if it is a cavity",
            "filled {} bodies inside others, whose faces point the same way: turn these if they are cavities",
        ),
        (len(outer) if len(outer) > 1 else 0, "", "united {} bodies"),
        (clusters if clusters > 1 else 0, "", "hold {} groups of bodies that do not touch together as one rigid body"),
    )
    return tuple(one if count == 1 else many.format(count) for count, one, many in done if count)


def _closed(part: trimesh.Trimesh, labels: np.ndarray, total_area: float, name: str) -> Body:
    """One connected part, closed and oriented outwards; InputError if that is impossible."""
    consistent, area, count = part.is_winding_consistent, part.area, len(part.faces)
    body, fills = part, _Fills(0, 0, 0.0)
    if not part.is_watertight:
        body, labels, fills = _fill(part, labels)
    if fills.outside > MOST_OUTSIDE * total_area:
        raise InputError(
            f"{name} has a hole whose rim turns in on itself, so that what closes it would lie outside of the object: "
            "close it in a mesh editor."
        )
    if not body.is_watertight:
        raise InputError(
            f"{name} is not closed and its holes cannot be filled, since edges belong to more than two faces or "
            "holes touch: repair it in a mesh editor, for instance by remeshing, and try again."
        )
    added = float(body.area - area)
    deep = abs(body.volume) > DEEP * body.area**1.5
    if added > (MOST_FILLED_DEEP if deep else MOST_FILLED) * total_area:
        raise InputError(
            f"{name} is open: closing its holes would add {added / total_area:.0%} to its surface; "
            "give the sheet a thickness or close it in a mesh editor."
        )
    sense = int(np.sign(body.volume)) if consistent else 0
    before = body.faces.copy()
    body.fix_normals(multibody=False)
    if body.volume < LEAST_VOLUME * body.area**1.5:
        raise InputError(f"{name} encloses no volume: it is a sheet or folded into itself; give it a thickness.")
    if not body.is_winding_consistent:
        raise InputError(
            f"{name} has a surface with one side only, like a Klein bottle, and so no inside: "
            "remesh it in a mesh editor."
        )
    turned = not np.array_equal(before, body.faces)
    wide = fills.count if added >= WIDE * area else fills.mouths
    sheet = trimesh.Trimesh(body.vertices, body.faces[:count], process=False) if wide else None
    return Body(body, labels, fills.count - wide, wide, added, sheet, turned, sense)


def _without_buried_openings(bodies: list[Body]) -> list[Body]:
    """Bodies; those whose openings all end inside others, as those of a tube used as a handle, are taken for solid."""
    sheets = {i: body.holes + body.mouths for i, body in enumerate(bodies) if body.sheet is not None}
    if len(bodies) == 1 or not sheets:
        return bodies
    middles = np.concatenate([np.array(bodies[i].mesh.vertices)[-count:] for i, count in sheets.items()])
    owner = np.repeat(list(sheets), list(sheets.values()))
    seen = owner[~inside_others(middles, owner, [body.mesh for body in bodies])]
    buried = sheets.keys() - set(seen.tolist())
    return [
        replace(body, sheet=None, holes=sheets[i], mouths=0) if i in buried else body for i, body in enumerate(bodies)
    ]


@dataclass(frozen=True)
class _Fills:
    """Number of openings that were closed, of those among them with a modelled rim, and the area of what closes them
    that lies outside of their rims [m^2]."""

    count: int
    mouths: int
    outside: float


def _fill(mesh: trimesh.Trimesh, labels: np.ndarray) -> tuple[trimesh.Trimesh, np.ndarray, _Fills]:
    """The mesh with every hole of simple rim closed by a fan around the rim's centre; its own faces come first."""
    mesh = mesh.copy()
    trimesh.repair.fix_winding(mesh)
    edges = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    face_of = dict(zip(map(tuple, mesh.edges.tolist()), mesh.edges_face.tolist(), strict=True))
    rims = nx.DiGraph(edges[:, ::-1].tolist())
    vertices, faces, new_labels = [np.array(mesh.vertices)], [np.array(mesh.faces)], [labels]
    holes, mouths, outside = 0, 0, 0.0
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
        mouths += _is_mouth(mesh.vertices[pairs], mesh.area)
        outside += _outside(mesh.vertices[pairs])
    closed = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    return closed, np.concatenate(new_labels), _Fills(holes, mouths, outside)


def _outside(rim: np.ndarray) -> float:
    """Area of the triangles of a fan from a rim of edges (n, 2, 3) to its centre that face the other way: where the rim
    is not seen whole from there, they lie outside of it, twice."""
    center = rim[:, 0].mean(0)
    areas = np.cross(rim[:, 0] - center, rim[:, 1] - center) / 2
    normal = areas.sum(0)
    along = areas @ (normal / max(float(np.linalg.norm(normal)), 1e-18))
    return 2 * float(-along[along < 0].sum())


def _is_mouth(rim: np.ndarray, area: float) -> bool:
    """Whether a rim of edges (n, 2, 3) is modelled: of many edges, plane, and round."""
    center = rim[:, 0].mean(0)
    length = float(np.linalg.norm(rim[:, 1] - rim[:, 0], axis=1).sum())
    normal = np.cross(rim[:, 0] - center, rim[:, 1] - center).sum(0) / 2
    inside = float(np.linalg.norm(normal))
    if len(rim) < MOUTH_EDGES or inside < max(MOUTH_SHARE * area, MOUTH_ROUNDNESS * length**2):
        return False
    return bool((np.abs((rim[:, 0] - center) @ normal) / inside).max() < MOUTH_BEND * length)


def _united(bodies: list[Body], name: str) -> tuple[trimesh.Trimesh, Int[np.ndarray, " f"]]:
    """The union of bodies, with the labels of its faces."""
    try:
        whole, part, face = unite([body.mesh for body in bodies])
    except ValueError as error:
        raise InputError(f"the bodies of {name} cannot be united ({error}): unite them in a mesh editor.") from error
    start = np.cumsum([0, *(len(body.labels) for body in bodies)])
    return whole, np.concatenate([body.labels for body in bodies])[start[part] + face]
