"""Limits of mesh files: what archives, glTF, 3MF and texts declare is checked before they are read, triangles after."""

from __future__ import annotations

import codecs
import re
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from dora.digests import check_file
from dora.errors import InputError, shown
from dora.reading import check_size, checked_xml, decoded, parse_json, read_bytes

MOST_BYTES = 64_000_000
"""Size of a mesh file above which it is not read [bytes]."""
MOST_FACES = 200_000
"""Largest number of faces of a mesh."""
MOST_LINES, MOST_ROWS = 1_500_000, 600_000
"""Largest number of lines of a mesh in text: OBJ with normals and textures or STL, and OFF or PLY [1]."""
MOST_PARTS = 1000
"""Largest number of solids in an STL, of names of one kind in an OBJ, and of objects or of placed copies in a 3MF file,
whose readers take a millisecond or more for each [1]."""
MOST_WIDE = 16_000_000
"""Size of an STL in text with characters of several bytes, which take four bytes each while it is read [bytes]."""
MOST_UNPACKED = 128_000_000
"""Size of the content of a zip file above which it is not unpacked [bytes]."""
MOST_ENTRIES = 1000
"""Largest number of files in a zip file [1]."""
MOST_INSTANCES, MOST_LEVELS = 4000, 100
"""Largest number of nodes, primitives, or copies of parts, and of levels of parts in each other [1]."""
MOST_NUMBERS = 10_000_000
"""Largest number of elements that the accessors and primitives of a glTF file declare [1]."""
MOST_XML, MOST_REREAD = 350_000, 1_000_000
"""Largest number of elements in an XML file of a mesh, and in all files that components name, each time anew [1]."""
HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_mesh_quantization")
"""How extensions of glTF begin that change nothing that is read of a mesh, or are understood."""
BINARY = re.compile(rb"[^\n]*\nformat binary_(little|big)_endian 1\.0\r?\n")
"""How a PLY file begins whose content is no text."""
NAMES = {
    "materials": re.compile(rb"usemtl ([^\n]*)"),
    "objects": re.compile(rb"\no ([^\n]*)"),
    "groups": re.compile(rb"\ng ([^\n]*)"),
}
"""Lines of an OBJ file at which its reader begins another part."""
LONG_ROW = re.compile(rb"(vertex|normal)[^\S\n]*+(\S++[^\S\n]++){12}\S")
"""A row of an STL in text with too many numbers."""
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
    check_file(path)
    ending = path.suffix.lower()
    if ending == ".3mf":
        _check_3mf(path)
    elif start.startswith(b"PK"):
        raise InputError(f"{path} is a zip file, which is not read: unpack it.")
    elif ending in (".obj", ".off", ".ply", ".stl"):
        check_lines(path)
    elif ending == ".glb":
        size = int.from_bytes(start[12:16], "little")
        _check_gltf(path, read_bytes(path, "mesh file", MOST_BYTES)[20 : 20 + size])
    elif ending == ".gltf":
        _check_gltf(path, read_bytes(path, "mesh file", MOST_BYTES))


