"""Limits of mesh files: what archives, glTF and 3MF declare is checked before they are read, triangles after."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dora.errors import InputError
from dora.reading import check_size, checked_xml, parse_json, read_bytes

MOST_BYTES = 64_000_000
"""Size of a mesh file above which it is not read [bytes]."""
MOST_FACES = 200_000
"""Largest number of faces of a mesh."""
MOST_LINES, MOST_ROWS = 1_500_000, 600_000
"""Largest number of lines of a mesh in text: OBJ with normals and textures, and OFF or PLY [1]."""
MOST_UNPACKED = 128_000_000
"""Size of the content of a zip file above which it is not unpacked [bytes]."""
MOST_ENTRIES = 1000
"""Largest number of files in a zip file [1]."""
MOST_INSTANCES = 10_000
"""Largest number of nodes, primitives, or copies of parts [1]."""
MOST_COMPONENTS = 1000
"""Largest number of copies of parts in a 3MF file, whose reader takes some milliseconds for each [1]."""
MOST_NUMBERS = 10_000_000
"""Largest number of elements that the accessors and primitives of a glTF file declare [1]."""
MOST_XML = 350_000
"""Largest number of elements in an XML file of a mesh [1]."""
BINARY = re.compile(rb"[^\n]*\nformat binary_(little|big)_endian 1\.0\r?\n")
"""How a PLY file begins whose content is no text."""
PACKED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ": "xz", b"7z\xbc\xaf": "7z", b"\x28\xb5\x2f\xfd": "zstd"}
"""Kinds of archives by their first bytes."""


def check_container(path: Path) -> None:
    """Refuses a mesh file that is too large, packed, or declares more than it can hold.

    Raises:
        InputError: saying what is wrong.
    """
    check_size(path, "mesh file", MOST_BYTES)
    try:
        with path.open("rb") as stream:
            start = stream.read(20)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): check its permissions.") from error
    kind = next((kind for first, kind in PACKED.items() if start.startswith(first)), None)
    if kind is not None:
        raise InputError(f"{path} is packed ({kind}), which is not read: unpack it.")
    ending = path.suffix.lower()
    if ending == ".3mf":
        _check_3mf(path)
    elif start.startswith(b"PK"):
        raise InputError(f"{path} is a zip file, which is not read: unpack it.")
    elif ending in (".obj", ".off", ".ply"):
        check_lines(path)
    elif ending == ".glb":
        size = int.from_bytes(start[12:16], "little")
        _check_gltf(path, read_bytes(path, "mesh file", MOST_BYTES)[20 : 20 + size])
    elif ending == ".gltf":
        _check_gltf(path, read_bytes(path, "mesh file", MOST_BYTES))


def check_lines(path: Path) -> None:
    """Refuses a mesh in text (OBJ, OFF, or PLY that does not begin as a binary one) with more lines than one of
    `MOST_FACES` faces has.

    Raises:
        InputError: naming the file.
    """
    content = read_bytes(path, "mesh file", MOST_BYTES)
    ending = path.suffix.lower()
    if ending == ".ply" and BINARY.match(content):
        return
    lines, most = content.count(b"\n") + content.count(b"\r"), MOST_LINES if ending == ".obj" else MOST_ROWS
    faces = content.count(b"\nf") + content.count(b"\rf") if ending == ".obj" else 0
    if faces > MOST_FACES:
        raise InputError(f"{path} has {faces} faces; reduce it to at most {MOST_FACES} in a mesh editor.")
    if lines > most or (ending == ".off" and len(content) > MOST_BYTES // 2):
        raise InputError(f"{path} has {lines} lines, and may have {most}: reduce the mesh.")


def check_triangles(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Refuses what is no list of triangles between finite vertices.

    Raises:
        InputError: naming the file.
    """
    if vertices.shape != (len(vertices), 3) or not np.isfinite(vertices).all():
        raise InputError(f"{path} has vertices that are not three finite numbers: write it again.")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer) or not len(faces):
        raise InputError(f"{path} must hold triangles and nothing else: triangulate the mesh.")
    if len(faces) > MOST_FACES:
        raise InputError(f"{path} has {len(faces)} faces; reduce it to at most {MOST_FACES} in a mesh editor.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path} has faces that name vertices which do not exist: write it again.")


