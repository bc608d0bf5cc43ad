"""Writing an object as a folder: `object.toml`, its surface, its filled surface, and a mesh for every convex hull."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path

from dora.affordance.objects.affordance_object import AffordanceObject, Piece
from dora.affordance.objects.folder_reading import FORMAT, OBJECT_FILE, read_object_folder
from dora.affordance.objects.mesh_files import write_ply
from dora.errors import InputError
from dora.files import renew_checksums, write_bytes
from dora.robot.shapes import Shape

MESH, SOLID, HULL = "mesh.ply", "solid.ply", "hull-{}.ply"
"""Names of the meshes: the surface, the same without cavities, and the hull that is the piece of that number."""
WRITTEN = re.compile(r"mesh\.ply|solid\.ply|hull-\d+\.ply")
"""Names of all files of meshes that are written here."""
UNFINISHED = (
    b'format = "unfinished"\nname = ""\nmesh = ""\ntarget = ""\nmass = 0\ninertia = []\nregions = []\npieces = []\n'
)
"""The object.toml while meshes are replaced, so that a folder of old and new files is refused."""


def write_object_folder(obj: AffordanceObject, folder: Path | str) -> Path:
    """Write an object as a folder from which `load_object` reads it with every number the same; returns object.toml.

    The object gets the folder's name. Grasps and reach tables in the folder stay; meshes that are no part of the object
    any more are removed. If writing is cut short, the folder is as before or is refused when it is read.

    Args:
        obj: made by `assemble` or `import_object`, or loaded.
        folder: is made if it does not exist.

    Raises:
        InputError: the object could not be read again, or the folder cannot be written, or is no folder of an object
            and has files of these names.
    """
    folder = Path(folder).resolve()
    check_object_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {folder} ({error.strerror}): choose another one.") from error
    try:
        with tempfile.TemporaryDirectory(prefix=".new-", dir=folder) as place:
            new = Path(place) / folder.name
            new.mkdir()
            try:
                kept = _write(obj, new)
                read_object_folder(new)
            except InputError as error:
                raise InputError(str(error).replace(str(new), str(folder))) from error
            write_bytes(folder / OBJECT_FILE, UNFINISHED)
            for name in sorted(kept):
                os.replace(new / name, folder / name)
            os.replace(new / OBJECT_FILE, folder / OBJECT_FILE)
    except OSError as error:
        raise InputError(f"cannot write {folder} ({error.strerror}): free some space and write it again.") from error
    left = [old for old in folder.glob("*.ply") if WRITTEN.fullmatch(old.name) and old.name not in kept]
    for old in left:
        old.unlink()
    renew_checksums([folder / name for name in (*kept, OBJECT_FILE)], left)
    return folder / OBJECT_FILE


def _write(obj: AffordanceObject, folder: Path) -> set[str]:
    """Write the files of an object into an empty folder; returns the names of its meshes."""
    write_ply(folder / MESH, obj.mesh, obj.face_labels)
    kept = {MESH}
    if obj.solid is not obj.mesh:
        write_ply(folder / SOLID, obj.solid)
        kept.add(SOLID)
    for index, piece in enumerate(obj.pieces):
        if not isinstance(piece.shape, Shape):
            write_ply(folder / HULL.format(index), piece.shape)
            kept.add(HULL.format(index))
    write_bytes(folder / OBJECT_FILE, object_toml(obj, folder.name).encode())
    return kept


def check_object_folder(folder: Path, *sources: Path | None) -> None:
    """Refuse a folder in which writing an object would replace files of somebody else.

    Args:
        folder: to be written.
        sources: files of which the object is made.

    Raises:
        InputError: naming the file.
    """
    place = folder.resolve()
    for source in sources:
        path = None if source is None else source.resolve()
        if path is not None and path.parent == place and (WRITTEN.fullmatch(path.name) or path.name == OBJECT_FILE):
            raise InputError(f"{source} would be replaced by what is made of it: choose another folder, or move it.")
    if os.path.isfile(place / OBJECT_FILE) or not os.path.isdir(place):
        return
    if foreign := sorted(path for path in place.glob("*.ply") if WRITTEN.fullmatch(path.name)):
        raise InputError(f"{foreign[0]} is in a folder without {OBJECT_FILE}: choose another folder, or move the file.")


def object_toml(obj: AffordanceObject, name: str) -> str:
    """Text of the object.toml of an object with this name; numbers have as many digits as give them back exactly."""
    lines = [
        f"format = {_text(FORMAT)}",
        f"name = {_text(name)}",
        f"mesh = {_text(MESH)}  # surface [m], origin at the centre of mass",
        *([] if obj.solid is obj.mesh else [f"solid = {_text(SOLID)}  # the same without cavities"]),
        f"target = {_text(obj.target)}  # region that a task wants held",
        f"mass = {float(obj.mass)!r}  # [kg]",
        "inertia = [  # about the origin [kg m^2]",
        *(f"    {_vector(row)}," for row in obj.inertia.tolist()),
        "]",
        f"friction = {float(obj.friction)!r}  # nominal coefficient",
        f"placement = {_text(obj.placement)}  # table, air or fixture",
        f"rest = {_vector(obj.rest)}  # orientation (w, x, y, z) at rest on a table",
        f"start_posture = {_text(obj.start_posture)}  # of the arm, before a grasp",
    ]
    for label, grasp_class in zip(obj.labels, obj.classes, strict=True):
        lines += ["", "[[regions]]", f"name = {_text(label)}", f"grasp_class = {_text(grasp_class)}"]
    for index, piece in enumerate(obj.pieces):
        lines += ["", "[[pieces]]", f"region = {_text(piece.label)}", *_shape(piece, index)]
    return "\n".join([*lines, ""])


def _shape(piece: Piece, index: int) -> list[str]:
    """Lines about the shape of a piece."""
    if not isinstance(piece.shape, Shape):
        return [f"mesh = {_text(HULL.format(index))}"]
    return [
        f"shape = {_text(piece.shape.kind)}",
        f"position = {_vector(piece.shape.position)}",
        f"quaternion = {_vector(piece.shape.quaternion)}",
        f"size = {_vector(piece.shape.size)}",
    ]


def _vector(values: Iterable[float]) -> str:
    """A list of numbers that are read back as they are."""
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _text(text: str) -> str:
    """A TOML string: what JSON escapes, and DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
