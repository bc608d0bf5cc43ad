"""The objects that can be named: folders of `objects/` and of DORA_OBJECTS, and how one is loaded."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import dora
from dora.affordance.objects.affordance_object import AffordanceObject, Piece
from dora.affordance.objects.folder_reading import OBJECT_FILE, read_object_folder
from dora.affordance.objects.importing import import_object
from dora.errors import InputError, suggestion
from dora.reading import entries

__all__ = ["AffordanceObject", "Piece", "available_objects", "load_object"]

SEARCH_VARIABLE = "DORA_OBJECTS"
"""Environment variable with further folders of objects, separated as in PATH."""
MESHES = (".glb", ".obj", ".off", ".ply", ".stl")
"""Endings of files that count as objects where they lie beside the folders of objects."""


def own_objects() -> Path:
    """The folder of the objects that come with Dora: the wheel's, or the repository's."""
    package = Path(dora.__file__).parent
    return package / "_objects" if (package / "_objects").is_dir() else package.parent / "objects"


def object_places() -> dict[str, Path]:
    """Folder, or mesh file, of every object that can be named; of two with one name the later place counts, and in
    it the folder."""
    found: dict[str, Path] = {}
    extra = [Path(part) for part in os.environ.get(SEARCH_VARIABLE, "").split(os.pathsep) if part]
    for place in (own_objects(), *extra):
        there = entries(place)
        found |= {path.stem: path for path in there if path.suffix.lower() in MESHES}
        found |= {path.name: path for path in there if os.path.isfile(path / OBJECT_FILE)}  # made from such a mesh
    return found


def available_objects() -> tuple[str, ...]:
    """Names that `load_object` knows, sorted."""
    return tuple(sorted(object_places()))


def load_object(name: str | Path) -> AffordanceObject:
    """An object, read once per process, and again if its files have changed.

    Args:
        name: one of `available_objects`, the folder of an object.toml, or a mesh file, which is taken to be in metres
            and without further labels (`import_object` asks for more).

    Raises:
        InputError: there is no such object, or its files do not fit.
    """
    places = object_places()
    path = places.get(str(name), Path(name))
    if os.path.isdir(path):
        return _read_folder(path.resolve(), _times(path))
    if os.path.isfile(path):
        return _read_mesh(path.resolve(), path.stat().st_mtime_ns)
    hint = suggestion(name, sorted(places))
    raise InputError(f"there is no object {str(name)!r}, nor a folder or mesh at that path: {hint}")


def _times(folder: Path) -> tuple[int, ...]:
    """Times of the last changes of an object's description and meshes [ns]; none if they may not be looked at."""
    try:
        return tuple(path.stat().st_mtime_ns for path in (folder / "object.toml", *sorted(folder.glob("*.ply"))))
    except OSError:
        return ()


@functools.cache
def _read_folder(folder: Path, times: tuple[int, ...]) -> AffordanceObject:
    """The object of a folder as it was at the times of its last changes."""
    return read_object_folder(folder)


@functools.cache
def _read_mesh(path: Path, time: int) -> AffordanceObject:
    """The object of a mesh file as it was at a time of its last change."""
    return import_object(path)
