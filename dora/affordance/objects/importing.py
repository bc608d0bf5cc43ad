"""Import of users' objects: any mesh that trimesh reads, repaired, scaled, labelled, and decomposed into hulls."""

from __future__ import annotations

import io
import os
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.resolvers import FilePathResolver

from dora.affordance.objects.affordance_object import UPRIGHT, AffordanceObject, Piece, assemble
from dora.affordance.objects.decomposition import THRESHOLD, decompose
from dora.affordance.objects.labels import WHOLE, FaceLabels, grasp_classes, read_labels, without_number
from dora.affordance.objects.surface_repair import repair
from dora.affordance.objects.surfaces.weighing import Weighing, check_weight, weigh
from dora.containers import MOST_BYTES, MOST_FACES, check_container, check_groups, without_mark
from dora.digests import check_file
from dora.errors import InputError, shown
from dora.reading import read_bytes

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Factor from each unit of length to metres [m]."""
UNITS_OF_3MF = {"meter": "m", "centimeter": "cm", "millimeter": "mm", "inch": "in"}
"""What 3MF files call them; millimetres are meant where a file says nothing."""
SMALLEST, LARGEST = 0.005, 2.0
"""Range of the longest side of an object, outside of which its unit is most likely wrong [m]."""
USUAL = (0.01, 0.6)
"""Range of the longest side outside of which a size is remarked on [m]."""
KINDS = (".3mf", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""Endings of the mesh files that are read."""
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
    density: float | None = None,
) -> AffordanceObject:
    """An object from a file. Axes are kept, the origin moves to the centre of mass.

    Args:
        path: file of one of `KINDS`. Several bodies are united.
        labels: file of labels, see `dora.affordance.objects.labels.read_labels`; if None, the regions are the named
            bodies of the file, else its materials, else the whole mesh.
        scale: factor of all lengths [1].
        units: unit of length of the file, one of `UNITS`; glTF files are in metres, 3MF files in what they say.
        mass: mass [kg]; an estimate if None, see `dora.affordance.objects.surfaces.weighing`.
        threshold: concavity of the convex decomposition, see `dora.affordance.objects.decomposition.decompose` [1].
        cache_dir: folder of cached decompositions; the default one if None.
        density: density of the material [kg/m^3], in the place of a mass.

    Raises:
        InputError: the file cannot be read, is empty, not finite, cannot be closed, has too many faces or an absurd
            size, the labels do not fit, or mass and density are out of range or both given.
    """
    return import_mesh(path, labels, scale, units, mass, threshold, cache_dir, density).object


@dataclass(frozen=True, eq=False)
class Imported:
    """An object from a mesh file, and what was done and assumed on the way.

    Attributes:
        object: the object.
        weighing: its mass, and whether that is an estimate.
        notes: what was done to the mesh, and what looks doubtful.
    """

    object: AffordanceObject
    weighing: Weighing
    notes: tuple[str, ...]

    def lines(self) -> tuple[str, ...]:
        """Size and mass, regions, and notes, a line each."""
        name = self.object.name
        first = f"{size_in_words(self.object)}, {self.weighing.sentence()}"
        pairs = zip(self.object.labels, self.object.classes, strict=True)
        regions = f"regions {', '.join(f'{label} ({own})' for label, own in pairs)}"
        return tuple(f"{name}: {text}" for text in (first, regions, *self.notes))


def size_in_words(obj: AffordanceObject) -> str:
    """Sides of the bounding box along x, y and z in centimetres."""
    return " x ".join(f"{100 * side:.1f}" for side in obj.mesh.extents) + " cm"