def without_mark(content: bytes) -> bytes:
    """The content of a file; a text with a byte order mark in UTF-8 without one."""
    marked = content.startswith((codecs.BOM_UTF8, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return decoded(content).encode() if marked else content


def check_lines(path: Path) -> None:
    """Refuses a mesh in text (OBJ, OFF, STL, or PLY that does not begin as a binary one) with more lines than one of
    `MOST_FACES` faces has, or more parts than `MOST_PARTS`.

    Raises:
        InputError: naming the file.
    """
    content = _text(path)
    ending = path.suffix.lower()
    if ending == ".stl":
        _check_stl(path, content)
        return
    if ending == ".ply" and BINARY.match(content):
        return
    lines, most = content.count(b"\n") + content.count(b"\r"), MOST_LINES if ending == ".obj" else MOST_ROWS
    faces = content.count(b"\nf") + content.count(b"\rf") if ending == ".obj" else 0
    if faces > MOST_FACES:
        raise InputError(f"{path} has {faces} faces; reduce it to at most {MOST_FACES} in a mesh editor.")
    if lines > most or (ending == ".off" and len(content) > MOST_BYTES // 2):
        raise InputError(f"{path} has {lines} lines, and may have {most}: reduce the mesh.")
    if ending == ".obj":
        _check_names(path, content, "materials")


def check_groups(path: Path) -> None:
    """Refuses an OBJ file that is to be split and has more than `MOST_PARTS` names of objects or groups.

    Raises:
        InputError: naming the file.
    """
    for kind in ("objects", "groups"):
        _check_names(path, _text(path), kind)


def _text(path: Path) -> bytes:
    """What the reader gets of a file; what begins like a text and is none is left as it is."""
    content = read_bytes(path, "mesh file", MOST_BYTES)
    try:
        return without_mark(content)
    except UnicodeDecodeError:
        return content


def _check_names(path: Path, content: bytes, kind: str) -> None:
    """Refuses too many different names of a kind in an OBJ file, whose lines may go on after a backslash."""
    names = set()
    for found in NAMES[kind].finditer(content.replace(b"\r\n", b"\n").replace(b"\\\n", b"")):
        names.add(found[1].strip())
        if len(names) > MOST_PARTS:
            raise InputError(f"{path} names more than {MOST_PARTS} {kind}: join some in a mesh editor.")


def _check_stl(path: Path, content: bytes) -> None:
    """Refuses too many solids, lines and numbers of an STL in text; one in binary has none of them."""
    if len(content) == 84 + 50 * int.from_bytes(content[80:84], "little"):
        return
    text = content.lower()
    solids, rows = text.count(b"endsolid"), max(text.count(b"vertex"), text.count(b"normal"))
    lines = text.count(b"\n") + text.count(b"\r")
    if solids > MOST_PARTS:
        raise InputError(f"{path} has {solids} solids, and may have {MOST_PARTS}: join some in a mesh editor.")
    if rows > 3 * MOST_FACES:
        raise InputError(f"{path} has {rows // 3} faces; reduce it to at most {MOST_FACES} in a mesh editor.")
    if lines > MOST_LINES or LONG_ROW.search(text):
        raise InputError(f"{path} has {lines} lines (at most {MOST_LINES}), or long ones: write it again in binary.")
    if len(content) > MOST_WIDE and re.search(rb"[\xc4-\xff]", content):
        raise InputError(
            f"{path} has {len(content)} bytes, and may have {MOST_WIDE} with such characters in its text: "
            "write it again in binary."
        )


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
    needed = [name for name in _list(content.get("extensionsRequired")) if not str(name).startswith(HARMLESS)]
    if needed:
        raise InputError(f"{path} needs {shown(needed[0])}, which is not read here: export it without compression.")
    accessors = _tables(content.get("accessors"))
    counts = [_whole(accessor.get("count")) for accessor in accessors]
    primitives = [each for mesh in _tables(content.get("meshes")) for each in _tables(mesh.get("primitives"))]
    used = [_whole(n) for each in primitives for n in (each.get("indices"), *_values(each.get("attributes")))]
    shaped = [accessors[n] for each in primitives if (n := _position(each)) < len(accessors)]
    if any(accessor.get("normalized") for accessor in shaped):
        raise InputError(f"{path} has coordinates as normalised integers: export it without quantisation.")
    declared = sum(counts) + sum(counts[n] for n in used if n < len(counts))
    if declared > MOST_NUMBERS:
        raise InputError(f"{path} declares {declared} numbers; it may have at most {MOST_NUMBERS}: reduce the mesh.")
    nodes = _tables(content.get("nodes"))
    pieces = [len(_list(mesh.get("primitives"))) for mesh in _tables(content.get("meshes"))]
    placed = sum(pieces[n] for node in nodes if (n := _whole(node.get("mesh"))) < len(pieces) and "mesh" in node)
    if max(len(nodes), len(primitives), placed) > MOST_INSTANCES:
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
            found = _Models(path)
            for entry in entries:
                if entry.filename.lower().endswith((".model", ".xml", ".rels")):
                    root = checked_xml(archive.read(entry), f"{entry.filename} in {path}", MOST_XML)
                    found.add(entry.filename, root)
            found.check({entry.filename for entry in entries})
    except InputError:
        raise
    except Exception as error:  # zipfile and zlib raise several kinds for what is damaged
        raise InputError(f"{path} is no intact 3MF file ({type(error).__name__}): export it again.") from error


class _Models:
    """What the XML files of a 3MF file hold: objects, their components, and what is placed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.below: dict[str | None, list[str]] = {None: []}
        self.sizes: dict[str, int] = {}
        self.named: list[str] = []
        self.objects = 0

    def add(self, name: str, root: ElementTree.Element) -> None:
        """Takes what an XML file holds; InputError if there are too many objects."""
        self.sizes[name] = 0
        for item in root.iter():
            kind = item.tag.rpartition("}")[2]
            self.sizes[name] += 1
            self.objects += kind in ("object", "mesh")
            if kind == "object":
                parts = [part.attrib for part in item.iter() if part.tag.endswith("component")]
                self.below.setdefault(item.get("id", ""), []).extend(part.get("objectid", "") for part in parts)
                self.named += [
                    value.strip("/") for part in parts for key, value in part.items() if key.endswith("path")
                ]
            elif kind == "item":
                self.below[None].append(item.get("objectid", ""))
        if self.objects > 2 * MOST_PARTS:
            raise InputError(f"{self.path} has more than {MOST_PARTS} objects: join some.")

    def check(self, files: set[str]) -> None:
        """Refuses too many copies, and too many elements in files that components name."""
        strange = next((name for name in self.named if name in files and name not in self.sizes), None)
        if strange is not None:
            raise InputError(f"{self.path} has a part in {shown(strange)}, which is no model: export it again.")
        if sum(self.sizes.get(name, 0) for name in self.named) > MOST_REREAD:
            raise InputError(f"{self.path} names the parts of its files too often: export one file with all parts.")
        copies(self.below, self.below, self.path, MOST_PARTS)


def copies(below: Mapping[Any, Sequence[Any]], roots: Iterable[Any], path: Path, most: int = MOST_INSTANCES) -> int:
    """Number of parts below the roots, if all that repeat each other were written out.

    Args:
        below: by part, the parts that it contains; unknown ones count once.
        roots: parts at which counting begins.
        path: of the file, for messages.
        most: largest number of parts below a root.

    Raises:
        InputError: a part contains itself, or there are more than `most` or than `MOST_LEVELS` levels below a root.
    """
    sizes: dict[Any, int] = {}
    levels: dict[Any, int] = {}
    for root in roots:
        waiting, open_parts = [root], set()
        while waiting:
            part = waiting[-1]
            inside = [each for each in below.get(part, ()) if each in below]
            missing = [each for each in inside if each not in sizes]
            if part in sizes or not missing:
                sizes.setdefault(part, 1 + sum(sizes[each] for each in inside))
                levels.setdefault(part, 1 + max((levels[each] for each in inside), default=0))
                open_parts.discard(waiting.pop())
                if sizes[part] > most:
                    raise InputError(f"{path} repeats its parts more than {most} times: join them.")
                if levels[part] > MOST_LEVELS:
                    raise InputError(f"{path} has parts in each other, more than {MOST_LEVELS} levels deep: join them.")
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


def _position(primitive: dict[str, Any]) -> int:
    """Index of the accessor with the coordinates of a glTF primitive."""
    attributes = primitive.get("attributes")
    return _whole(attributes.get("POSITION")) if isinstance(attributes, dict) else 0


def _whole(value: Any) -> int:
    """A count or index; 0 for what is none, which the reader refuses by itself."""
    return value if isinstance(value, int) and value >= 0 else 0
