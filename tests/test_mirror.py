"""The mirror image of a robot: what is committed is what the command writes, and it is the image of the original."""

import shutil
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from test_bounded_meshes import glb

from dora.errors import InputError
from dora.robot import RobotDescription, load_robot
from dora.robot.kinematics import SerialChain
from dora.robot.mirror import mirrored_name, mirrored_urdf, write_mirrored

REFLECTION = np.diag([1.0, -1.0, 1.0])
"""The plane y = 0."""
POSTURES = 500
"""Number of random postures."""


@pytest.fixture(scope="module")
def right() -> RobotDescription:
    return load_robot("diana7_hit")


@pytest.fixture(scope="module")
def left() -> RobotDescription:
    return load_robot("diana7_hit_left")


def test_what_is_committed_is_what_the_command_writes(right: RobotDescription, left: RobotDescription, tmp_path: Path):
    written = write_mirrored(right.folder, tmp_path / left.name)
    committed = {path.relative_to(left.folder) for path in left.folder.rglob("*") if path.is_file()}
    assert {path.relative_to(tmp_path / left.name) for path in written} == committed
    for path in written:
        other = left.folder / path.relative_to(tmp_path / left.name)
        if path.suffix == ".glb":
            _assert_same_mesh(trimesh.load_scene(path), trimesh.load_scene(other), np.eye(3))
        else:
            assert path.read_bytes() == other.read_bytes()


def test_every_frame_is_the_image_of_the_original(right: RobotDescription, left: RobotDescription):
    generator, reflection = torch.Generator().manual_seed(0), torch.from_numpy(REFLECTION)
    for one, other in zip(right.fingers.values(), left.fingers.values(), strict=True):
        chains = [SerialChain.of(r, f.tip, dtype=torch.float64) for r, f in ((right, one), (left, other))]
        assert torch.equal(chains[0].lower, chains[1].lower)
        assert torch.equal(chains[0].upper, chains[1].upper)
        share = torch.rand(POSTURES, len(chains[0].lower), generator=generator, dtype=torch.float64)
        joints = chains[0].lower + (chains[0].upper - chains[0].lower) * share
        (p, matrix), (image_p, image_matrix) = (chain.tip_pose(joints) for chain in chains)
        torch.testing.assert_close(image_p, p @ reflection, rtol=0, atol=1e-9)
        torch.testing.assert_close(image_matrix, reflection @ matrix @ reflection, rtol=0, atol=1e-9)


def test_shapes_pads_and_inertias_are_images(right: RobotDescription, left: RobotDescription):
    for name, shapes in right.shapes.items():
        for shape, image in zip(shapes, left.shapes[mirrored_name(name)], strict=True):
            assert image.kind == shape.kind
            np.testing.assert_allclose(image.size, shape.size, atol=1e-12)
            np.testing.assert_allclose(image.position, REFLECTION @ shape.position, atol=1e-9)
            w, x, y, z = shape.quaternion  # S R S, of the same shape up to a half turn of the body about its own axis
            assert abs(np.dot(image.quaternion, [w, -x, y, -z])) == pytest.approx(1, abs=1e-9)
    for one, other in zip(right.fingers.values(), left.fingers.values(), strict=True):
        np.testing.assert_allclose(other.pad, REFLECTION @ one.pad, atol=1e-12)
    assert left.ignored_pairs == {tuple(sorted(map(mirrored_name, pair))) for pair in right.ignored_pairs}
    for posture, image in zip(right.postures.values(), left.postures.values(), strict=True):
        np.testing.assert_array_equal(posture.arm, image.arm)
        np.testing.assert_array_equal(posture.hand, image.hand)


def test_the_axis_of_a_slide_is_a_vector_and_a_missing_one_that_of_x():
    """A slide along y goes the other way in the image, a hinge about x turns the other way."""
    urdf = """<robot name="r"><joint name="a" type="prismatic"><axis xyz="0.6 0.8 0"/></joint>
    <joint name="b" type="revolute"/><joint name="c" type="prismatic"/><joint name="d" type="fixed"/>
    <joint name="e" type="revolute"><axis xyz="0.6 0.8 0"/></joint></robot>"""
    image = ET.fromstring(mirrored_urdf(urdf, "s", "r"))
    axes = {joint.get("name"): joint.find("axis") for joint in image.iter("joint")}
    found = {name: axis is not None and [float(x) for x in axis.get("xyz", "").split()] for name, axis in axes.items()}
    assert found == {"a": [0.6, -0.8, 0], "b": [-1, 0, 0], "c": [1, 0, 0], "d": False, "e": [-0.6, 0.8, 0]}


def test_an_inertia_is_an_image():
    inertia = '<inertia ixx="3" ixy="0.1" ixz="0.2" iyy="4" iyz="0.3" izz="5"/>'
    text = f'<robot name="a"><link name="Right_l"><inertial>{inertia}</inertial></link></robot>'
    image = mirrored_urdf(text, "b", "a")
    tensor = np.array([[3, 0.1, 0.2], [0.1, 4, 0.3], [0.2, 0.3, 5]])
    ixx, ixy, ixz, iyy, iyz, izz = (float(image.split(f'{key}="')[1].split('"')[0]) for key in
                                    ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))  # fmt: skip
    np.testing.assert_allclose(
        [[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]], REFLECTION @ tensor @ REFLECTION, atol=1e-12
    )
    assert '<link name="Left_l">' in image
    assert '<robot name="b">' in image


def test_meshes_are_images_turned_outwards(right: RobotDescription, left: RobotDescription):
    for path in sorted(right.folder.glob("meshes/*.glb")):
        image = trimesh.load_scene(left.folder / "meshes" / path.name)
        _assert_same_mesh(trimesh.load_scene(path), image, REFLECTION)


