"""Coloured triangle meshes of a robot's links, in the link frames; for pictures and pages only."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
import trimesh
from jaxtyping import UInt8
from trimesh.visual import ColorVisuals

from dora.affordance.objects.solids import shape_mesh
from dora.containers import MOST_FACES, check_container, check_triangles
from dora.errors import InputError
from dora.reading import read_xml
from dora.robot import RobotDescription

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


def _visual_files(robot: RobotDescription) -> dict[str, list[Path]]:
    """Files of the visual meshes of each link of the URDF; meshes are in the link frames."""
    files = {}
    for link in read_xml(robot.urdf, "URDF").findall("link"):
        meshes = link.findall("visual/geometry/mesh")
        files[link.get("name")] = [robot.urdf.parent / mesh.get("filename", "") for mesh in meshes]
    return files


def _link_mesh(robot: RobotDescription, link: str, visuals: dict[str, list[Path]]) -> trimesh.Trimesh | None:
    parts = [part for path in visuals.get(link, []) if path.is_file() for part in _coloured(path)]
    parts = parts or [painted(shape_mesh(shape), PLAIN) for shape in robot.shapes.get(link, ())]
    return joined(parts) if parts else None


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
