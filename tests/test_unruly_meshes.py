"""Meshes as people have them: scraps, open sheets, back sides, bodies that touch, cavities, copies of parts, marks."""

import codecs
import unicodedata
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from dora.affordance.objects import importing
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.folder_writing import write_object_folder
from dora.affordance.objects.importing import import_mesh, read_mesh
from dora.affordance.objects.labels import FaceLabels, grasp_classes, read_labels, without_number
from dora.affordance.objects.surface_repair import Repaired, repair
from dora.affordance.views.server import legend_html
from dora.errors import InputError
from dora.progress import ProgressDisplay
from dora.quiet_start import show_any_script
from dora.tables import markdown_text

RADIUS, HEIGHT = 0.03, 0.12
"""A cylinder, the body of most meshes here [m]."""
CUBE = 0.05
"""Edge of cubes that touch [m]."""


def cylinder() -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius=RADIUS, height=HEIGHT, sections=40)


def at(mesh: trimesh.Trimesh, *place: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices + np.array(place), mesh.faces, process=False)


def cube(x: float = 0, y: float = 0, z: float = 0) -> trimesh.Trimesh:
    return at(trimesh.creation.box((CUBE,) * 3), x, y, z)


def inverted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def scaled(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices * factor, mesh.faces, process=False)


def without(mesh: trimesh.Trimesh, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[~faces], process=False)


def open_cup(both: bool = False) -> trimesh.Trimesh:
    """The cylinder without its top, and if `both` without its bottom."""
    mesh = cylinder()
    up = mesh.face_normals[:, 2]
    return without(mesh, (up > 0.9) | (both & (up < -0.9)))


def bowl() -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.06)
    return without(ball, ball.triangles_center[:, 2] > 0)