def import_mesh(
    path: Path | str,
    labels: Path | str | None = None,
    scale: float = 1.0,
    units: str = "m",
    mass: float | None = None,
    threshold: float = THRESHOLD,
    cache_dir: Path | str | None = None,
    density: float | None = None,
) -> Imported:
    """As `import_object`, with an account of what was done and assumed."""
    path = Path(path)
    if units not in UNITS:
        raise InputError(f"the unit {units!r} is unknown; use --units with one of: {', '.join(UNITS)}.")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale of {path} is {scale}; give a positive number.")
    check_weight(path, mass, density)
    raw, names = read_mesh(path, keep_order=labels is not None)
    units = _unit_of(path, units)
    _check_size(raw, path, scale, units)
    given = (
        FaceLabels.from_names(names, source=str(path))
        if labels is None
        else read_labels(Path(labels), raw.triangles_center)
    )
    raw = trimesh.Trimesh(raw.vertices * (scale * UNITS[units]), raw.faces, process=False)
    repaired = repair(raw, given.index, str(path))
    mesh = repaired.mesh
    kept = [i for i in range(len(given.names)) if (repaired.labels == i).any()]
    index = np.searchsorted(kept, repaired.labels)
    regions = grasp_classes([given.names[i] for i in kept])
    if given.target not in regions:
        raise InputError(f"the region {given.target!r} of {path} lies inside other parts; choose another target.")
    hulls, weighing = decompose(mesh, threshold, cache_dir), weigh(repaired, mass, density)
    obj = assemble(
        path.stem,
        mesh,
        index,
        regions,
        given.target,
        weights=weighing.weights,
        pieces=[Piece(tuple(regions)[_label_of(hull, mesh, index)], hull) for hull in hulls],
        rest=resting_pose(mesh, weighing.center),
    )
    lost = [name for name in given.names if name not in regions]
    obj = replace(obj, mass=weighing.mass)  # without the rounding of a sum
    return Imported(obj, weighing, (*repaired.actions, *_doubts(obj, units, lost)))


def _doubts(obj: AffordanceObject, units: str, lost: Sequence[str]) -> list[str]:
    """Remarks on a size that no object for a hand has, and on regions without a face on the surface."""
    doubts = [f"the region {name!r} lies inside other parts or on what was dropped, and is left out" for name in lost]
    longest = float(obj.mesh.extents.max())
    if not USUAL[0] <= longest <= USUAL[1]:
        doubts.append(f"{100 * longest:.3g} cm is an unusual length for a hand: give --units if it is not in {units}")
    return doubts


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
    if path.suffix.lower() != ".obj":
        parts = _load(path, {})
    elif keep_order:
        parts = _load(path, {"maintain_order": True, "skip_materials": True})
    else:
        parts = _obj_parts(path)
    if not parts:
        raise InputError(f"{path} holds no triangles: export the surface of the object as a triangle mesh.")
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate([part for _, part in parts]))
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path} has coordinates that are not finite; export it again.")
    return mesh, [name for name, part in parts for _ in range(len(part.faces))]


def _obj_parts(path: Path) -> list[tuple[str, trimesh.Trimesh]]:
    """Triangle meshes of an OBJ file, named by objects if there are several, else by groups, else by materials."""
    check_groups(path)
    for split in ({"split_objects": True, "group_material": False}, {"split_groups": True, "group_material": False}):
        parts = _load(path, split)
        if len({name for name, _ in parts}) > 1:
            return parts
    return _load(path, {})


class _Neighbours(FilePathResolver):
    """Files that a mesh file names, without byte order marks: plain ones of bounded size, in its folder or below."""

    def get(self, name: str) -> bytes:
        """Content of a file that a mesh file names; trimesh calls it.

        Args:
            name: path of the file from the folder of the mesh, percent-encoded or not.

        Raises:
            InputError: it lies elsewhere, is missing, too large, or not as its checksum says.
        """
        folder = Path(str(self.parent)).resolve()
        plain = folder / name.strip()
        path = (plain if os.path.lexists(plain) else folder / unquote(name.strip())).resolve()  # glTF encodes names
        if not path.is_relative_to(folder):
            raise InputError(f"it names the file {shown(name)}, which does not lie beside it")
        check_file(path)
        return without_mark(read_bytes(path, "file that a mesh names", MOST_BYTES))


def _load(path: Path, options: dict[str, Any]) -> list[tuple[str, trimesh.Trimesh]]:
    """The parts of the scene that trimesh reads from a file; `options` are those of its format."""
    try:
        content = io.BytesIO(without_mark(read_bytes(path, "mesh file", MOST_BYTES)))
        kind, files = path.suffix.lower().removeprefix("."), _Neighbours(str(path))
        return _parts(trimesh.load_scene(content, file_type=kind, resolver=files, process=False, **options), path)
    except TooLarge:
        raise
    except Exception as error:  # the readers of some twenty formats raise whatever they meet
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} cannot be read ({reason}): export it as OBJ, STL, PLY or GLB.") from error


