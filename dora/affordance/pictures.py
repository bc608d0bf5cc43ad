"""PNG pictures of affordance maps and grasps, on any machine."""

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
VIEWS = ((0.6, 0.35), (2.6, 0.35), (4.6, 0.6))
"""Azimuth and elevation of the views of a map [rad]."""


def coloured(obj: AffordanceObject) -> trimesh.Trimesh:
    """The object's mesh, every face in the colour of its region."""
    mesh = obj.mesh
    return trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=colours(obj.face_labels, PALETTE), process=False)


def picture_map(obj: AffordanceObject, path: Path | str) -> None:
    """Write a PNG of the object's regions from three sides, with a legend."""
    mesh = coloured(obj)
    views = [render([mesh], Camera.around([mesh], *view), TILE, TILE) for view in VIEWS]
    _write(views, [""] * len(views), dict(zip(obj.labels, PALETTE, strict=False)), len(views), obj.name, Path(path))


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
    obj: AffordanceObject, faces: Sequence[Int[np.ndarray, " f"]], titles: Sequence[str], path: Path | str
) -> None:
    """Write a PNG of contact semantic maps: per map the class of every face of the object's mesh, 0..6."""
    table = tuple(PARTS.values())
    views = []
    for classes in faces:
        mesh = trimesh.Trimesh(obj.mesh.vertices, obj.mesh.faces, face_colors=colours(classes, table), process=False)
        views.append(render([mesh], Camera.around([mesh], *VIEWS[0]), TILE, TILE))
    _write(views, titles, PARTS, len(views), obj.name, Path(path))


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
