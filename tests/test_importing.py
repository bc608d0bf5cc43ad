"""Objects of users: reading, repairing, labelling and refusing meshes."""

import importlib.resources
import json
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
import trimesh

from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.objects.affordance_object import moved
from dora.affordance.objects.importing import import_object, read_mesh, resting_pose
from dora.affordance.objects.labels import grasp_class, read_labels
from dora.affordance.objects.surface_repair import repair
from dora.errors import InputError

BODY, GRIP = (0.06, 0.06, 0.10), (0.05, 0.016, 0.016)
"""A block with a bar at +x: the simplest thing with a handle (m)."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def block() -> trimesh.Trimesh:
    return trimesh.creation.box(BODY)


def bar() -> trimesh.Trimesh:
    return moved(trimesh.creation.box(GRIP), np.array([0.05, 0, 0.02]))


def both() -> trimesh.Trimesh:
    return trimesh.boolean.union([block(), bar()], engine="manifold")


def joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))


def written(folder: Path, mesh: trimesh.Trimesh | trimesh.Scene, name: str = "thing.stl") -> Path:
    mesh.export(folder / name)
    return folder / name


def mended(mesh: trimesh.Trimesh, labels: np.ndarray | None = None):
    return repair(mesh, np.zeros(len(mesh.faces), np.int64) if labels is None else labels, "thing")


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb", "off"])
def test_formats(ending: str, tmp_path: Path):
    mesh, names = read_mesh(written(tmp_path, both(), f"thing.{ending}"))
    assert set(names) == {"body"}
    fixed = mended(mesh).mesh
    assert fixed.is_watertight
    assert fixed.volume == pytest.approx(both().volume, rel=1e-5)


def test_imported_object(tmp_path: Path, cache: Path):
    millimetres = trimesh.Trimesh(both().vertices * 1000 + [200, 0, 0], both().faces)
    regions = {"handle": {"box": {"min": [231, -99, -99], "max": [999, 99, 99]}}}
    (tmp_path / "labels.yaml").write_text(json.dumps({"regions": regions}))
    path = written(tmp_path, millimetres, "thing.ply")
    obj = import_object(path, tmp_path / "labels.yaml", units="mm", mass=0.25, cache_dir=cache)
    assert (obj.name, obj.labels, obj.classes) == ("thing", ("body", "handle"), ("BodyGrasp", "HandleGrasp"))
    assert (obj.target, obj.mass) == ("handle", 0.25)
    np.testing.assert_allclose(obj.mesh.extents, both().extents, atol=1e-6)
    np.testing.assert_allclose(obj.mesh.center_mass, 0, atol=1e-9)
    assert obj.region("handle").area == pytest.approx(0.045 * 4 * 0.016 + 0.016**2, rel=0.01)
    assert obj.centroid("handle")[0] > 0.03
    assert {piece.label for piece in obj.pieces} == {"body", "handle"}
    assert obj.rest == (1.0, 0.0, 0.0, 0.0)
    assert obj.support == pytest.approx(-obj.mesh.bounds[0, 2])
    assert import_object(path, units="mm", scale=0.5, cache_dir=cache).mass == pytest.approx(
        600 * both().volume / 8, rel=1e-3
    )


def with_faces(mesh: trimesh.Trimesh, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def soup(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False)


def every_third_turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    turned = np.arange(len(mesh.faces))[:, None] % 3 == 0
    return with_faces(mesh, np.where(turned, mesh.faces[:, ::-1], mesh.faces))


def with_double_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return with_faces(mesh, np.concatenate([mesh.faces, mesh.faces[:3], [[0, 0, 1]]]))


def with_scrap(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    corners = [[0, 0, 0.2], [0, 0.01, 0.2], [0.01, 0, 0.2]]
    return joined([mesh, trimesh.Trimesh(corners, [[0, 1, 2]])])


BREAKS = {
    "soup": (soup, ""),
    "inside out": (lambda m: with_faces(m, m.faces[:, ::-1]), "turned a body outwards"),
    "mixed winding": (every_third_turned, "turned a body outwards"),
    "hole": (lambda m: with_faces(m, m.faces[1:]), "filled a hole"),
    "double faces": (with_double_faces, "dropped 4 degenerate or double faces"),
    "two bodies": (lambda m: joined([m, bar()]), "united 2 bodies"),
    "scrap": (with_scrap, "dropped a loose scrap"),
}


@pytest.mark.parametrize(("break_it", "action"), BREAKS.values(), ids=BREAKS)
def test_repairs(break_it, action: str):
    whole = both().subdivide()
    fixed = mended(break_it(whole))
    assert fixed.mesh.is_watertight
    assert fixed.mesh.is_winding_consistent
    assert fixed.mesh.volume == pytest.approx(whole.volume, rel=1e-6)
    assert action in " ".join(fixed.actions)
    assert bool(action) == bool(fixed.actions)


def test_labels_survive_repair():
    pair = joined([block().subdivide(), bar().subdivide()])
    labels = np.repeat([0, 1], len(pair.faces) // 2)
    fixed = mended(trimesh.Trimesh(pair.vertices, pair.faces[1:], process=False), labels[1:])
    x = fixed.mesh.triangles_center[:, 0]
    assert (fixed.labels[x > 0.0301] == 1).all()
    assert (fixed.labels[x < 0.0299] == 0).all()
    assert fixed.actions == ("filled a hole", "united 2 bodies")


def test_touching_bodies_are_united():
    """Two boxes that share a whole side: every edge of it belongs to four faces."""
    pair = joined([trimesh.creation.box((1, 1, 1)), moved(trimesh.creation.box((1, 1, 1)), np.eye(3)[0])])
    fixed = mended(pair)
    assert fixed.mesh.volume == pytest.approx(2)
    assert fixed.mesh.is_watertight


def sheet() -> trimesh.Trimesh:
    return trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 3]])


def open_box() -> trimesh.Trimesh:
    box = trimesh.creation.box((0.1, 0.1, 0.02))
    return trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.5], process=False)


def bow_tie() -> trimesh.Trimesh:
    """Two holes that touch in one vertex."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    around = np.flatnonzero((ball.faces == 0).any(1))
    return trimesh.Trimesh(ball.vertices, np.delete(ball.faces, around[[0, 2]], axis=0), process=False)


