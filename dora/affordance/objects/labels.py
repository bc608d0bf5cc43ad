"""Labels of the faces of a user's mesh: from a file with one per face, from regions in space, or from part names."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from dora.digests import check_file
from dora.errors import InputError, shown
from dora.reading import read_array, read_json, read_text, read_yaml

WHOLE = "body"
"""Label of a mesh without parts, and of faces in no region."""
WHAT = "label file"
"""How messages call the file."""
MOST_BYTES = 64_000_000
"""Size of a .npy file of labels above which it is not read [bytes]."""
MOST_REGIONS, LONGEST_NAME = 256, 200
"""Largest number of regions, and of characters in the name of one [1]."""
LONGEST_CLASS = LONGEST_NAME - len("No256Grasp")
"""Number of characters of a grasp class without its end, after which the rest of a long name is left out [1]."""
LARGEST_NUMBER = 1e9
"""Coordinates are smaller than this, in the unit of length of the mesh file."""
WANTED = "handle"
"""Label that is the default target if a mesh has it."""
COPY = "0123456789._ -()"
"""Characters at the end of the name of a copy."""
UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn")
"""Unicode categories of characters that do not show, such as byte order marks and marks of direction."""
NAMELESS, NUMBER = "Region", "No"
"""Grasp class of a name without letters or digits, and what stands before the number of a class."""


@dataclass(frozen=True, eq=False)
class FaceLabels:
    """Labels of f faces.

    Attributes:
        names: names of the regions, each with at least one face.
        index: (f,) index into `names`.
        target: name of the region that a task wants inside.
    """

    names: tuple[str, ...]
    index: Int[np.ndarray, " f"]
    target: str

    @classmethod
    def from_names(cls, names: Sequence[str], target: str | None = None, source: str = "the mesh") -> FaceLabels:
        """Labels from one name per face.

        Args:
            names: name of every face.
            target: name of the target; `WANTED` if a face has it, else the first name, if None.
            source: what the message of an error calls the source of the target.

        Raises:
            InputError: the target is none of the names, there are more than `MOST_REGIONS`, or one is too long.
        """
        tidy = {name: _tidy(name, source) for name in dict.fromkeys(names)}
        distinct = tuple(dict.fromkeys(tidy.values()))
        if len(distinct) > MOST_REGIONS:
            raise InputError(f"{source} has {len(distinct)} different labels; give at most {MOST_REGIONS}.")
        long = next((name for name in distinct if len(name) > LONGEST_NAME), None)
        if long is not None:
            raise InputError(f"{source} has the label {shown(long)}; give names of at most {LONGEST_NAME} characters.")
        target = None if target is None else _tidy(str(target), source)
        if target is None:
            target = WANTED if WANTED in distinct else distinct[0]
        if target not in distinct:
            raise InputError(f"{source} asks for the target {shown(target)}; choose one of: {', '.join(distinct)}.")
        place = {name: i for i, name in enumerate(distinct)}
        return cls(distinct, np.array([place[tidy[name]] for name in names], np.int64), target)


def _tidy(name: str, source: str) -> str:
    """A name in composed letters, without characters that do not show and with single spaces between its words."""
    visible = "".join(" " if c.isspace() else c for c in name if c.isspace() or unicodedata.category(c) not in UNSEEN)
    tidy = " ".join(unicodedata.normalize("NFC", visible).split())
    if not tidy:
        raise InputError(f"{source} has a region whose name {name!r} shows no character; give it a name.")
    return tidy


def without_number(name: str) -> str:
    """A name without the numbers that editors add to copies: "handle.001", "handle_2" and "handle (2)" -> "handle"."""
    start = name.rstrip(COPY)
    end = name[len(start) :]
    return start if start and end.strip("._ -()") and end[-1] not in "._ -(" else name


def grasp_class(label: str) -> str:
    """Grasp class of a label in any script: "handle" -> "HandleGrasp", "left ear" -> "LeftEarGrasp"."""
    letters = unicodedata.normalize("NFC", label)
    words = "".join(c if unicodedata.category(c)[0] in "LMN" else " " for c in letters).split()
    return "".join(word[:1].upper() + word[1:] for word in words or [NAMELESS])[:LONGEST_CLASS] + "Grasp"


def grasp_classes(labels: Iterable[str]) -> dict[str, str]:
    """Grasp class of each label; those that would be equal are told apart by a number: "rim 1", "rim-1"."""
    found: dict[str, str] = {}
    for label in labels:
        name, count = grasp_class(label), 1
        while name in found.values():
            count += 1
            name = f"{grasp_class(label).removesuffix('Grasp')}{NUMBER}{count}Grasp"
        found[label] = name
    return found


def read_labels(path: Path, centers: Float[np.ndarray, "f 3"]) -> FaceLabels:
    """Labels of the faces of a mesh.

    Args:
        path: .txt with one name or number per line, .npy with one number or name per face, .json with a list of
            them or {"labels": [names], "faces": [numbers], "target": name}, or .yaml with regions (docs/objects.md).
        centers: (f, 3) centres of the faces in the coordinates of the mesh file, in its unit of length.

    Raises:
        InputError: no such file, another kind of file, another number of labels, or a name that does not exist.
    """
    readers: dict[str, Callable[[Path, np.ndarray], FaceLabels]] = {
        ".txt": _from_text, ".npy": _from_array, ".json": _from_json, ".yaml": _from_yaml, ".yml": _from_yaml,
    }  # fmt: skip
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"labels cannot be read from {path}: give a file ending in {', '.join(readers)}.")
    check_file(path)
    return reader(path, centers)


def _from_text(path: Path, centers: np.ndarray) -> FaceLabels:
    return _per_face(path, read_text(path, WHAT).split("\n"), centers)


def _from_array(path: Path, centers: np.ndarray) -> FaceLabels:
    found = read_array(path, WHAT, MOST_BYTES).ravel()
    if found.size > 2 * len(centers):  # before texts are made of all
        raise InputError(
            f"{path} has {found.size} labels for the {len(centers)} triangles of the mesh: give one for each."
        )
    if found.dtype.kind == "f" and not (np.isfinite(found).all() and (found == np.round(found)).all()):
        raise InputError(f"{path} has labels that are not whole numbers: give whole numbers or names.")
    if found.dtype.kind == "f":
        found = found.astype(np.int64)
    try:
        entries = [str(each, "utf-8") if isinstance(each, bytes) else each for each in found.tolist()]
    except ValueError as error:
        raise InputError(f"{path} has labels that are no text ({error}): write it again.") from error
    return _per_face(path, entries, centers)


def _from_json(path: Path, centers: np.ndarray) -> FaceLabels:
    content = read_json(path, WHAT)
    if isinstance(content, list):
        return _per_face(path, content, centers)
    known = {"labels", "faces", "target"}
    if not isinstance(content, dict) or not {"labels", "faces"} <= content.keys() <= known:
        raise InputError(f'{path} must be a list, or hold "labels", "faces" and if wanted "target", nothing else.')
    if not isinstance(content["labels"], list) or not isinstance(content["faces"], list):
        raise InputError(f'{path} must hold lists as "labels" and "faces".')
    names = [_name(path, name) for name in content["labels"]]
    return _per_face(path, content["faces"], centers, names, _target(path, content))


def _name(path: Path, value: Any) -> str:
    """A text, or a number as one."""
    if not isinstance(value, str | int) or isinstance(value, bool):
        raise InputError(f"{path} has the label {shown(value)}; give a name or a whole number.")
    return str(value)


def _target(path: Path, content: dict[str, Any]) -> str | None:
    return None if content.get("target") is None else _name(path, content["target"])


def _per_face(
    path: Path, entries: Sequence[Any], centers: np.ndarray, names: Sequence[str] = (), target: str | None = None
) -> FaceLabels:
    """Labels from one entry per face: a name, an index into `names`, or without `names` any number."""
    texts = [_name(path, entry).strip() for entry in entries]
    while texts and not texts[-1]:
        texts.pop()
    if len(texts) != len(centers):
        raise InputError(
            f"{path} has {len(texts)} labels for the {len(centers)} triangles of the mesh: give one for each, "
            "in the order of the mesh file."
        )
    known = {str(i): name for i, name in enumerate(names)} | {name: name for name in names}
    for face, text in enumerate(texts):
        if not text or text.startswith("-") or (names and text not in known):
            choice = ", ".join(names) or "a name or a number from 0"
            raise InputError(f"{path} labels face {face} {shown(text)}, which is no label; use {choice}.")
    return FaceLabels.from_names([known.get(t, f"region{t}" if t.isdigit() else t) for t in texts], target, str(path))


def _from_yaml(path: Path, centers: np.ndarray) -> FaceLabels:
    """Labels from regions in space; a face belongs to the first region that contains its centre."""
    content = read_yaml(path, WHAT)
    known = {"regions", "rest", "target"}
    if not isinstance(content, dict) or not isinstance(content.get("regions"), dict) or not content.keys() <= known:
        raise InputError(f"{path} must hold a mapping 'regions' and, if wanted, 'rest' and 'target', nothing else.")
    if sum(len(shape) if isinstance(shape, list) else 1 for shape in content["regions"].values()) > MOST_REGIONS:
        raise InputError(f"{path} has more than {MOST_REGIONS} regions or parts of them: join some.")
    names = np.full(len(centers), _name(path, content.get("rest", WHOLE)), dtype=object)
    free = np.ones(len(centers), bool)
    for given, shape in content["regions"].items():
        name = _name(path, given)
        inside = _inside(path, name, shape, centers)
        if not inside.any():
            raise InputError(
                f"region {shown(name)} of {path} holds no face; the mesh reaches from "
                f"{centers.min(0).round(4).tolist()} to {centers.max(0).round(4).tolist()} in its coordinates."
            )
        if not (inside & free).any():
            before = ", ".join(shown(each) for each in dict.fromkeys(names[inside]))
            raise InputError(
                f"region {shown(name)} of {path} holds no face that is not in an earlier region ({before}): a face "
                "belongs to the first one that has it, so put it before those."
            )
        names[inside & free] = name
        free &= ~inside
    return FaceLabels.from_names(names.tolist(), _target(path, content), str(path))


SHAPES = {"box": ("min", "max"), "plane": ("point", "normal")}
"""Kinds of regions and their two vectors: a box between corners, or the half space to which a plane's normal points."""