def _parts(scene: trimesh.Scene, path: Path) -> list[tuple[str, trimesh.Trimesh]]:
    """Triangle meshes of a scene in its frame, named by body if these names differ, else by material.

    Names that differ in the number of a copy only are one name.
    """
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
    for names in ([without_number(name) for name, _, _ in placed], [without_number(each) for _, each, _ in placed]):
        if len(set(names)) > 1:
            return [(name, part) for name, (_, _, part) in zip(names, placed, strict=True)]
    return [(WHOLE, part) for _, _, part in placed]


def _unit_of(path: Path, units: str) -> str:
    """The unit of a file: that of a 3MF file is the one that it states, unless metres are its own.

    Raises:
        InputError: it states another one than is asked for, or one that is not in `UNITS`.
    """
    if path.suffix.lower() != ".3mf":
        return units
    with zipfile.ZipFile(path) as archive:
        models = [name for name in archive.namelist() if name.lower().endswith(".model")]
        stated = {_stated_unit(archive, name) for name in models} or {"millimeter"}
    unit = min(stated)
    if len(stated) > 1 or unit not in UNITS_OF_3MF:
        raise InputError(f"{path} is in {' and '.join(sorted(stated))}: export it in millimeters.")
    if units not in ("m", UNITS_OF_3MF[unit]):
        raise InputError(f"{path} says that it is in {unit}, and --units is {units}: leave --units out.")
    return UNITS_OF_3MF[unit]


def _stated_unit(archive: zipfile.ZipFile, name: str) -> str:
    with archive.open(name) as stream:
        for _, root in ElementTree.iterparse(stream, ("start",)):
            return root.get("unit", "millimeter")
    return "millimeter"


def _check_size(mesh: trimesh.Trimesh, path: Path, scale: float, units: str) -> None:
    """Refuses meshes outside of `SMALLEST` to `LARGEST`, which most often have the wrong unit."""
    own = float(mesh.extents.max()) * scale
    longest = own * UNITS[units]
    if not SMALLEST <= longest <= LARGEST:
        fitting = [unit for unit, factor in UNITS.items() if USUAL[0] <= own * factor <= USUAL[1]]
        sizes = " or ".join(f"{100 * own * UNITS[unit]:.3g} cm with --units {unit}" for unit in fitting)
        raise InputError(
            f"{path} would be {longest:.3g} m long, not {SMALLEST} to {LARGEST} m{sizes and f' (it is {sizes})'}: "
            f"say in what units it is with --units ({', '.join(UNITS)}), or give --scale."
        )


def _label_of(hull: trimesh.Trimesh, mesh: trimesh.Trimesh, index: np.ndarray) -> int:
    """Index of the label with the largest area in or near a hull."""
    planes, offsets = hull.face_normals, np.einsum("nd,nd->n", hull.face_normals, hull.triangles[:, 0])
    apart = (mesh.triangles_center @ planes.T - offsets).max(1)
    near = apart <= max(0.02 * hull.scale, apart.min())
    return int(np.bincount(index[near], weights=mesh.area_faces[near]).argmax())


def resting_pose(
    mesh: trimesh.Trimesh, center: Float[np.ndarray, " 3"] | None = None
) -> tuple[float, float, float, float]:
    """Orientation at rest on a table, wxyz: as modelled if that is stable, else the most probable stable pose.

    Args:
        mesh: watertight surface [m].
        center: centre of mass (3,) [m]; that of a uniform solid if None.
    """
    center = mesh.center_mass if center is None else center
    if _stands(mesh, center):
        return UPRIGHT
    with np.errstate(invalid="ignore"):
        poses, _ = trimesh.poses.compute_stable_poses(mesh, center_mass=center)
    w, x, y, z = (float(v) for v in trimesh.transformations.quaternion_from_matrix(poses[0]))
    return w, x, y, z


def _stands(mesh: trimesh.Trimesh, center: Float[np.ndarray, " 3"]) -> bool:
    """Whether the centre of mass is above the convex hull of the lowest points, by at least `STABLE`."""
    z = mesh.vertices[:, 2]
    foot: Float[np.ndarray, "n 2"] = mesh.vertices[z < z.min() + STABLE / 4][:, :2] - center[:2]
    around = np.arange(0, 2 * np.pi, 0.1)
    directions = np.stack([np.cos(around), np.sin(around)])
    return bool(((foot @ directions).max(0) > STABLE).all())