def infinite() -> trimesh.Trimesh:
    mesh = block()
    vertices = mesh.vertices.copy()
    vertices[0, 0] = np.inf
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


@pytest.mark.parametrize(
    ("make", "message"),
    [(sheet, r"is open|no volume"), (open_box, "is open: closing its holes"), (bow_tie, "holes touch")],
)
def test_surfaces_that_cannot_be_closed(make, message: str):
    with pytest.raises(InputError, match=message):
        mended(make())


@pytest.mark.parametrize(
    ("make", "name", "options", "message"),
    [
        (infinite, "thing.ply", {}, "not finite"),
        (lambda: trimesh.Trimesh(block().vertices * 1000, block().faces), "thing.stl", {}, "--units"),
        (block, "thing.stl", {"units": "mm"}, r"would be 0\.0001 m long.*--units"),
        (block, "thing.stl", {"units": "furlong"}, "unit 'furlong' is unknown"),
        (block, "thing.stl", {"scale": -1.0}, r"scale of .* is -1\.0; give a positive number"),
        (block, "thing.stl", {"mass": float("nan")}, r"mass of .* is nan"),
    ],
)
def test_refusals(make, name: str, options: dict, message: str, tmp_path: Path, cache: Path):
    path = written(tmp_path, make(), name)
    with pytest.raises(InputError, match=message):
        import_object(path, cache_dir=cache, **options)


