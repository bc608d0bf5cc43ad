"""Picture files of an object: its regions, some of its grasps, and their contact semantic maps."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.contact_maps import mapped
from dora.affordance.maps.voting import NO_CONTACT, vote_over_map
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import available_objects, load_object
from dora.affordance.search.cache import hand_of, map_of
from dora.affordance.views.map_pictures import picture_map
from dora.affordance.views.pictures import caption, picture_contacts, picture_grasps, picture_objects
from dora.affordance.views.surface import Surface
from dora.errors import InputError
from dora.geometry.rotations import rotation_angle
from dora.robot import RobotDescription

SHOWN = 4
"""Largest number of grasps in a picture."""
FINER = 2.0
"""Ratio of the edges of triangles on a page to those in a picture of contact semantic maps [1]."""
METRES_PER_RADIAN = 0.1
"""Distance that a turn of the wrist counts as [m/rad]."""
OBJECTS = "objects.png"
"""File name of the picture of all objects."""


def write_album(
    obj: AffordanceObject, candidates: GraspCandidates | None, robot: RobotDescription, folder: Path
) -> list[Path]:
    """Write OBJECT-map.png and, with candidates, OBJECT-grasps.png and OBJECT-contacts.png; returns their paths.

    Args:
        obj: the object.
        candidates: candidates of this object, best first, of which `chosen` are shown; None for the regions only.
        robot: the robot whose hand grasps.
        folder: folder of the files, created if missing.

    Raises:
        InputError: the folder or a file cannot be written.
    """
    _make(folder)
    paths = [folder / f"{obj.name}-{what}.png" for what in ("map", "grasps", "contacts")]
    picture_map(map_of(obj, "cpu"), paths[0])
    if candidates is None:
        return paths[:1]
    shown = candidates.select(chosen(candidates))
    picture_grasps(shown, obj, robot, paths[1])
    surface = Surface(obj, FINER)
    shown = mapped(shown, surface.map, hand_of(robot, "cpu"))
    maps = [surface.parts(each) for each in shown.contact_map]
    voted = vote_over_map(surface.map, shown.contact_map).tolist()
    held = ["nothing" if label == NO_CONTACT else obj.labels[label] for label in voted]
    titles = [(caption(shown, row), f"the other side; the map votes for {name}") for row, name in enumerate(held)]
    picture_contacts(surface.mesh, maps, titles, obj.name, paths[2])
    return paths


def write_objects(folder: Path) -> Path:
    """Write a picture of all bundled objects into a folder; returns its path.

    Raises:
        InputError: the folder or the file cannot be written.
    """
    _make(folder)
    picture_objects([load_object(name) for name in available_objects()], folder / OBJECTS)
    return folder / OBJECTS


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make the folder {folder} ({error.strerror}): choose another one.") from error


def chosen(candidates: GraspCandidates) -> list[int]:
    """Rows of at most `SHOWN` valid grasps (of any if none is valid): the first of every class, then one by one
    the grasp whose wrist is farthest from those that are shown already, of those that have ever succeeded where some
    have."""
    valid = candidates.valid.nonzero()[:, 0].tolist() or list(range(len(candidates)))
    names = candidates.grasp_class
    found = [row for i, row in enumerate(valid) if names[row] not in {names[other] for other in valid[:i]}][:SHOWN]
    proven = [row for row in valid if row in found or candidates.score[row] > 0]
    valid = proven if (candidates.score > 0).any() else valid
    position, turn = candidates.position[valid], candidates.quaternion[valid]

    def away(row: int) -> Tensor:
        distance = (position - candidates.position[row]).norm(dim=-1)
        return distance + METRES_PER_RADIAN * rotation_angle(turn, candidates.quaternion[row].expand_as(turn))

    while len(found) < min(SHOWN, len(valid)):
        nearest = torch.stack([away(row) for row in found]).amin(0)
        nearest[[valid.index(row) for row in found]] = -1.0  # none twice, where grasps are alike
        found.append(valid[int(nearest.argmax())])
    return sorted(found)