def scrap(side: float, bend: float = 0.0) -> trimesh.Trimesh:
    corners = [[0, 0, 0], [side, 0, 0], [side, side, bend * side], [0, side, 0]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def fin() -> trimesh.Trimesh:
    """A triangle on an edge of the cylinder, which then has three faces."""
    edge = cylinder().vertices[cylinder().edges_unique[100]]
    return trimesh.Trimesh([*edge, 1.4 * edge.mean(0)], [[0, 1, 2]], process=False)


def soup(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Triangles without common vertices, as STL files have them."""
    corners = np.concatenate([mesh.triangles for mesh in meshes])
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)


def mended(*meshes: trimesh.Trimesh) -> Repaired:
    mesh = soup(*meshes)
    return repair(mesh, np.zeros(len(mesh.faces), np.int64), "thing")


SCRAPS = {
    "beside": at(scrap(0.02), 0.05, 0, 0),
    "inside": at(scrap(0.02), -0.01, -0.01, 0),
    "on the surface": at(scrap(0.02), -0.01, -0.01, HEIGHT / 2),
    "bent": at(scrap(0.02, 0.1), 0.05, 0, 0),
    "of several faces": at(scrap(0.02, 0.1).subdivide(), 0.05, 0, 0),
    "on an edge": fin(),
    "floating body": at(trimesh.creation.box((0.004,) * 3), 0.06, 0, 0),
}


@pytest.mark.parametrize("piece", SCRAPS.values(), ids=SCRAPS)
def test_scraps_are_dropped_and_it_is_said(piece: trimesh.Trimesh):
    found = mended(cylinder(), piece)
    assert found.mesh.volume == pytest.approx(cylinder().volume, rel=1e-9)
    share = piece.area / (cylinder().area + piece.area)
    assert found.actions == (f"dropped a loose scrap of surface ({share:.1%} of it)",)


def test_a_surface_of_many_scraps_is_refused():
    scraps = [at(scrap(0.012), 0.05 + 0.015 * i, 0, 0) for i in range(60)]
    with pytest.raises(InputError, match=r"falls into 1 bodies and 60 loose scraps, which are 23% of its surface"):
        mended(cylinder(), *scraps)


def test_small_parts_that_touch_and_large_ones_that_do_not_stay():
    button = at(trimesh.creation.box((0.006,) * 3), RADIUS, 0, 0)
    assert mended(cylinder(), button).actions == ("united 2 bodies",)
    apart = mended(cube(), cube(0.15, 0, 0))
    assert apart.mesh.volume == pytest.approx(2 * CUBE**3)
    assert "hold 2 groups of bodies that do not touch together as one rigid body" in apart.actions


TOUCHING = {
    "sides": (cube(), cube(CUBE, 0, 0)),
    "sides of three": (cube(), cube(CUBE, 0, 0), cube(CUBE, 0, CUBE)),
    "edges": (cube(), cube(CUBE, CUBE, 0)),
    "equal triangles": (cube(), trimesh.Trimesh(cube().vertices * [-1, 1, 1] + [CUBE, 0, 0], cube().faces[:, ::-1])),
    "edges, inside out": (inverted(cube()), inverted(cube(CUBE, CUBE, 0))),
}


@pytest.mark.parametrize("bodies", TOUCHING.values(), ids=TOUCHING)
def test_bodies_that_touch_stay_whole(bodies: tuple[trimesh.Trimesh, ...]):
    found = mended(*bodies)
    assert found.mesh.is_watertight
    assert found.mesh.volume == pytest.approx(len(bodies) * CUBE**3)


@pytest.mark.parametrize("copy", [cylinder(), inverted(cylinder())], ids=["same", "back sides"])
def test_of_double_shells_one_counts(copy: trimesh.Trimesh):
    found = mended(cylinder(), copy)
    assert found.mesh.volume == pytest.approx(cylinder().volume)
    assert found.actions == (f"dropped {len(copy.faces)} degenerate or double faces",)


OPEN = {
    "cup": ((open_cup(),), 1, cylinder().volume),
    "cup with back sides": ((open_cup(), inverted(open_cup())), 1, cylinder().volume),
    "tube": ((open_cup(both=True),), 2, cylinder().volume),
    "bowl": ((bowl(),), 1, None),
}


@pytest.mark.parametrize(("meshes", "mouths", "volume"), OPEN.values(), ids=OPEN)
def test_open_sheets_are_closed_and_it_is_said(meshes: tuple[trimesh.Trimesh, ...], mouths: int, volume: float | None):
    found = mended(*meshes)
    assert found.mesh.is_watertight
    assert volume is None or found.mesh.volume == pytest.approx(volume)
    (said,) = [action for action in found.actions if "closed" in action]
    opened = "a wide opening" if mouths == 1 else f"{mouths} wide openings"
    assert said.startswith(f"closed {opened} of a surface without thickness")
    assert "treated as solid" in said
    assert found.bodies[0].sheet is not None
    assert found.bodies[0].sheet.area == pytest.approx(meshes[0].area)


def test_openings_inside_other_bodies_are_no_mouths():
    """A short open tube whose ends lie in two cubes, as handles are often modelled."""
    tube = trimesh.creation.cylinder(radius=0.01, height=0.08)
    tube = without(tube, np.abs(tube.face_normals[:, 2]) > 0.9)
    found = mended(cube(0, 0, -0.04), cube(0, 0, 0.04), at(tube, 0, 0, 0), at(tube, 0.005, 0, 0))
    assert all(body.sheet is None for body in found.bodies)
    assert not any("closed" in action for action in found.actions)


def test_a_body_inside_another_is_a_cavity_if_its_faces_point_the_other_way():
    inner = scaled(cylinder(), 0.9)
    for outer, inside in ((cylinder(), inverted(inner)), (inverted(cylinder()), inner)):
        found = mended(outer, inside)
        assert found.mesh.volume == pytest.approx(cylinder().volume)
        ((cavity,),) = found.cavities
        assert cavity.volume == pytest.approx(inner.volume)
        assert "found a closed cavity" in " ".join(found.actions)
    solid = mended(cylinder(), inner)
    assert solid.cavities == ((),)
    assert "filled a body inside another" in " ".join(solid.actions)


@pytest.mark.parametrize(
    ("size", "hint"), [((110, 60, 60), r"11 cm with --units mm"), ((9, 6, 6), r"9 cm with --units cm")]
)
def test_the_unit_that_fits_is_named(size: tuple[float, ...], hint: str, tmp_path: Path):
    trimesh.creation.box(size).export(tmp_path / "box.stl")
    with pytest.raises(InputError, match=hint):
        import_mesh(tmp_path / "box.stl")


def test_an_unusual_size_is_remarked_on(tmp_path: Path):
    trimesh.creation.box((1.0, 0.1, 0.1)).export(tmp_path / "box.stl")
    notes = import_mesh(tmp_path / "box.stl", cache_dir=tmp_path).notes
    assert notes == ("100 cm is an unusual length for a hand: give --units if it is not in m",)


def test_a_region_without_a_face_on_the_surface_is_named(tmp_path: Path):
    scene = trimesh.Scene()
    scene.add_geometry(cylinder(), node_name="mug", geom_name="mug")
    scene.add_geometry(scaled(cylinder(), 0.5), node_name="core", geom_name="core")
    scene.export(tmp_path / "mug.glb")
    found = import_mesh(tmp_path / "mug.glb", cache_dir=tmp_path)
    assert found.object.labels == ("mug",)
    assert "the region 'core' lies inside other parts or on what was dropped, and is left out" in found.notes


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["a" * 300, "b"], r"mug.obj has the label 'aaa.*; give names of at most 200 characters"),
        ([f"part {chr(0x4E00 + i)}" for i in range(257)], r"mug.obj has 257 different labels; give at most 256"),
    ],
    ids=["long", "many"],
)
def test_names_of_parts_that_no_folder_could_have_are_refused(names: list[str], words: str, tmp_path: Path):
    rows = "".join(f"o {name}\nf 1 2 3\n" for name in names)
    (tmp_path / "mug.obj").write_text(f"v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\n{rows}")
    with pytest.raises(InputError, match=words):
        import_mesh(tmp_path / "mug.obj", cache_dir=tmp_path)


def test_the_class_of_a_long_name_is_no_longer_than_a_name_may_be():
    found = grasp_classes(["a" * 200, "a" * 199 + "b", "c" * 10])
    assert [len(name) for name in found.values()] == [195, 198, 15]
    assert len(set(found.values())) == 3


COPIES = {
    "handle.001": "handle", "handle_2": "handle", "handle 3": "handle", "handle (4)": "handle",
    "handle.001_1": "handle", "handle": "handle", "001": "001", "把手.002": "把手", "part-b": "part-b", "2nd": "2nd",
}  # fmt: skip


def test_numbers_of_copies_are_left_out():
    assert {name: without_number(name) for name in COPIES} == COPIES
    assert without_number("1" * 50_000 + "x")  # in linear time


def test_copies_of_a_part_are_one_region_in_a_scene(tmp_path: Path):
    scene = trimesh.Scene()
    for i, name in enumerate(("mug", "handle", "handle.001", "handle_2")):
        scene.add_geometry(cube(i * 0.04, 0, 0), node_name=name, geom_name=name)
    scene.export(tmp_path / "mug.glb")
    mesh, names = read_mesh(tmp_path / "mug.glb")
    assert list(dict.fromkeys(names)) == ["mug", "handle"]
    assert names.count("handle") == 3 * names.count("mug") == len(mesh.faces) * 3 // 4


OBJ = """{first}v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1
{a}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3
v .5 0 0\nv .6 0 0\nv .5 .1 0\nv .5 0 .1
{b}\nf 5 7 6\nf 5 6 8\nf 6 7 8\nf 5 8 7
v .8 0 0\nv .9 0 0\nv .8 .1 0\nv .8 0 .1
{c}\nf 9 11 10\nf 9 10 12\nf 10 11 12\nf 9 12 11
"""
PARTS = ("body", "grip.001", "grip_2")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("kind", ["o", "g", "usemtl"])
def test_parts_of_obj_files_with_and_without_a_mark(kind: str, encoding: str, tmp_path: Path):
    first = "mtllib a.mtl\n" if kind == "usemtl" else ""
    a, b, c = (f"{kind} {name}" for name in PARTS)
    (tmp_path / "thing.obj").write_text(OBJ.format(first=first, a=a, b=b, c=c), encoding=encoding)
    (tmp_path / "a.mtl").write_text("".join(f"newmtl {name}\nKd 1 0 0\n" for name in PARTS), encoding=encoding)
    mesh, names = read_mesh(tmp_path / "thing.obj")
    assert sorted(names) == ["body"] * 4 + ["grip"] * 8
    assert mesh.bounds.tolist() == [[0, 0, 0], [0.9, 0.1, 0.1]]
    grip = np.array(names) == "grip"
    assert mesh.triangles_center[grip, 0].min() > 0.4 > mesh.triangles_center[~grip, 0].max()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_the_first_material_is_read_whatever_stands_before_it(encoding: str, tmp_path: Path):
    text = OBJ.format(first="mtllib a.mtl\n", a="usemtl steel", b="usemtl wood", c="usemtl wood")
    (tmp_path / "thing.obj").write_text(text)
    (tmp_path / "a.mtl").write_text("newmtl steel\nKd 1 0 0\n", encoding=encoding)
    (tmp_path / "b.mtl").write_text("newmtl steel\n", encoding=encoding)
    resolver = importing._Neighbours(str(tmp_path / "thing.obj"))
    assert resolver.get("b.mtl") == b"newmtl steel\n"
    _, names = read_mesh(tmp_path / "thing.obj")
    assert names.count("steel") == 4


def test_copies_of_a_material_are_one_region(tmp_path: Path):
    scene = trimesh.Scene()
    for i, name in enumerate(("clay", "steel", "steel.001")):
        part = cube(i * 0.04)
        part.visual = TextureVisuals(material=PBRMaterial(name=name))
        scene.add_geometry(part, node_name=f"part.{i:03}", geom_name=f"part.{i:03}")
    scene.export(tmp_path / "mug.glb")
    _, names = read_mesh(tmp_path / "mug.glb")
    assert list(dict.fromkeys(names)) == ["clay", "steel"]


LABELS = {
    "a.txt": "把手\n杯身",
    "a.json": '{"labels": ["把手", "杯身"], "faces": [0, 1], "target": "把手"}',
    "a.yaml": "regions:\n  把手:\n    box: {min: [-1, -1, -1], max: [1, 1, 1]}\nrest: 杯身\ntarget: 把手\n",
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("name", LABELS)
def test_label_files_with_and_without_a_mark(name: str, encoding: str, tmp_path: Path):
    (tmp_path / name).write_text(LABELS[name], encoding=encoding)
    found = read_labels(tmp_path / name, np.array([[0.0, 0, 0], [5, 0, 0]]))
    assert set(found.names) == {"把手", "杯身"}
    assert found.names[found.index[0]] == found.target == "把手"


def test_an_object_toml_with_a_mark(tmp_path: Path):
    cube().export(tmp_path / "box.stl")
    toml = write_object_folder(import_mesh(tmp_path / "box.stl", cache_dir=tmp_path).object, tmp_path / "box")
    toml.write_bytes(codecs.BOM_UTF8 + toml.read_bytes())
    assert read_object_folder(tmp_path / "box").labels == ("body",)


def test_grasp_classes_of_names_in_any_script():
    names = ("handle", "left ear", "把手", "杯身", "poignée", "مقبض", "हैंडल", "☕", "🫖", "Handle", "rim_2", "rim 2")
    classes = grasp_classes(names)
    assert list(classes.values()) == [
        "HandleGrasp", "LeftEarGrasp", "把手Grasp", "杯身Grasp", "PoignéeGrasp", "مقبضGrasp", "हैंडलGrasp", "RegionGrasp",
        "RegionNo2Grasp", "HandleNo2Grasp", "Rim2Grasp", "Rim2No2Grasp",
    ]  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(st.lists(st.text(st.characters(codec="utf-8"), min_size=1, max_size=4), unique=True))
def test_different_names_have_different_classes(names: list[str]):
    classes = grasp_classes(names)
    assert list(classes) == names
    assert len(set(classes.values())) == len(names)
    assert all(unicodedata.category(c)[0] in "LMN" for name in classes.values() for c in name)


def test_names_that_look_equal_are_one_region():
    composed, decomposed, marked = "poignée", unicodedata.normalize("NFD", "poignée"), "\ufeffpoignée "
    found = FaceLabels.from_names([composed, decomposed, marked, "a\n b"], target=decomposed)
    assert found.names == ("poignée", "a b")
    assert found.target == "poignée"
    with pytest.raises(InputError, match="shows no character"):
        FaceLabels.from_names(["\u200b"])


def test_names_are_shown_as_they_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    assert "<b>" not in legend_html("Regions", {"<b>把手</b>": (1, 2, 3)})
    assert "&lt;b&gt;把手" in legend_html("Regions", {"<b>把手</b>": (1, 2, 3)})
    assert markdown_text("a<b>{c}*") == r"a&lt;b&gt;\{c\}\*"
    with (tmp_path / "out").open("w") as stream, ProgressDisplay(Console(file=stream)) as phases:
        phases.phase("[/handle]: search", "candidates")(1, 2)
    assert "[/handle]: search" in (tmp_path / "out").read_text()
    with (tmp_path / "out").open("w") as stream:
        terminal = Console(file=stream, force_terminal=True, width=80)
        with ProgressDisplay(terminal) as phases:
            phases.phase("[/handle]: search", "candidates")(1, 2)
    assert "[/handle]: search" in (tmp_path / "out").read_text()
    with (tmp_path / "ascii").open("w", encoding="ascii") as stream:
        monkeypatch.setattr("sys.stdout", stream)
        show_any_script()
        print("把手")
    assert (tmp_path / "ascii").read_text() == "\\u628a\\u624b\n"


def test_a_part_of_a_scan_with_a_torn_edge(tmp_path: Path):
    """Many faces, an opening at the bottom, floating bits: closed within seconds."""
    ball = trimesh.creation.uv_sphere(radius=0.05, count=[120, 120])
    scan = without(ball, ball.triangles_center[:, 2] < -0.0465)
    bits = [at(trimesh.creation.icosphere(subdivisions=1, radius=0.001), 0.07, 0.001 * i, 0) for i in range(20)]
    found = mended(scan, *bits)
    assert found.mesh.is_watertight
    assert cast(float, found.mesh.volume) == pytest.approx(ball.volume, rel=0.02)
    assert "dropped 20 loose scraps" in " ".join(found.actions)
