"""Folders of objects that are damaged or do not fit are refused in one sentence that names the file."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from boxes import two_regions
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dora.affordance.objects.affordance_object import moved
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.folder_writing import write_object_folder
from dora.affordance.objects.mesh_files import write_ply
from dora.containers import MOST_BYTES
from dora.errors import InputError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A user's folder of objects with a box in it."""
    write_object_folder(two_regions(), tmp_path / "objects" / "box")
    return tmp_path / "objects" / "box"


def edited(old: str, new: str) -> Callable[[Path], object]:
    """Damage: other text in object.toml."""

    def damage(folder: Path) -> None:
        text = (folder / "object.toml").read_text()
        assert old in text
        (folder / "object.toml").write_text(text.replace(old, new, 1))

    return damage


def swapped(mesh: trimesh.Trimesh, labels: list[int] | None = None, name: str = "mesh.ply") -> Callable[[Path], object]:
    """Damage: another mesh."""
    return lambda folder: write_ply(folder / name, mesh, None if labels is None else np.array(labels))


def cut(name: str, size: int) -> Callable[[Path], object]:
    """Damage: only the first bytes of a file."""
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size])


def many_hulls(folder: Path) -> None:
    """Damage: all pieces that there may be, each of many faces."""
    directions = np.random.default_rng(0).normal(size=(251, 3))
    ball = trimesh.convex.convex_hull(0.03 * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    write_ply(folder / "hull-1.ply", ball)
    piece = '\n[[pieces]]\nregion = "side"\nmesh = "hull-1.ply"\n'
    text = (folder / "object.toml").read_text()
    (folder / "object.toml").write_text(text[: text.index("[[pieces]]")] + piece * 500)


def inertia(moment: float) -> Callable[[Path], object]:
    """Damage: another inertia, of three equal moments."""

    def damage(folder: Path) -> None:
        text = (folder / "object.toml").read_text()
        start, end = text.index("inertia"), text.index("friction")
        rows = f"[[{moment}, 0, 0], [0, {moment}, 0], [0, 0, {moment}]]"
        (folder / "object.toml").write_text(f"{text[:start]}inertia = {rows}\n{text[end:]}")

    return damage


BOX = two_regions().mesh
OPEN = trimesh.Trimesh(BOX.vertices, BOX.faces[1:], process=False)
INSIDE_OUT = trimesh.Trimesh(BOX.vertices, BOX.faces[:, ::-1], process=False)
HALF = [0] * 6 + [1] * 6
QUADS = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
)
DAMAGES: dict[str, tuple[Callable[[Path], object], str, str]] = {
    "no toml": (lambda f: (f / "object.toml").unlink(), "box", "has no object.toml"),
    "no TOML at all": (edited("format =", "format"), "object.toml", "not valid TOML"),
    "not text": (lambda f: (f / "object.toml").write_bytes(b"\xff\xfe\0"), "object.toml", "no UTF-8 text"),
    "deep": (lambda f: (f / "object.toml").write_text("a=" + "[" * 9000), "object.toml", "not valid TOML"),
    "large toml": (lambda f: (f / "object.toml").write_text("#" * 1_000_001), "object.toml", "at most 1000000"),
    "long number": (edited("mass = 0.2", "mass = " + "9" * 5000), "object.toml", "not valid TOML"),
    "unknown key": (edited("mass =", "colour = 3\nmass ="), "object.toml", "unknown key 'colour'; known: format, name"),
    "missing key": (edited("mass =", "# mass ="), "object.toml", "lacks the key 'mass'"),
    "joints": (edited("[[regions]]", "[[joints]]\nname = 'a'\n[[regions]]"), "object.toml", "'joints' belongs into"),
    "links": (edited("mass =", "links = 2\nmass ="), "object.toml", "'links' belongs into articulation.toml"),
    "format": (edited("dora-object 1", "dora-object 9"), "object.toml", "format is 'dora-object 9', not"),
    "name": (edited('name = "box"', 'name = "jug"'), "object.toml", "name is 'jug', and the folder is 'box'"),
    "name type": (edited('name = "box"', "name = 3"), "object.toml", "name is 3"),
    "mass type": (edited("mass = 0.2", 'mass = "0.2"'), "object.toml", "mass must be numbers"),
    "mass bool": (edited("mass = 0.2", "mass = true"), "object.toml", "mass must be numbers"),
    "mass nan": (edited("mass = 0.2", "mass = nan"), "object.toml", "mass must be finite"),
    "mass huge": (edited("mass = 0.2", "mass = 1" + "0" * 200), "object.toml", "mass must be finite"),
    "mass endless": (edited("mass = 0.2", "mass = 1" + "0" * 400), "object.toml", "more than 1000 bits"),
    "mass zero": (edited("mass = 0.2", "mass = 0"), "object.toml", "mass is 0.0; it must be positive"),
    "friction": (edited("friction = 0.7", "friction = -1"), "object.toml", "friction is -1.0; it must be positive"),
    "friction large": (edited("friction = 0.7", "friction = 1e8"), "object.toml", "friction is 1e.08; it must be 0 to"),
    "mass large": (edited("mass = 0.2", "mass = 1e8"), "object.toml", "mass is 1e.08; it must be 1e-05 to 100"),
    "mass small": (edited("mass = 0.2", "mass = 1e-8"), "object.toml", "mass is 1e-08; it must be 1e-05 to 100"),
    "inertia large": (inertia(1e8), "object.toml",
                      "inertia has the moment 1e.08, and a body of this mass and size has"),
    "inertia small": (inertia(1e-12), "object.toml",
                      "inertia has the moment 1e-12, and a body of this mass and size has"),
    "class twice": (edited('"SideGrasp"', '"BodyGrasp"'), "object.toml", "two regions have the grasp_class 'Body"),
    "piece far away": (edited("position = [0.0,", "position = [1e8,"), "object.toml", "piece 0 reaches farther than 2"),
    "piece large": (edited("size = [0.025,", "size = [1e8,"), "object.toml", "piece 0 reaches farther than 2.0 m"),
    "hull of many vertices": (swapped(trimesh.creation.icosphere(3, 0.03), None, "hull-1.ply"), "hull-1.ply",
                              "has 642 vertices; a hull may have at most 255"),
    "hull of many bytes": (lambda f: (f / "hull-1.ply").write_bytes(bytes(1_000_001)), "hull-1.ply", "at most 1000000"),
    "hulls of many faces": (many_hulls, "object.toml", "pieces have 249000 faces; reduce them to at most 200000"),
    "placement": (edited('"table"', '"shelf"'), "object.toml", "placement is 'shelf'; choose one of: table, air, fix"),
    "placement type": (edited('placement = "table"', "placement = []"), "object.toml", r"placement is \[\]"),
    "posture": (edited('"home"', '""'), "object.toml", "start_posture must be a text"),
    "rest": (edited("rest = [1.0,", "rest = [0.9,"), "object.toml", "rest must be a quaternion"),
    "rest length": (edited("rest = [1.0,", "rest = ["), "object.toml", "rest must be a list of 4 numbers"),
    "inertia rows": (edited("inertia = [", "inertia = [[1.0, 0, 0],"), "object.toml", "3 lists of 3 numbers"),
    "target": (edited('target = "side"', 'target = "lid"'), "object.toml", "target is 'lid'; choose one of"),
    "region twice": (edited('name = "side"', 'name = "body"'), "object.toml", "two regions are named 'body'"),
    "class type": (edited('"BodyGrasp"', "7"), "object.toml", "grasp_class of 'body' must be a text"),
    "regions type": (edited("[[regions]]", "[regions]\n[[regions.a]]"), "object.toml", "TOML"),
    "region without face": (edited("[[pieces]]", '[[regions]]\nname = "lid"\ngrasp_class = "L"\n[[pieces]]'),
                            "object.toml", "region 'lid' has no face"),
    "piece's region": (edited('region = "body"', 'region = "lid"'), "object.toml", "the region of piece 0 is 'lid'"),
    "piece's shape": (edited('shape = "box"', 'shape = "cone"'), "object.toml", "shape of piece 0 is 'cone'"),
    "piece's key": (edited('shape = "box"', ""), "object.toml", "piece 0 lacks the key 'shape'"),
    "piece's size": (edited("size = [0.025,", "size = [0.0,"), "object.toml", "size of piece 0 must be positive"),
    "piece's sizes": (edited("size = [0.025,", "size = ["), "object.toml", "size of piece 0 must be a list of 3"),
    "piece's two": (edited('mesh = "hull-1.ply"', 'mesh = "hull-1.ply"\nshape = "box"'), "object.toml", "key 'shape'"),
    "piece's file": (edited("hull-1.ply", "hull-2.ply"), "hull-2.ply", "there is no mesh file"),
    "elsewhere": (edited("hull-1.ply", "../box/hull-1.ply"), "object.toml", "no name of a mesh"),
    "no mesh": (lambda f: (f / "mesh.ply").unlink(), "mesh.ply", "there is no mesh file"),
    "empty mesh": (cut("mesh.ply", 0), "mesh.ply", "no intact PLY file"),
    "short mesh": (cut("mesh.ply", 700), "mesh.ply", "no intact PLY file"),
    "header alone": (cut("mesh.ply", 100), "mesh.ply", "no intact PLY file"),
    "another file": (lambda f: BOX.export(f / "mesh.ply", file_type="stl"), "mesh.ply", "no intact PLY file"),
    "quads": (lambda f: (f / "mesh.ply").write_text(QUADS), "mesh.ply", "must hold triangles"),
    "open": (swapped(OPEN, HALF[1:]), "mesh.ply", "no closed surface"),
    "inside out": (swapped(INSIDE_OUT, HALF), "mesh.ply", "no closed surface with outward faces"),
    "millimetres": (swapped(trimesh.Trimesh(BOX.vertices * 1000, BOX.faces), HALF), "mesh.ply", "use metres"),
    "kilometres": (swapped(trimesh.Trimesh(BOX.vertices / 1000, BOX.faces), HALF), "mesh.ply", "use metres"),
    "beside its origin": (swapped(moved(BOX, np.array([1.0, 0, 0])), HALF), "mesh.ply", "beside its origin"),
    "not finite": (swapped(trimesh.Trimesh(BOX.vertices * np.nan, BOX.faces, process=False), HALF), "mesh.ply",
                   "three finite numbers"),
    "no labels": (swapped(BOX), "mesh.ply", "no face property 'label'"),
    "labels too high": (swapped(BOX, [0] * 11 + [2]), "mesh.ply", "labels that are not in 0 to 1"),
    "labels negative": (swapped(BOX, [0] * 11 + [-1]), "mesh.ply", "labels that are not in 0 to 1"),
    "one label": (swapped(BOX, [0] * 12), "object.toml", "region 'side' has no face"),
    "not convex": (swapped(trimesh.creation.annulus(0.01, 0.02, 0.01), None, "hull-1.ply"), "hull-1.ply", "not convex"),
    "open solid": (swapped(OPEN, None, "solid.ply"), "solid.ply", "no closed surface"),
}  # fmt: skip
"""Name of a damage: what it does to a folder, the file that the message names, and words of the message."""


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_folders_are_refused_in_one_sentence(name: str, folder: Path):
    damage, file, words = DAMAGES[name]
    assert read_object_folder(folder).name == "box"
    damage(folder)
    with pytest.raises(InputError, match=words) as caught:
        read_object_folder(folder)
    assert f"/{file}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_faces_of_vertices_that_do_not_exist_are_refused(folder: Path):
    content = bytearray((folder / "mesh.ply").read_bytes())
    content[-19:-15] = (99).to_bytes(4, "little")
    (folder / "mesh.ply").write_bytes(content)
    with pytest.raises(InputError, match="vertices which do not exist"):
        read_object_folder(folder)


