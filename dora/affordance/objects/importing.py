"""Import of users' objects: any mesh that trimesh reads, repaired, scaled, labelled, and decomposed into hulls."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.resolvers import FilePathResolver

from dora.affordance.objects.affordance_object import UPRIGHT, AffordanceObject, Piece, assemble
from dora.affordance.objects.decomposition import THRESHOLD, decompose
from dora.affordance.objects.labels import WHOLE, FaceLabels, grasp_class, read_labels
from dora.affordance.objects.surface_repair import repair
from dora.containers import MOST_BYTES, MOST_FACES, check_container
from dora.errors import InputError, shown
from dora.reading import read_bytes

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Factor from each unit of length to metres [m]."""
SMALLEST, LARGEST = 0.005, 2.0
"""Range of the longest side of an object, outside of which its unit is most likely wrong [m]."""
KINDS = (".3mf", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""Endings of the mesh files that are read."""
DENSITY = 600.0
"""Density where no mass is given, that of wood [kg/m^3]."""
STABLE = 0.002
"""Smallest distance of the centre of mass from the outline of the foot at which an object stands as modelled [m]."""


class TooLarge(InputError):
    """A mesh of more than `MOST_FACES` faces."""


def import_object(
    path: Path | str,
    labels: Path | str | None = None,
    scale: float = 1.0,
    units: str = "m",
    mass: float | None = None,
    threshold: float = THRESHOLD,
    cache_dir: Path | str | None = None,
) -> AffordanceObject:
    """An object from a file. Axes are kept, the origin moves to the centre of mass.

    Args:
        path: file of one of `KINDS`. Several bodies are united.
        labels: file of labels, see `dora.affordance.objects.labels.read_labels`; if None, the regions are the named
            bodies of the file, else its materials, else the whole mesh.
        scale: factor of all lengths [1].
        units: unit of length of the file, one of `UNITS`; glTF files are in metres.
        mass: mass [kg]; that of wood if None.
        threshold: concavity of the convex decomposition, see `dora.affordance.objects.decomposition.decompose` [1].
        cache_dir: folder of cached decompositions; the default one if None.

    Raises:
        InputError: the file cannot be read, is empty, not finite, cannot be closed, has too many faces or an absurd
            size, or the labels do not fit.
    """
    path = Path(path)
    if units not in UNITS:
        raise InputError(f"the unit {units!r} is unknown; use --units with one of: {', '.join(UNITS)}.")
    for name, value in (("scale", scale), ("mass", 1.0 if mass is None else mass)):
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"the {name} of {path} is {value}; give a positive number.")
    raw, names = read_mesh(path, keep_order=labels is not None)
    _check_size(raw, path, scale * UNITS[units])
    given = FaceLabels.from_names(names) if labels is None else read_labels(Path(labels), raw.triangles_center)
    raw = trimesh.Trimesh(raw.vertices * (scale * UNITS[units]), raw.faces, process=False)
    repaired = repair(raw, given.index, str(path))
    mesh = repaired.mesh
    kept = [i for i in range(len(given.names)) if (repaired.labels == i).any()]
    index = np.searchsorted(kept, repaired.labels)
    regions = {given.names[i]: grasp_class(given.names[i]) for i in kept}
    if given.target not in regions:
        raise InputError(f"the region {given.target!r} of {path} lies inside other parts; choose another target.")
    hulls = decompose(mesh, threshold, cache_dir)
    return assemble(
        path.stem,
        mesh,
        index,
        regions,
        given.target,
        weights=[(mesh, float(mesh.volume) * DENSITY if mass is None else mass)],
        pieces=[Piece(tuple(regions)[_label_of(hull, mesh, index)], hull) for hull in hulls],
        rest=resting_pose(mesh),
    )


def read_mesh(path: Path, keep_order: bool = False) -> tuple[trimesh.Trimesh, list[str]]:
    """All triangles of a file in one mesh, and the name of the part of each.

    Args:
        path: path of the file.
        keep_order: keep the faces of an OBJ file in their order, which loses the names.

    Raises:
        InputError: it cannot be read, holds no triangles, too many, or coordinates that are not finite.
    """
    if path.suffix.lower() not in KINDS:
        raise InputError(f"{path} cannot be read as a mesh: give a file ending in {', '.join(KINDS)}.")
    check_container(path)
    parts = _load(
        path,
        {"maintain_order": True, "skip_materials": True}
        if keep_order
        else {"split_objects": True, "group_material": False},
    )
    if path.suffix.lower() == ".obj" and not keep_order and len(parts) == 1:
        parts = _load(path, {})
    if not parts:
        raise InputError(f"{path} holds no triangles: export the surface of the object as a triangle mesh.")
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate([part for _, part in parts]))
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path} has coordinates that are not finite; export it again.")
    return mesh, [name for name, part in parts for _ in range(len(part.faces))]


class _Neighbours(FilePathResolver):
    """Files that a mesh file names: only plain ones of bounded size, in its folder or below."""

    def get(self, name: str) -> bytes:
        folder = Path(str(self.parent)).resolve()
        path = (folder / name.strip()).resolve()
        if not path.is_relative_to(folder):
            raise InputError(f"it names the file {shown(name)}, which does not lie beside it")
        return read_bytes(path, "file that a mesh names", MOST_BYTES)


def _load(path: Path, options: dict[str, Any]) -> list[tuple[str, trimesh.Trimesh]]:
    """The parts of the scene that trimesh reads from a file; `options` apply to OBJ files alone."""
    own = options if path.suffix.lower() == ".obj" else {}
    try:
        return _parts(trimesh.load_scene(path, resolver=_Neighbours(str(path)), process=False, **own), path)
    except TooLarge:
        raise
    except Exception as error:  # the readers of some twenty formats raise whatever they meet
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} cannot be read ({reason}): export it as OBJ, STL, PLY or GLB.") from error


def _parts(scene: trimesh.Scene, path: Path) -> list[tuple[str, trimesh.Trimesh]]:
    """Triangle meshes of a scene in its frame, named by body if these names differ, else by material."""
    placed, order = [], {name: i for i, name in enumerate(scene.geometry)}
    nodes = [(scene.graph[node], node) for node in scene.graph.nodes_geometry]
    count = sum(len(getattr(scene.geometry[name], "faces", ())) for (_, name), _ in nodes)
    if count > MOST_FACES:
        raise TooLarge(f"{path} has {count} faces; reduce it to at most {MOST_FACES} in a mesh editor.")
    for (pose, name), _ in sorted(nodes, key=lambda each: (order[each[0][1]], each[1])):
        part = scene.geometry[name]
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            material = getattr(getattr(part.visual, "material", None), "name", None)
            if np.shape(part.vertices)[1:] != (3,) or np.shape(part.faces)[1:] != (3,):
                raise InputError("it has points or faces that are not three numbers")
            if part.faces.min() < 0 or part.faces.max() >= len(part.vertices):
                raise InputError("it has faces that name vertices which do not exist")
            bare = trimesh.Trimesh(part.vertices, part.faces, process=False)
            placed.append((name, str(material or name), bare.apply_transform(pose)))
    bodies = {_without_number(name) for name, _, _ in placed}
    materials = {material for _, material, _ in placed}
    if len(bodies) > 1:
        return [(name, part) for name, _, part in placed]
    if len(materials) > 1:
        return [(material, part) for _, material, part in placed]
    return [(WHOLE, part) for _, _, part in placed]


def _without_number(name: str) -> str:
    """A name without the number that editors add to copies: "part.001" -> "part"."""
    return re.sub(r"[._ -]?\d+$", "", name)


def _check_size(mesh: trimesh.Trimesh, path: Path, factor: float) -> None:
    """Refuses meshes outside of `SMALLEST` to `LARGEST`, which most often have the wrong unit."""
    longest = float(mesh.extents.max()) * factor
    if not SMALLEST <= longest <= LARGEST:
        raise InputError(
            f"{path} would be {longest:.3g} m long, not {SMALLEST} to {LARGEST} m: "
            f"say in what units it is with --units ({', '.join(UNITS)}), or give --scale."
        )


def _label_of(hull: trimesh.Trimesh, mesh: trimesh.Trimesh, index: np.ndarray) -> int:
    """Index of the label with the largest area in or near a hull."""
    planes, offsets = hull.face_normals, np.einsum("nd,nd->n", hull.face_normals, hull.triangles[:, 0])
    apart = (mesh.triangles_center @ planes.T - offsets).max(1)
    near = apart <= max(0.02 * hull.scale, apart.min())
    return int(np.bincount(index[near], weights=mesh.area_faces[near]).argmax())


def resting_pose(mesh: trimesh.Trimesh) -> tuple[float, float, float, float]:
    """Orientation at rest on a table, wxyz: as modelled if that is stable, else the most probable stable pose."""
    if _stands(mesh):
        return UPRIGHT
    with np.errstate(invalid="ignore"):
        poses, _ = trimesh.poses.compute_stable_poses(mesh)
    w, x, y, z = (float(v) for v in trimesh.transformations.quaternion_from_matrix(poses[0]))
    return w, x, y, z


def _stands(mesh: trimesh.Trimesh) -> bool:
    """Whether the centre of mass is above the convex hull of the lowest points, by at least `STABLE`."""
    z = mesh.vertices[:, 2]
    foot: Float[np.ndarray, "n 2"] = mesh.vertices[z < z.min() + STABLE / 4][:, :2] - mesh.center_mass[:2]
    around = np.arange(0, 2 * np.pi, 0.1)
    directions = np.stack([np.cos(around), np.sin(around)])
    return bool(((foot @ directions).max(0) > STABLE).all())
