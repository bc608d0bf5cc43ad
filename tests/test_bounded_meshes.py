"""Meshes made to be expensive are refused in one sentence, at once and without memory."""

import json
import struct
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
import trimesh
from refusals import ENTITIES, refused, written

from dora.affordance.objects.importing import import_object, read_mesh

MESH: dict[str, Any] = {
    "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "bufferViews": [],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "accessors": [{"count": 300, "componentType": 5126, "type": "VEC3"},
                  {"count": 300_000, "componentType": 5125, "type": "SCALAR"}],
}  # fmt: skip
"""A glTF file of 100,000 triangles without any data."""
NORMALISED = MESH | {"accessors": [{"count": 3, "componentType": 5122, "type": "VEC3", "normalized": True}]}
MESH_OF_60 = [{"primitives": [{"attributes": {"POSITION": 0}}] * 60}]
"""A mesh of many parts, each of a hundred triangles."""
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
"""A triangle of an STL in text."""
CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
"""Vertices of a triangle of an OBJ."""
MODEL = '<model xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
"""Beginning of the model of a 3MF file."""
TRIANGLE = (
    '<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/></vertices>'
    '<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh>'
)
"""A mesh of a 3MF file."""


def glb(header: dict[str, Any] | bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<II", 2, 20 + len(text)) + struct.pack("<II", len(text), 0x4E4F534A) + text


@pytest.mark.parametrize("name", ["a.stl", "a.obj", "a.ply", "a.glb", "a.gltf", "a.off", "a.3mf"])
def test_huge_meshes_are_refused_by_their_size(tmp_path: Path, name: str):
    with (tmp_path / name).open("wb") as stream:
        stream.truncate(10**11)
    with refused("at most 64000000", 1.0):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (MESH | {"accessors": [{"count": 10**10, "componentType": 5126, "type": "VEC3"}]}, "declares"),
        (MESH | {"nodes": [{"children": list(range(1, 3000))}, *[{"mesh": 0}] * 3000]}, "faces; reduce it"),
        (MESH | {"nodes": [{"children": [1]}, {"children": [0], "mesh": 0}]}, "contains itself"),
        (MESH | {"nodes": [*({"children": [i + 1, i + 1]} for i in range(30)), {"mesh": 0}]}, "repeats its parts"),
        (MESH | {"nodes": [{"children": [1, 1]}, {"mesh": 0}]}, "several parents"),
        (MESH | {"nodes": [{}] * 4001}, "more than 4000 nodes"),
        (MESH | {"nodes": [{"mesh": 0}] * 70, "meshes": MESH_OF_60}, "more than 4000 nodes or parts"),
        (MESH | {"nodes": [*({"children": [i + 1]} for i in range(101)), {"mesh": 0}]}, "100 levels deep"),
        (b'{"a":' + b"[" * 100_000, "not valid JSON"),
        ([], "no glTF header"),
        (
            MESH | {"extensionsRequired": ["KHR_draco_mesh_compression"]},
            "which is not read here",
        ),
        (MESH | {"extensionsRequired": ["KHR_mesh_quantization", "EXT_meshopt_compression"]}, "without compression"),
        (MESH | {"extensionsRequired": [5]}, "needs 5, which is not read here"),
        (NORMALISED, "coordinates as normalised integers"),
    ],
)
def test_gltf(tmp_path: Path, header: Any, words: str):
    with refused(words):
        read_mesh(written(tmp_path / "a.glb", glb(header if isinstance(header, bytes) else header or b"[]")))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * 200_001, "200001 faces"),
        ("a.obj", "v 0 0 0\n" * 1_500_001, "1500001 lines"),
        ("a.off", "OFF\n3 600000 0\n" + "0 0 0\n" * 600_000, "600002 lines"),
        ("a.ply", "ply\nformat ascii 1.0\n" + "0 0 0\n" * 600_000, "600002 lines"),
        ("a.ply", "ply\ncomment ascii\n" + "0 0 0\n" * 600_000, "600002 lines"),
        ("a.ply", "ply\nFormat ASCII 1.0\n" + "0 0 0\n" * 600_000, "600002 lines"),
        ("a.ply", "ply\nformat binary_little_endian 1.0 ascii\n" + "0 0 0\n" * 600_000, "600002 lines"),
        ("a.stl", "solid a\n" + "vertex\n" * 600_001 + "endsolid\n", "200000 faces; reduce it"),
        ("a.stl", "solid \u0416\n" + "VERTEX 0 0 0\n" * 900_000 + "endsolid\n", "300000 faces; reduce it"),
        ("a.stl", "solid a\n" + "\n" * 1_500_000 + "endsolid\n", "1500002 lines"),
        ("a.stl", "solid a\nvertex " + "0 " * 100_000 + "\nendsolid\n", "long ones: write it again in binary"),
        ("a.stl", "solid a\nnormal " + "0 " * 100_000 + "\nendsolid\n", "long ones: write it again in binary"),
        ("a.stl", "solid \u0416\n" + FACET.replace(" ", " " * 8) * 90_000 + "endsolid\n", "16000000 with such"),
    ],
)
def test_meshes_in_text_have_a_limit_of_lines(tmp_path: Path, name: str, content: str, words: str):
    with refused(words):
        read_mesh(written(tmp_path / name, content))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.stl", f"solid a\n{FACET}endsolid a\n" * 1001, "1001 solids, and may have 1000: join"),
        ("a.stl", f"SOLID a\n{FACET}ENDSOLID a\n" * 1001, "1001 solids, and may have 1000: join"),
        ("a.obj", CORNERS + "".join(f"usemtl {i}\nf 1 2 3\n" for i in range(1001)), "more than 1000 materials"),
        ("a.obj", CORNERS + "".join(f"usemtl {i}\r\nf 1 2 3\r\n" for i in range(1001)), "more than 1000 materials"),
        ("a.obj", CORNERS + "".join(f"use\\\nmtl {i}\nf 1 2 3\n" for i in range(1001)), "more than 1000 materials"),
        ("a.obj", CORNERS + "".join(f"o {i}\nf 1 2 3\n" for i in range(1001)), "more than 1000 objects"),
        ("a.obj", CORNERS + "".join(f"g {i}\nf 1 2 3\n" for i in range(1001)), "more than 1000 groups"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_parts_have_a_limit(tmp_path: Path, name: str, content: str, words: str, encoding: str):
    with refused(words, 1.0):
        read_mesh(written(tmp_path / name, content.encode(encoding)))


def test_a_few_parts_named_many_times_are_read(tmp_path: Path):
    rows = "".join(f"usemtl {i % 2}\nf 1 2 3\n" for i in range(3000))
    mesh, names = read_mesh(written(tmp_path / "a.obj", CORNERS + rows))
    assert len(mesh.faces) == len(names) == 3000


def zipped(path: Path, **models: str) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in models.items():
            archive.writestr(f"3D/{name}", f"{MODEL}{content}</model>")
    return path


PART = '<component objectid="1" path="/3D/far.model"/>'
"""A component that names another file."""


@pytest.mark.parametrize(
    ("objects", "items", "words"),
    [
        (f'<object id="1">{TRIANGLE}</object>', '<item objectid="1"/>' * 1001, "repeats its parts more than 1000"),
        ("".join(f'<object id="{i}">{TRIANGLE}</object>' for i in range(1001)), "", "more than 1000 objects"),
        (f'<object id="1">{TRIANGLE * 2001}</object>', '<item objectid="1"/>', "more than 1000 objects"),
        (f'<object id="2"><components>{PART * 900}</components></object>', "", "its files too often"),
        (f'<object id="2">{PART.replace("far.model", "far.png")}</object>', "", "'3D/far.png', which is no model"),
        (f'<object id="1">{TRIANGLE}</object><object id="2"><components>{PART * 40}</components></object>',
         '<item objectid="2"/>' * 40, "repeats its parts more than 1000"),
    ],
    ids=["items", "objects", "meshes", "files", "no model", "items of components"],
)  # fmt: skip
def test_3mf(tmp_path: Path, objects: str, items: str, words: str):
    far = {"far.model": '<object id="1"/>' + "<a/>" * 1200, "far.png": ""}
    model = f"<resources>{objects}</resources><build>{items}</build>"
    with refused(words, 1.0):
        read_mesh(zipped(tmp_path / "a.3mf", **{"3dmodel.model": model}, **far))


def test_a_3mf_of_many_parts_is_read(tmp_path: Path):
    objects = "".join(f'<object id="{i}">{TRIANGLE}</object>' for i in range(30))
    items = "".join(f'<item objectid="{i % 30}"/>' for i in range(100))
    model = f"<resources>{objects}</resources><build>{items}</build>"
    assert len(read_mesh(zipped(tmp_path / "a.3mf", **{"3dmodel.model": model}))[0].faces) == 100


@pytest.mark.parametrize("name", ["/dev/zero", "../../etc/passwd", "/etc/passwd"])
def test_a_mesh_reads_no_files_elsewhere(tmp_path: Path, name: str):
    content = MESH | {"buffers": [{"uri": name, "byteLength": 10}]}
    with refused("does not lie beside it"):
        read_mesh(written(tmp_path / "a.gltf", json.dumps(content)))
    mesh = f"mtllib {name}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    assert len(read_mesh(written(tmp_path / "a.obj", mesh))[0].faces) == 1


def test_archives(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "bomb.3mf", "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(13):
            archive.writestr(f"3D/{k}.model", b" " * 10_000_000)
    with refused("unpacks to more than"):
        read_mesh(tmp_path / "bomb.3mf")
    for name, words in (("bomb.zip", "cannot be read as a mesh"), ("bomb.stl", "zip file")):
        with refused(words):
            read_mesh(written(tmp_path / name, (tmp_path / "bomb.3mf").read_bytes()))
    with refused("packed .gzip."):
        read_mesh(written(tmp_path / "a.obj", b"\x1f\x8b\x08"))
    parts = "".join(
        f'<object id="{i}"><components>' + f'<component objectid="{i + 1}"/>' * 4 + "</components></object>"
        for i in range(1, 30)
    )
    namespace = 'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"'
    for model, words in ((parts, "repeats its parts"), (f"{ENTITIES}", "declares a document type|not valid XML")):
        with zipfile.ZipFile(tmp_path / "a.3mf", "w") as archive:
            archive.writestr("3D/3dmodel.model", f"<model {namespace}>{model}</model>")
        with refused(words):
            read_mesh(tmp_path / "a.3mf")


def test_many_loose_triangles(tmp_path: Path):
    corners = np.random.default_rng(0).random((50_000, 3, 3))
    trimesh.Trimesh(corners.reshape(-1, 3), np.arange(150_000).reshape(-1, 3), process=False).export(tmp_path / "a.stl")
    with refused("falls into 50000 parts", 5.0):
        import_object(tmp_path / "a.stl", cache_dir=tmp_path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999\n", "out of bounds|do not exist"),
        ("v 0 0 0\nf -1 -2 -9\n", "out of bounds|do not exist"),
        ("v 0\nv 1\nv 2\nf 1 2 3\n", "three numbers|cannot be read"),
    ],
)
def test_faces_out_of_range(tmp_path: Path, content: str, words: str):
    with refused(words):
        read_mesh(written(tmp_path / "a.obj", content))


@pytest.mark.parametrize("name", ["my mug", "把手", "100%25"])
def test_files_that_a_gltf_names_may_be_encoded_as_its_format_demands(tmp_path: Path, name: str):
    files = trimesh.Scene(trimesh.creation.box((0.05, 0.06, 0.07))).export(file_type="gltf")
    assert isinstance(files, dict)
    content = json.loads(files.pop("model.gltf"))
    for buffer in content["buffers"]:
        (tmp_path / f"{name} {buffer['uri']}").write_bytes(files[buffer["uri"]])
        buffer["uri"] = quote(f"{name} {buffer['uri']}")
    mesh, _ = read_mesh(written(tmp_path / "a.gltf", json.dumps(content)))
    np.testing.assert_allclose(sorted(mesh.extents), (0.05, 0.06, 0.07))
    content["buffers"][0]["uri"] = "%2e%2e/" + content["buffers"][0]["uri"]
    (tmp_path / "below").mkdir()
    with refused("does not lie beside it"):
        read_mesh(written(tmp_path / "below" / "a.gltf", json.dumps(content)))