def test_refuses_files_without_a_surface(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(InputError, match="no mesh file"):
        read_mesh(tmp_path / "nothing.stl")
    for name, content in (("empty.obj", ""), ("points.obj", "v 0 0 0\nv 1 0 0\n")):
        (tmp_path / name).write_text(content)
        with pytest.raises(InputError, match=r"no triangles|cannot be read"):
            read_mesh(tmp_path / name)
    (tmp_path / "letter.stl").write_bytes(b"dear reader")
    (tmp_path / "thing.docx").write_bytes(b"dear reader")
    for name in ("letter.stl", "thing.docx"):
        with pytest.raises(InputError, match=r"cannot be read|no triangles"):
            read_mesh(tmp_path / name)
    monkeypatch.setattr("dora.affordance.objects.importing.MOST_FACES", 10)
    with pytest.raises(InputError, match="has 12 faces; reduce it to at most 10"):
        read_mesh(written(tmp_path, block()))


def test_labels_by_named_bodies(tmp_path: Path, cache: Path):
    scene = trimesh.Scene()
    scene.add_geometry(block(), geom_name="mug", node_name="mug")
    place = np.eye(4)
    place[:3, 3] = [0.05, 0, 0.02]
    scene.add_geometry(trimesh.creation.box(GRIP), geom_name="handle", node_name="handle", transform=place)
    obj = import_object(written(tmp_path, scene, "thing.glb"), cache_dir=cache)
    assert obj.labels == ("mug", "handle")
    assert obj.target == "handle"
    assert obj.mesh.volume == pytest.approx(both().volume, rel=1e-5)
    assert obj.region("handle").bounds[0, 0] - obj.region("mug").bounds[0, 0] == pytest.approx(0.06, abs=1e-6)


OBJ = """mtllib thing.mtl
{o1}
v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1
usemtl steel\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3
{o2}
v .5 0 0\nv .6 0 0\nv .5 .1 0\nv .5 0 .1
usemtl wood\nf 5 7 6\nf 5 6 8\nf 6 7 8\nf 5 8 7
"""


@pytest.mark.parametrize(
    ("objects", "expected"), [(("o head", "o grip"), {"head", "grip"}), (("", ""), {"steel", "wood"})]
)
def test_labels_of_obj_by_objects_or_materials(objects: tuple[str, str], expected: set[str], tmp_path: Path):
    (tmp_path / "thing.obj").write_text(OBJ.format(o1=objects[0], o2=objects[1]))
    (tmp_path / "thing.mtl").write_text("newmtl steel\nKd 1 0 0\nnewmtl wood\nKd 0 1 0\n")
    mesh, names = read_mesh(tmp_path / "thing.obj")
    assert set(names) == expected
    second = next(n for n in names if n in ("grip", "wood"))
    assert mesh.triangles_center[[n == second for n in names], 0].min() > 0.4


ABOVE = {"plane": {"point": [0, 0, 0.04], "normal": [0, 0, 2]}}
CENTERS = np.array([[0.0, 0, 0], [0, 0, 0.05], [0, 0, 0.10], [0.2, 0, 0]])


def save_labels(folder: Path, name: str, content) -> Path:
    path = folder / name
    if name.endswith("npy"):
        np.save(path, content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("name", "content", "names", "index"),
    [
        ("a.txt", "cup\ncup\nrim\nhandle\n", ("cup", "rim", "handle"), [0, 0, 1, 2]),
        ("a.txt", "0\n0\n5\n5", ("region0", "region5"), [0, 0, 1, 1]),
        ("a.npy", np.array([1, 1, 0, 0]), ("region1", "region0"), [0, 0, 1, 1]),
        ("a.npy", np.array(["x", "y", "y", "x"]), ("x", "y"), [0, 1, 1, 0]),
        ("a.json", ["x", "y", "y", "x"], ("x", "y"), [0, 1, 1, 0]),
        ("a.json", {"labels": ["cup", "rim"], "faces": [1, 0, 0, 0], "target": "cup"}, ("rim", "cup"), [0, 1, 1, 1]),
        ("a.yaml", {"regions": {"rim": ABOVE}}, ("body", "rim"), [0, 1, 1, 0]),
        (
            "a.yml",
            {
                "regions": {
                    "top": {"box": {"min": [-1, -1, 0.09], "max": [1, 1, 1]}},
                    "handle": [{"box": {"min": [0.1, -1, -1], "max": [1, 1, 1]}}, ABOVE],
                },
                "rest": "cup",
            },
            ("cup", "handle", "top"),
            [0, 1, 2, 1],
        ),
    ],
)  # fmt: skip
def test_label_files(name: str, content, names: tuple[str, ...], index: list[int], tmp_path: Path):
    labels = read_labels(save_labels(tmp_path, name, content), CENTERS)
    assert labels.names == names
    assert labels.index.tolist() == index
    assert labels.target in names
    assert labels.target == ("handle" if "handle" in names else labels.target)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", "cup\nrim\n", "has 2 labels for the 4 triangles"),
        ("a.txt", "0\n-1\n0\n0\n", "labels face 1 '-1'"),
        ("a.txt", "cup\n\ncup\ncup\n", "labels face 1 ''"),
        ("a.json", {"labels": ["cup"], "faces": [0, 0, 1, 0]}, "labels face 2 '1', which is no label; use cup"),
        ("a.json", {"labels": ["cup"], "faces": ["cup", "cup", "lid", "cup"]}, "labels face 2 'lid'"),
        ("a.json", {"labels": ["cup"], "faces": [0, 0, 0, 0], "target": "lid"}, "target 'lid'; choose one of: cup"),
        ("a.json", {"colours": []}, "nothing else"),
        ("a.json", "{", "is not valid JSON"),
        ("a.yaml", "regions: [", "is not valid YAML"),
        ("a.yaml", {"regions": {"rim": {"ball": {}}}}, "must be box"),
        ("a.yaml", {"regions": {"rim": {"box": {"min": [0, 0], "max": [1, 1]}}}}, "must be box"),
        (
            "a.yaml",
            {"regions": {"rim": {"box": {"min": [5, 5, 5], "max": [6, 6, 6]}}}},
            "holds no face; the mesh reaches",
        ),
        ("a.yaml", {"parts": {}}, "'regions'"),
        ("a.csv", "1", "file ending in .txt"),
    ],
)
def test_label_files_that_do_not_fit(name: str, content, message: str, tmp_path: Path):
    with pytest.raises(InputError, match=message):
        read_labels(save_labels(tmp_path, name, content), CENTERS)