def _check_gltf(path: Path, header: bytes) -> None:
    """Refuses accessors, primitives and nodes that become too much, and nodes that contain themselves."""
    content = parse_json(header.decode("utf-8", "replace"), f"the header of {path}")
    if not isinstance(content, dict):
        raise InputError(f"{path} has no glTF header: export it again.")
    counts = [_whole(accessor.get("count")) for accessor in _tables(content.get("accessors"))]
    primitives = [each for mesh in _tables(content.get("meshes")) for each in _tables(mesh.get("primitives"))]
    used = [_whole(n) for each in primitives for n in (each.get("indices"), *_values(each.get("attributes")))]
    declared = sum(counts) + sum(counts[n] for n in used if n < len(counts))
    if declared > MOST_NUMBERS:
        raise InputError(f"{path} declares {declared} numbers; it may have at most {MOST_NUMBERS}: reduce the mesh.")
    nodes = _tables(content.get("nodes"))
    if max(len(nodes), len(primitives)) > MOST_INSTANCES:
        raise InputError(f"{path} has more than {MOST_INSTANCES} nodes or parts: join them.")
    below = [[_whole(n) for n in _list(node.get("children"))] for node in nodes]
    copies(dict(enumerate(below)), range(len(nodes)), path)
    children = [n for each in below for n in each]
    if len(set(children)) < len(children):
        raise InputError(f"{path} has nodes with several parents: export it again.")


def _check_3mf(path: Path) -> None:
    """Refuses a 3MF file that unpacks to too much, or whose components repeat each other too often."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if len(entries) > MOST_ENTRIES or sum(entry.file_size for entry in entries) > MOST_UNPACKED:
                raise InputError(
                    f"{path} unpacks to more than {MOST_UNPACKED} bytes or {MOST_ENTRIES} files: reduce it."
                )
            below: dict[str, list[str]] = {}
            for entry in entries:
                if entry.filename.lower().endswith((".model", ".xml", ".rels")):
                    root = checked_xml(archive.read(entry), f"{entry.filename} in {path}", MOST_XML)
                    for item in root.iter():
                        if item.tag.endswith("}object") or item.tag == "object":
                            parts = [part.get("objectid", "") for part in item.iter() if part.tag.endswith("component")]
                            below.setdefault(item.get("id", ""), []).extend(parts)
            copies(below, below, path, MOST_COMPONENTS)
    except InputError:
        raise
    except Exception as error:  # zipfile and zlib raise several kinds for what is damaged
        raise InputError(f"{path} is no intact 3MF file ({type(error).__name__}): export it again.") from error


def copies(below: Mapping[Any, Sequence[Any]], roots: Iterable[Any], path: Path, most: int = MOST_INSTANCES) -> int:
    """Number of parts below the roots, if all that repeat each other were written out.

    Args:
        below: by part, the parts that it contains; unknown ones count once.
        roots: parts at which counting begins.
        path: of the file, for messages.
        most: largest number of parts below a root.

    Raises:
        InputError: a part contains itself, or there are more than `most` below a root.
    """
    sizes: dict[Any, int] = {}
    for root in roots:
        waiting, open_parts = [root], set()
        while waiting:
            part = waiting[-1]
            inside = [each for each in below.get(part, ()) if each in below]
            missing = [each for each in inside if each not in sizes]
            if part in sizes or not missing:
                sizes.setdefault(part, 1 + sum(sizes[each] for each in inside))
                open_parts.discard(waiting.pop())
                if sizes[part] > most:
                    raise InputError(f"{path} repeats its parts more than {most} times: join them.")
                continue
            open_parts.add(part)
            if any(each in open_parts for each in missing):
                raise InputError(f"{path} has a part that contains itself: export it again.")
            waiting += missing
    return sum(sizes.values())


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _tables(value: Any) -> list[dict[str, Any]]:
    """The tables of a list; an empty one for what is none."""
    return [each if isinstance(each, dict) else {} for each in _list(value)]


def _values(value: Any) -> list[Any]:
    return list(value.values()) if isinstance(value, dict) else []


def _whole(value: Any) -> int:
    """A count or index; 0 for what is none, which the reader refuses by itself."""
    return value if isinstance(value, int) and value >= 0 else 0