def _assert_same_mesh(scene: trimesh.Scene, image: trimesh.Scene, change: np.ndarray) -> None:
    """The second scene is the first one after a linear map: vertices, normals, volume, colours, transforms."""
    assert set(scene.geometry) == set(image.geometry)
    for name, mesh in scene.geometry.items():
        other = image.geometry[name]
        np.testing.assert_allclose(other.vertices, mesh.vertices @ change, atol=1e-6)
        np.testing.assert_allclose(other.vertex_normals, mesh.vertex_normals @ change, atol=1e-4)
        assert other.volume == pytest.approx(mesh.volume, rel=1e-4)
        np.testing.assert_array_equal(other.visual.material.baseColorFactor, mesh.visual.material.baseColorFactor)
    for node in image.graph.nodes_geometry:
        np.testing.assert_array_equal(image.graph.get(node)[0], np.eye(4))


def test_the_image_of_the_image_is_the_original(right: RobotDescription, tmp_path: Path):
    write_mirrored(load_robot("diana7_hit_left").folder, tmp_path / "again")
    again = load_robot(tmp_path / "again")
    assert again.hand.names == right.hand.names
    table, original = (tomllib.loads((r.folder / "robot.toml").read_text()) for r in (again, right))
    assert table | {"name": right.name} == original


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("meshes/palm.glb", "../palm.glb"), "lies outside the folder"),
        (("meshes/palm.glb", "/palm.glb"), "lies outside the folder"),
        (("meshes/palm.glb", "package://palm.glb"), "lies outside the folder"),
        (('xyz="0 0 0.0752"', 'xyz="0 0"'), "<origin> that cannot be read"),
        (("</robot>", ""), "no XML"),
    ],
)
def test_what_cannot_be_mirrored_is_refused(change: tuple[str, str], words: str, right: RobotDescription):
    with pytest.raises(InputError, match=words):
        mirrored_urdf(right.urdf.read_text().replace(*change), "image", right.name)


@pytest.fixture
def copied(right: RobotDescription, tmp_path: Path) -> Path:
    return Path(shutil.copytree(right.folder, tmp_path / "copied"))


def test_meshes_are_those_that_the_urdf_names(copied: Path, tmp_path: Path):
    (copied / "visual").mkdir()
    (copied / "meshes/palm.glb").rename(copied / "visual/right_palm.glb")
    _replace(copied / "robot.urdf", "meshes/palm.glb", "visual/right_palm.glb")
    written = {path.relative_to(tmp_path / "image") for path in write_mirrored(copied, tmp_path / "image")}
    assert Path("visual/left_palm.glb") in written
    assert 'filename="visual/left_palm.glb"' in (tmp_path / "image/robot.urdf").read_text()


@pytest.mark.parametrize(
    ("named", "content", "words"),
    [
        ("meshes/other.glb", None, "other.glb is missing"),
        ("meshes/palm.stl", b"solid palm", "palm.stl is no .glb file"),
        ("meshes/palm.glb", b"spoiled", "the header of .*palm.glb is not valid JSON"),
        ("meshes/palm.glb", glb({"meshes": [{}], "nodes": [{"mesh": 0}]}), "palm.glb is no intact glTF"),
        ("meshes/palm.glb", glb({"scene": 0, "scenes": [{"nodes": []}]}), "palm.glb shows nothing"),
        ("meshes/palm.glb", glb({"accessors": [{"count": 10**10}]}), "palm.glb declares 10000000000 numbers"),
        ("meshes/palm.glb", glb(b'{"a":' + b"[" * 100_000), "is not valid JSON"),
    ],
)
def test_without_a_mesh_nothing_is_written(copied: Path, named: str, content: bytes | None, words: str):
    _replace(copied / "robot.urdf", "meshes/palm.glb", named)
    if content is not None:
        (copied / named).write_bytes(content)
    with pytest.raises(InputError, match=words):
        write_mirrored(copied, copied.parent / "image")
    assert not (copied.parent / "image").exists()


def _replace(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_urdf_in_any_unicode_is_mirrored(copied: Path, encoding: str):
    text = (copied / "robot.urdf").read_text()
    written = f'<?xml version="1.0" encoding="{encoding[:6].rstrip("-")}"?><!-- \u00fc -->' + text.split("?>", 1)[1]
    (copied / "robot.urdf").write_text(written, encoding=encoding)
    write_mirrored(copied, copied.parent / "image")
    assert load_robot(copied.parent / "image").model.links[0] == "base_link"


def test_a_urdf_in_another_encoding_is_refused(copied: Path):
    text = (copied / "robot.urdf").read_text()
    written = '<?xml version="1.0" encoding="ISO-8859-1"?><!-- \u00fc -->' + text.split("?>", 1)[1]
    (copied / "robot.urdf").write_bytes(written.encode("latin-1"))
    with pytest.raises(InputError, match=r"robot\.urdf is no UTF-8 text .*: write it again"):
        write_mirrored(copied, copied.parent / "image")
    assert not (copied.parent / "image").exists()


def test_a_robot_can_be_named_by_its_name(right: RobotDescription, tmp_path: Path):
    assert tmp_path / "image/robot.toml" in write_mirrored(Path(right.name), tmp_path / "image")
    with pytest.raises(InputError, match="is the robot itself"):
        write_mirrored(Path(right.name), right.folder)


def test_a_robot_is_not_overwritten_by_its_image(right: RobotDescription):
    with pytest.raises(InputError, match="is the robot itself"):
        write_mirrored(right.folder, right.folder)
