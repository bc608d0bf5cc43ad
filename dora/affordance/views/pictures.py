"""PNG pictures of objects, grasps and contact semantic maps, drawn without a graphics driver."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Int

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.hand_mesh import HandMesh
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.palette import PALETTE, colours, legend_of
from dora.affordance.views.rasteriser import Camera, render, seen
from dora.affordance.views.sheet import Panel, write_sheet
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
"""Colours (red, green, blue, 0 to 255) of the classes 0 to 6 of a contact semantic map."""
TILE = 420
"""Width and height of one view [pixels]."""
OBJECT_VIEW = (-1.0, 0.35)
"""Azimuth and elevation of the views of objects [rad]."""
VIEW = (0.6, 0.5)
"""Azimuth of the view of a contact map without contacts, and elevation of all of them [rad]."""
AZIMUTHS, ELEVATIONS = 8, (0.15, 0.55)
"""Number of azimuths, and the elevations [rad], among which the view of a grasp is chosen."""
PREVIEW = 64
"""Width and height of the small views by which the best one is chosen [pixels]."""
CONTACT_NEIGHBOURHOOD = 0.03
"""Largest distance to a contact point of the faces that a view should show [m]."""
MILLIMETRES = 1000.0
"""Millimetres per metre [1]."""


def coloured(obj: AffordanceObject) -> trimesh.Trimesh:
    """The object's mesh, every face in the colour of its region."""
    mesh = obj.mesh
    return trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=colours(obj.face_labels, PALETTE), process=False)


def picture_objects(objects: Sequence[AffordanceObject], path: Path | str) -> None:
    """Write a PNG of objects with the names and colours of their regions; every object fills its view.

    Raises:
        InputError: the file cannot be written.
    """
    panels = []
    for obj in objects:
        mesh = coloured(obj)
        size = " x ".join(f"{MILLIMETRES * extent:.0f}" for extent in mesh.extents)
        view = render([mesh], Camera.around([mesh], *OBJECT_VIEW), TILE, TILE)
        panels.append(Panel(view, f"{obj.name}, {size} mm", legend_of(obj.labels)))
    write_sheet(panels, path, len(panels))


def picture_grasps(
    candidates: GraspCandidates, obj: AffordanceObject, robot: RobotDescription, path: Path | str, columns: int = 4
) -> None:
    """Write a PNG with one view of every candidate, the hand in its posture at contact.

    The view of each is that of `best_view`.

    Args:
        candidates: a few candidates.
        obj: their object.
        robot: the robot whose hand grasps.
        path: path of the file.
        columns: views in a row.

    Raises:
        InputError: the file cannot be written.
    """
    mesh, panels = coloured(obj), []
    vertices, faces, *_ = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, CONTACT_NEIGHBOURHOOD)
    cut = trimesh.Trimesh(vertices, faces, process=False)
    model = HandMesh(robot)
    for row, hand in enumerate(model.posed(candidates.position, candidates.quaternion, candidates.joints)):
        camera = best_view(cut, hand, _near_contacts(candidates, row, cut.triangles_center), model.fingers)
        view = render([mesh, hand], camera, TILE, TILE)
        panels.append(Panel(view, caption(candidates, row)))
    write_sheet(panels, path, min(columns, len(panels)), legend_of(obj.labels), obj.name)


def picture_contacts(
    mesh: trimesh.Trimesh,
    faces: Sequence[Int[np.ndarray, " f"]],
    titles: Sequence[tuple[str, str]],
    name: str,
    path: Path | str,
) -> None:
    """Write a PNG of contact semantic maps, each from the side with most of its contacts and from the opposite one.

    Args:
        mesh: the object's surface, subdivided finely enough to carry colours [m].
        faces: per map the class (f,) of every face, 0 to 6.
        titles: of every map, above its two views.
        name: name of the object.
        path: path of the file.

    Raises:
        InputError: the file cannot be written.
    """
    table = tuple(PARTS.values())
    front, back = [], []
    for classes, (title, other) in zip(faces, titles, strict=True):
        painted = trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=colours(classes, table), process=False)
        azimuth = _towards(mesh, classes > 0)
        for panels, turn, words in ((front, 0.0, title), (back, np.pi, other)):
            camera = Camera.around([painted], azimuth + turn, VIEW[1])
            panels.append(Panel(render([painted], camera, TILE, TILE), words))
    write_sheet([*front, *back], path, len(front), PARTS, name)


def _towards(mesh: trimesh.Trimesh, faces: np.ndarray) -> float:
    """Azimuth of the mean normal of a mask of faces, weighted by area [rad]."""
    x, y, _ = (mesh.area_faces * faces) @ mesh.face_normals
    return float(np.arctan2(y, x)) if np.hypot(x, y) > 0 else VIEW[0]


def caption(candidates: GraspCandidates, row: int) -> str:
    """Class, penetration depth and, if ranked, the score of a candidate."""
    words = [candidates.grasp_class[row]]
    depth, score = float(candidates.penetration[row]), float(candidates.score[row])
    if np.isfinite(depth):
        words.append(f"{1000 * depth:.1f} mm deep")
    if np.isfinite(score):
        words.append(f"score {score:.2f}")
    return ", ".join(words)


def best_view(
    mesh: trimesh.Trimesh, hand: trimesh.Trimesh, touched: Bool[np.ndarray, " f"], fingers: Bool[np.ndarray, " h"]
) -> Camera:
    """The camera around both meshes with the largest product of visible touched faces and visible fingers, in pixels.

    Args:
        mesh: the object [m].
        hand: the hand in its posture, in the same frame [m].
        touched: (f,) mask of the faces of the object that count.
        fingers: (h,) mask of the faces of the hand that count.
    """
    part = np.concatenate([touched, np.zeros(len(fingers) + 1, bool)])
    finger = np.concatenate([np.zeros(len(touched), bool), fingers, [False]])

    def worth(camera: Camera) -> int:
        found = seen([mesh, hand], camera, PREVIEW, PREVIEW)
        return int(part[found].sum()) * int(finger[found].sum())

    azimuths = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    return max((Camera.around([mesh, hand], float(a), e) for a in azimuths for e in ELEVATIONS), key=worth)


def _near_contacts(candidates: GraspCandidates, row: int, centres: np.ndarray) -> Bool[np.ndarray, " f"]:
    """Mask (f,) of faces with centres (f, 3) [m] near a contact of a candidate; all if it has no contact."""
    points = candidates.contacts[row][candidates.contact_finger[row] > 0].numpy()
    if not len(points):
        return np.ones(len(centres), bool)
    return np.linalg.norm(centres[:, None] - points, axis=-1).min(1) < CONTACT_NEIGHBOURHOOD
