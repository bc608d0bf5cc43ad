"""PNG pictures of grasps and contact semantic maps, on any machine."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Int
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand_mesh import HandMesh
from dora.affordance.palette import PALETTE, colours
from dora.affordance.rasteriser import Camera, render
from dora.affordance.structure import AffordanceObject
from dora.files import write_bytes
from dora.robot import RobotDescription

PARTS = {
    "no contact": (205, 205, 205),
    "palm": (122, 92, 70),
    "thumb": (225, 87, 89),
    "index": (242, 142, 43),
    "middle": (237, 201, 72),
    "ring": (89, 161, 79),
    "pinky": (78, 121, 167),
}
"""Classes of a contact semantic map and their colours."""
TILE = 420
"""Width and height of one view [pixels]."""
DPI = 100
"""Pixels per inch of figures."""
VIEW = (0.6, 0.35)
"""Azimuth, where there is nothing to look at, and elevation of the views of contact maps [rad]."""


def coloured(obj: AffordanceObject) -> trimesh.Trimesh:
    """The object's mesh, every face in the colour of its region."""
    mesh = obj.mesh
    return trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=colours(obj.face_labels, PALETTE), process=False)


def picture_grasps(
    candidates: GraspCandidates, obj: AffordanceObject, robot: RobotDescription, path: Path | str, columns: int = 4
) -> None:
    """Write a PNG with one view of every candidate: give a few, `columns` to a row.

    The hand is in its posture at contact and seen from beside the object, opposite to the wrist's approach.
    """
    mesh = coloured(obj)
    hands = HandMesh(robot).posed(candidates.position, candidates.quaternion, candidates.joints)
    views = [render([mesh, hand], _beside([mesh, hand], candidates, row), TILE, TILE) for row, hand in enumerate(hands)]
    titles = [caption(candidates, row) for row in range(len(candidates))]
    _write(views, titles, dict(zip(obj.labels, PALETTE, strict=False)), columns, obj.name, Path(path))


def picture_contacts(
    mesh: trimesh.Trimesh,
    faces: Sequence[Int[np.ndarray, " f"]],
    titles: Sequence[str],
    name: str,
    path: Path | str,
) -> None:
    """Write a PNG of contact semantic maps, each seen from where most of its contacts are.

    Args:
        mesh: the object's surface, fine enough to carry colours.
        faces: per map the class of every face, 0..6.
        titles: of the maps.
        name: of the object.
        path: of the file.
    """
    table = tuple(PARTS.values())
    views = []
    for classes in faces:
        painted = trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=colours(classes, table), process=False)
        views.append(render([painted], Camera.around([painted], *_towards(mesh, classes > 0)), TILE, TILE))
    _write(views, titles, PARTS, len(views), name, Path(path))


def _towards(mesh: trimesh.Trimesh, faces: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation [rad] of a view from the side to which most of the area of some faces looks."""
    x, y, _ = (mesh.area_faces * faces) @ mesh.face_normals
    return (float(np.arctan2(y, x)) if np.hypot(x, y) > 0 else VIEW[0]), VIEW[1]


def caption(candidates: GraspCandidates, row: int) -> str:
    """Class, deepest overlap and, if ranked, the score of a candidate."""
    words = [candidates.grasp_class[row]]
    depth, score = float(candidates.penetration[row]), float(candidates.score[row])
    if np.isfinite(depth):
        words.append(f"{1000 * depth:.1f} mm deep")
    if np.isfinite(score):
        words.append(f"score {score:.2f}")
    return ", ".join(words)


def _beside(meshes: list[trimesh.Trimesh], candidates: GraspCandidates, row: int) -> Camera:
    """A camera that sees the fingers: across the line from the wrist to the object."""
    x, y, _ = candidates.approach[row].tolist()
    azimuth = np.arctan2(y, x) if np.hypot(x, y) > 0.3 else 0.0
    return Camera.around(meshes, float(azimuth + 1.2), 0.35)


def _write(
    views: Sequence[np.ndarray],
    titles: Sequence[str],
    legend: dict[str, tuple[int, int, int]],
    columns: int,
    name: str,
    path: Path,
) -> None:
    """Views in a grid with titles and one legend, as a PNG."""
    columns = min(columns, len(views))
    rows = -(-len(views) // columns)
    figure = Figure(figsize=(columns * TILE / DPI, (rows * TILE + 50) / DPI), dpi=DPI, layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, view, title in zip(axes, views, titles, strict=False):
        axis.imshow(view)
        axis.set_title(title, fontsize=9)
    patches = [Patch(color=np.divide(colour, 255).tolist(), label=label) for label, colour in legend.items()]
    figure.legend(
        handles=patches, loc="outside lower center", ncols=len(patches), fontsize=9, frameon=False, title=name
    )
    content = io.BytesIO()
    figure.savefig(content, format="png")
    write_bytes(path, content.getvalue())