def test_a_text_file_of_another_program_is_read(folder: Path):
    """Floats as text, properties in another order."""
    box = read_object_folder(folder)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(BOX.vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(BOX.faces)}", "property uchar label", "property list uchar uint vertex_index"]
    lines += ["end_header", *(" ".join(map(str, vertex)) for vertex in BOX.vertices.tolist())]
    lines += [f"{label} 3 {a} {b} {c}" for label, (a, b, c) in zip(box.face_labels, BOX.faces, strict=True)]
    (folder / "mesh.ply").write_text("\n".join([*lines, ""]))
    found = read_object_folder(folder)
    assert found.face_labels.tolist() == box.face_labels.tolist()
    np.testing.assert_allclose(found.mesh.vertices, BOX.vertices, atol=1e-7)


def test_large_files_are_not_read(folder: Path):
    with (folder / "mesh.ply").open("r+b") as stream:
        stream.truncate(MOST_BYTES + 1)
    with pytest.raises(InputError, match=f"reduce the mesh to at most {MOST_BYTES}"):
        read_object_folder(folder)


@pytest.mark.parametrize(
    "inertia",
    [
        "[[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]]",
        "[[9, 0, 0], [0, 1, 0], [0, 0, 1]]",
        "[[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]",
        "[[0, 0, 0], [0, 0, 0], [0, 0, 0]]",
    ],
)
def test_an_inertia_that_no_body_has_is_refused(inertia: str, folder: Path):
    text = (folder / "object.toml").read_text()
    start, end = text.index("inertia"), text.index("friction")
    (folder / "object.toml").write_text(f"{text[:start]}inertia = {inertia}\n{text[end:]}")
    with pytest.raises(InputError, match=r"object.toml: inertia (belongs to no body|must be symmetric)"):
        read_object_folder(folder)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_whatever_is_damaged_is_refused_or_still_an_object(folder: Path, data: st.DataObject):
    """Bytes changed, removed or added anywhere in a file never raise anything but an InputError."""
    name = data.draw(st.sampled_from(["object.toml", "mesh.ply", "solid.ply", "hull-1.ply"]))
    copy = folder.parent / "copies" / "box"
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    content = bytearray((folder / name).read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(content)))
        content[start : start + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    (copy / name).write_bytes(content)
    refused = ""
    try:
        found = read_object_folder(copy)
        assert set(found.face_labels) == set(range(len(found.labels)))
    except InputError as error:
        refused = str(error)
    assert not refused or str(copy) in refused