def _inside(
    path: Path, name: str, shape: Any, centers: Float[np.ndarray, "f 3"], within: bool = False
) -> Bool[np.ndarray, " f"]:
    """Mask of the centres that lie in a region, or in any of a list of regions."""
    if isinstance(shape, list) and shape and not within:
        return np.logical_or.reduce([_inside(path, name, each, centers, True) for each in shape])
    for kind, keys in SHAPES.items():
        if isinstance(shape, dict) and list(shape) == [kind] and isinstance(shape[kind], dict):
            vectors = [_vector(shape[kind].get(key)) for key in keys]
            if len(shape[kind]) == 2 and all(vector is not None for vector in vectors):
                first, second = vectors
                if kind == "box":
                    return np.logical_and.reduce((centers >= first) & (centers <= second), axis=1)
                return (centers - first) @ second > 0
    raise InputError(
        f"region {shown(name)} of {path} must be box: {{min: [x, y, z], max: [x, y, z]}} or "
        "plane: {point: [x, y, z], normal: [x, y, z]}, or a list of these."
    )


def _vector(value: Any) -> Float[np.ndarray, " 3"] | None:
    """Three numbers below `LARGEST_NUMBER`; None for anything else."""
    if not isinstance(value, list) or len(value) != 3:
        return None
    if not all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < LARGEST_NUMBER for x in value):
        return None
    return np.array(value, np.float64)