def test_label_file_that_is_missing(tmp_path: Path):
    with pytest.raises(InputError, match="no label file"):
        read_labels(tmp_path / "a.txt", CENTERS)


def test_one_label_per_face_in_the_order_of_the_file(tmp_path: Path, cache: Path):
    mesh = both()
    names = np.where(mesh.triangles_center[:, 0] > 0.0301, "grip", "body")
    for ending in ("obj", "stl"):
        path = written(tmp_path, mesh, f"thing.{ending}")
        save_labels(tmp_path, "labels.txt", "\n".join(names))
        obj = import_object(path, tmp_path / "labels.txt", cache_dir=cache)
        assert obj.region("grip").bounds[0, 0] - obj.mesh.bounds[0, 0] == pytest.approx(0.06, abs=1e-6)


def test_grasp_classes_are_named_after_labels():
    assert [grasp_class(name) for name in ("handle", "left ear", "rim_2")] == [
        "HandleGrasp",
        "LeftEarGrasp",
        "Rim2Grasp",
    ]


def test_resting_pose_of_what_does_not_stand_as_modelled():
    """A slanted bar lies down; a flat one stays."""
    slanted = trimesh.creation.box((0.02, 0.02, 0.1))
    slanted.apply_transform(trimesh.transformations.rotation_matrix(0.5, [1, 0, 0]))
    turn = trimesh.transformations.quaternion_matrix(resting_pose(slanted))[:3, :3]
    assert np.ptp(slanted.vertices @ turn[2]) == pytest.approx(0.02, abs=1e-6)
    assert resting_pose(trimesh.creation.box((0.1, 0.1, 0.02))) == (1.0, 0.0, 0.0, 0.0)


FOREIGN = [
    ("envs/tasks/fmb/assets/purple_u.ply", {}),
    ("assets/robots/koch/meshes/link_4_part.glb", {}),
    ("assets/robots/fetch/fetch_description/meshes/r_wheel_link_collision.STL", {"mass": 0.4}),
]
"""Meshes by others, of a CAD part, a motor's bracket and a wheel, which ManiSkill's package ships."""


@pytest.mark.parametrize(("name", "options"), FOREIGN, ids=["ply", "glb", "stl"])
def test_meshes_by_others(name: str, options: dict, cache: Path):
    resource = importlib.resources.files("mani_skill") / name
    with importlib.resources.as_file(resource) as path:
        obj = import_object(path, cache_dir=cache, **options)
        assert import_object(path, cache_dir=cache, **options).digest == obj.digest
    assert obj.mesh.is_watertight
    assert obj.mesh.volume > 0
    assert 0.005 < obj.mesh.extents.max() < 2
    assert obj.support > 0
    map = AffordanceMap.from_object(obj, count=1000)
    distance, label = map.nearest(map.points[:20], 3)
    assert torch.equal(distance[:, 0], torch.zeros(20)) or float(distance[:, 0].max()) < 1e-6
    assert set(label.ravel().tolist()) <= set(range(len(obj.labels)))
