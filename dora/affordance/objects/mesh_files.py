"""Meshes of an object's folder: binary PLY in double precision, with the region of every face.

PLY is what mesh editors open; doubles, because trimesh writes floats and a rounded vertex is another simulation.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Int
from trimesh.exchange.ply import load_ply

from dora.affordance.objects.palette import PALETTE, colours
from dora.containers import MOST_BYTES, check_lines, check_triangles
from dora.digests import check_file
from dora.errors import InputError
from dora.files import write_bytes

LABEL = "label"
"""Property of a PLY face: the index of its region."""
LABELLED = [("vertices", "<i4", 3), ("red", "u1"), ("green", "u1"), ("blue", "u1"), (LABEL, "<i4")]
"""What is stored for a face of a labelled mesh; its colour is for viewers alone and is not read."""


def write_ply(path: Path, mesh: trimesh.Trimesh, labels: Int[np.ndarray, " f"] | None = None) -> None:
    """Write a mesh [m], atomically and without rounding.

    Args:
        path: of the file.
        mesh: f triangles.
        labels: (f,) region of every face, stored together with the region's colour; None for a mesh without regions.

    Raises:
        InputError: the file cannot be written.
    """
    stored = LABELLED if labels is not None else LABELLED[:1]
    faces = np.zeros(len(mesh.faces), [("count", "u1"), *stored])
    faces["count"], faces["vertices"] = 3, mesh.faces
    if labels is not None:
        faces[LABEL] = labels
        for channel, name in enumerate(("red", "green", "blue")):
            faces[name] = colours(labels, PALETTE)[:, channel]
    types = {"u1": "uchar", "<i4": "int"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment lengths in metres",
        f"element vertex {len(mesh.vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        *(f"property {types[kind]} {name}" for name, kind, *_ in stored[1:]),
        "end_header\n",
    ]
    vertices = np.asarray(mesh.vertices, "<f8")
    write_bytes(path, "\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def read_ply(path: Path) -> tuple[trimesh.Trimesh, Int[np.ndarray, " f"] | None]:
    """A mesh [m] with its vertices and faces as they are in the file, and the label of every face if it has labels.

    Raises:
        InputError: no such file, too large, not PLY, damaged, not of triangles, or with numbers out of range.
    """
    if not os.path.isfile(path):
        raise InputError(f"there is no mesh file {path}; put it there or correct its name.")
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path} has {path.stat().st_size} bytes; reduce the mesh to at most {MOST_BYTES}.")
    check_file(path)
    check_lines(path)
    try:
        with path.open("rb") as stream:
            content = load_ply(stream, fix_texture=False, skip_materials=True)
        vertices, faces = np.array(content["vertices"], np.float64), np.array(content["faces"])
        labels = _labels(content["metadata"]["_ply_raw"]["face"]["data"])
    except Exception as error:  # the reader raises whatever it meets in a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} is no intact PLY file ({reason}): write it again.") from error
    check_triangles(path, vertices, faces)
    if labels is not None and (labels.shape != (len(faces),) or not np.issubdtype(labels.dtype, np.integer)):
        raise InputError(f"{path} must give every face one whole number as its {LABEL!r}.")
    mesh = trimesh.Trimesh(vertices, faces.astype(np.int64), process=False)
    return mesh, None if labels is None else labels.astype(np.int64)


def _labels(faces: Any) -> np.ndarray | None:
    """The labels among the properties of all faces: columns of an array (binary files) or of a mapping (text)."""
    names = faces if isinstance(faces, dict) else faces.dtype.names or ()
    return np.array(faces[LABEL]).reshape(-1) if LABEL in names else None
