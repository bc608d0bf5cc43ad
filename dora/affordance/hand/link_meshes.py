"""Coloured triangle meshes of a robot's links, in the link frames; for pictures and pages only."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
import torch
import trimesh
from jaxtyping import Float, UInt8
from trimesh.visual import ColorVisuals

from dora.affordance.objects.solids import shape_mesh
from dora.containers import MOST_FACES, check_container, check_triangles
from dora.errors import InputError
from dora.geometry.rotations import matrix_from_quaternion
from dora.reading import read_xml
from dora.robot import RobotDescription
from dora.robot.urdf_values import numbers, origin

GAMMA = 2.2
"""Exponent between the linear colours of a glTF material and the colours of a screen [1]."""
PLAIN = (0.55, 0.57, 0.6)
"""Colour of a link that has no visual mesh, red, green and blue in 0..1."""


def link_meshes(robot: RobotDescription, names: Iterable[str]) -> dict[str, trimesh.Trimesh]:
    """Face-coloured meshes of links by their names, in the link frames [m].

    A link without visual meshes shows its collision shapes; one that has neither is left out.
    """
    visuals = _visual_files(robot)
    return {name: mesh for name in names if (mesh := _link_mesh(robot, name, visuals)) is not None}


def painted(mesh: trimesh.Trimesh, colour: Iterable[float]) -> trimesh.Trimesh:
    """The mesh with all faces in one colour: red, green and blue in 0..1, as a screen shows them."""
    faces = np.tile((np.append(np.array(colour), 1.0) * 255).astype(np.uint8), (len(mesh.faces), 1))
    return trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=faces, process=False)


def joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh with all faces and face colours of several meshes."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return trimesh.Trimesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, offsets, strict=False)]),
        face_colors=np.concatenate([face_colours(mesh) for mesh in meshes]),
        process=False,
    )


def face_colours(mesh: trimesh.Trimesh) -> UInt8[np.ndarray, "f 4"]:
    """Red, green, blue and opacity, 0 to 255, of every face of a mesh with colours (not textures)."""
    return np.asarray(cast(ColorVisuals, mesh.visual).face_colors)


Placed = tuple[Path, Float[np.ndarray, "4 4"]]
"""A file of a mesh, and what takes its points into the frame of the link: scale, then pose [m]."""


def _visual_files(robot: RobotDescription) -> dict[str | None, list[Placed]]:
    """The visual meshes of each link of the URDF."""
    files: dict[str | None, list[Placed]] = {}
    for link in read_xml(robot.urdf, "URDF").findall("link"):
        found = files[link.get("name")] = []
        for visual in link.findall("visual"):
            (x, y, z), quaternion = origin(visual)
            pose = np.eye(4)
            pose[:3, :3] = matrix_from_quaternion(torch.tensor(quaternion, dtype=torch.float64)).numpy()
            pose[:3, 3] = x, y, z
            for mesh in visual.findall("geometry/mesh"):
                scale = numbers(mesh, "scale") if "scale" in mesh.attrib else (1.0, 1.0, 1.0)
                found.append((robot.urdf.parent / mesh.get("filename", ""), pose @ np.diag([*scale, 1.0])))
    return files


def _link_mesh(robot: RobotDescription, link: str, visuals: dict[str | None, list[Placed]]) -> trimesh.Trimesh | None:
    parts = [_moved(part, to) for path, to in visuals.get(link, []) if path.is_file() for part in _coloured(path)]
    parts = parts or [painted(shape_mesh(shape), PLAIN) for shape in robot.shapes.get(link, ())]
    return joined(parts) if parts else None


def _moved(mesh: trimesh.Trimesh, transform: Float[np.ndarray, "4 4"]) -> trimesh.Trimesh:
    """The mesh itself, or a copy that is elsewhere."""
    return mesh if np.array_equal(transform, np.eye(4)) else mesh.copy().apply_transform(transform)


@cache
def _coloured(path: Path) -> tuple[trimesh.Trimesh, ...]:
    """Geometries of a mesh file, each in the one colour that a screen shows."""
    check_container(path)
    try:
        scene = trimesh.load_scene(path)
        faces = sum(len(scene.geometry[scene.graph[node][1]].faces) for node in scene.graph.nodes_geometry)
        pieces = cast(list[trimesh.Trimesh], scene.dump() if faces <= MOST_FACES else [])
    except Exception as error:  # the readers of meshes raise whatever they meet
        raise InputError(f"{path} cannot be read ({type(error).__name__}): export the mesh again.") from error
    if faces > MOST_FACES:
        raise InputError(f"{path} has {faces} faces; reduce it to at most {MOST_FACES}.")
    parts = []
    for part in pieces:
        check_triangles(path, np.asarray(part.vertices), np.asarray(part.faces))
        factor = getattr(getattr(part.visual, "material", None), "baseColorFactor", None)
        linear = np.full(4, 255) if factor is None else np.asarray(factor)
        shown = (linear[:3] / 255) ** (1 / GAMMA)
        parts.append(painted(part, shown))
    return tuple(parts)
