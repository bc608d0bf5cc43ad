"""Folders of objects: what is committed is what the models make, users' folders are found, damaged ones are refused."""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from boxes import two_regions
from commands import call, load_command
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dora.affordance.bundled_sets import bundled_path, load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects import build
from dora.affordance.objects.affordance_object import AffordanceObject, Piece
from dora.affordance.objects.catalogue import available_objects, load_object, own_objects
from dora.affordance.objects.decomposition import cache_folder
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.folder_writing import write_object_folder
from dora.affordance.objects.mesh_files import read_ply, write_ply
from dora.affordance.reach.feasibility import Reach
from dora.affordance.reach.feasibility_table import Grid, ReachTable
from dora.commands import grasps, view
from dora.errors import InputError
from dora.policies.policy import load_policy
from dora.robot import available_robots, load_robot
from dora.robot.shapes import Shape

NAMES = ("cube", "hammer", "jug", "microwave")
SECONDS = 0.3
"""Processor time within which an object has to be read."""


def assert_same(one: AffordanceObject, other: AffordanceObject, tolerance: float = 0.0) -> None:
    """All that belongs to an object is equal, numbers up to an absolute tolerance; names and folders aside."""
    for field in fields(AffordanceObject):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name in ("mesh", "solid"):
            assert_same_mesh(a, b, tolerance)
        elif field.name == "pieces":
            assert [piece.label for piece in a] == [piece.label for piece in b]
            for left, right in zip(a, b, strict=True):
                assert_same_shape(left.shape, right.shape, tolerance)
        elif field.name in ("mass", "inertia", "support", "face_labels"):
            np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)
        elif field.name not in ("name", "folder"):
            assert a == b, field.name


def assert_same_mesh(one: trimesh.Trimesh, other: trimesh.Trimesh, tolerance: float) -> None:
    np.testing.assert_array_equal(one.faces, other.faces)
    np.testing.assert_allclose(one.vertices, other.vertices, rtol=0, atol=tolerance)


def assert_same_shape(one: Shape | trimesh.Trimesh, other: Shape | trimesh.Trimesh, tolerance: float) -> None:
    if isinstance(one, trimesh.Trimesh):
        assert isinstance(other, trimesh.Trimesh)
        assert_same_mesh(one, other, tolerance)
    else:
        assert isinstance(other, Shape)
        assert one.kind == other.kind
        for name in ("position", "quaternion", "size"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", NAMES)
def test_committed_folders_are_what_the_models_make(name: str):
    """The digest exactly; lengths within .1 nm, because the sine of another processor differs in the last bit."""
    assert_same(load_object(name), build.model(name), 1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_writing_and_reading_changes_no_bit(name: str, tmp_path: Path):
    made = build.model(name)
    assert write_object_folder(made, tmp_path / name) == tmp_path / name / "object.toml"
    found = read_object_folder(tmp_path / name)
    assert_same(found, made)
    assert (found.solid is found.mesh) == (made.solid is made.mesh)
    assert found.folder == tmp_path / name


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    vertices=arrays(np.float64, (3, 3), elements=st.floats(allow_nan=False, allow_infinity=False)),
    labels=arrays(np.int64, (1,), elements=st.integers(0, 300)),
)
def test_meshes_keep_every_double(vertices: np.ndarray, labels: np.ndarray, tmp_path: Path):
    mesh = trimesh.Trimesh(vertices, [[2, 0, 1]], process=False)
    write_ply(tmp_path / "mesh.ply", mesh, labels)
    found, index = read_ply(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(found.vertices, vertices)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_array_equal(index, labels)


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    names=st.lists(st.text(st.characters(codec="utf-8"), min_size=1, max_size=200), min_size=2, max_size=2, unique=True)
)
def test_regions_may_have_any_name(names: list[str], tmp_path: Path):
    folder = tmp_path / "cube"
    write_object_folder(replace(two_regions(), labels=tuple(names), classes=("A", "B"), target=names[1],
                                pieces=(Piece(names[0], two_regions().pieces[0].shape),)), folder)  # fmt: skip
    found = read_object_folder(folder)
    assert found.labels == tuple(names)
    assert found.target == names[1]
    assert found.target_class == "B"


def test_a_mesh_shows_its_regions_in_a_viewer(tmp_path: Path):
    """Other programs read the file too: triangles, and a colour per region."""
    jug = load_object("jug")
    write_ply(tmp_path / "mesh.ply", jug.mesh, jug.face_labels)
    seen = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(seen.vertices, jug.mesh.vertices)
    shown: Any = seen.visual
    assert len(np.unique(shown.face_colors, axis=0)) == len(jug.labels)


def test_an_object_is_read_once_and_fast():
    assert available_objects() == NAMES
    for name in NAMES:
        start = time.process_time()
        read_object_folder(own_objects() / name)
        assert time.process_time() - start < SECONDS, name
    assert load_object("jug") is load_object("jug") is load_object(own_objects() / "jug")


def test_an_object_is_read_again_when_its_folder_has_changed(folder: Path):
    first = load_object(folder)
    description = folder / "object.toml"
    before, after = f"mass = {first.mass}", f"mass = {2 * first.mass}"
    text = description.read_text()
    assert text.count(before) == 1
    description.write_text(text.replace(before, after))
    assert load_object(folder).mass == 2 * first.mass
    assert load_object(folder) is load_object(folder)


def test_what_objects_say_about_their_use():
    found = {name: load_object(name) for name in NAMES}
    assert {name: obj.placement for name, obj in found.items()} == {
        "cube": "table", "hammer": "air", "jug": "table", "microwave": "fixture"
    }  # fmt: skip
    assert [name for name, obj in found.items() if obj.on_table] == ["cube", "jug"]
    assert {name: obj.start_posture for name, obj in found.items()} == {
        "cube": "home", "hammer": "home", "jug": "above", "microwave": "home"
    }  # fmt: skip
    assert {name: obj.friction for name, obj in found.items()} == {
        "cube": 0.9, "hammer": 0.9, "jug": 0.7, "microwave": 0.7
    }  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A user's folder of objects with a box in it."""
    write_object_folder(two_regions(), tmp_path / "objects" / "box")
    return tmp_path / "objects" / "box"


def test_objects_are_found_in_further_folders(folder: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(InputError, match="no object 'box'"):
        load_object("box")
    assert load_object(folder).name == "box"
    trimesh.creation.box((0.03, 0.03, 0.05)).export(folder.parent / "brick.stl")
    monkeypatch.setenv("DORA_CACHE", str(folder.parents[1] / "cache"))
    monkeypatch.setenv("DORA_OBJECTS", f"{folder.parent / 'nowhere'}:{folder.parent}")
    assert available_objects() == ("box", "brick", *NAMES)
    assert load_object("box") is load_object(str(folder))
    assert load_object("brick").name == "brick"
    assert load_object("brick").folder is None
    assert load_object(folder.parent / "brick.stl") is load_object("brick")
    assert load_object("jug").folder == own_objects() / "jug"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("jugg", "there is no object 'jugg', nor a folder or mesh at that path: did you mean 'jug'[?]"),
        ("spoon", "there is no object 'spoon', nor a folder or mesh at that path: choose one of cube, hammer, jug"),
        ("", "no object.toml"),
        ("x" * 5000, "there is no object"),
        ("a\0b", "there is no object"),
    ],
)
def test_unknown_objects_are_refused_with_what_there_is(name: str, words: str):
    with pytest.raises(InputError, match=words):
        load_object(name)


def test_grasps_lie_in_the_objects_folder(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("DORA_OBJECTS", str(folder.parent))
    for task, words in {
        None: "--object box --make-bundle",
        "DoraTwo-v1": "other object of DoraTwo-v1, .*--rank",
    }.items():
        with pytest.raises(InputError, match=f"has no grasps .*{words}.*-any-region"):
            load_candidates("box", region=False, task=task)
    with pytest.raises(InputError, match=r"has no grasps .*--object box --make-bundle`"):
        load_candidates("box")
    box = load_object("box")
    made = replace(load_candidates("cube").select([0, 1]), object="box", digest=box.digest)
    made.save(bundled_path("box"))
    assert bundled_path("box") == folder / "grasps.safetensors"
    assert len(load_candidates("box")) == len(load_candidates(folder)) == 2
    write_object_folder(box, folder)
    assert len(load_candidates("box")) == 2  # written again, the folder keeps its grasps
    replace(made, digest="0").save(bundled_path("box"))
    with pytest.raises(InputError, match="another shape"):
        load_candidates("box")


def test_commands_take_the_path_of_a_folder(folder: Path, monkeypatch: pytest.MonkeyPatch):
    box, args = load_object(folder), view.Args(str(folder))
    assert grasps.target(grasps.Args(object=str(folder))) == (box, "side")
    assert view.content(args) == (box, None)
    made = replace(load_candidates("cube").select([0, 1]), object="box", digest=box.digest)
    made.save(folder / "grasps.safetensors")
    obj, found = view.content(args)
    assert obj is box
    assert found is not None
    assert len(found) == 2
    file = str(folder / "grasps.safetensors")
    with pytest.raises(InputError, match="give its mesh with --mesh"):
        view.content(view.Args(file))
    assert view.content(view.Args(file, mesh=folder))[0] is box
    monkeypatch.setenv("DORA_OBJECTS", str(folder.parent))
    assert view.content(view.Args(file))[0] is box
    assert view.content(view.Args("box"))[0] is box


@pytest.mark.parametrize("command", ["grasps", "view"])
def test_help_lists_the_objects(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("DORA_OBJECTS", str(folder.parent))
    with pytest.raises(SystemExit):
        call(load_command(command), monkeypatch, "--help")
    assert "box, cube, hammer, jug, microwave" in " ".join(capsys.readouterr().out.split())


def test_a_mesh_file_has_no_place_for_grasps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("DORA_CACHE", str(tmp_path / "cache"))
    two_regions().mesh.export(tmp_path / "brick.stl")
    with pytest.raises(InputError, match=r"'brick' has no folder .*objects.build brick --mesh"):
        load_candidates(tmp_path / "brick.stl")


def test_a_reach_table_is_looked_for_in_the_objects_folder(folder: Path, tmp_path: Path):
    box, grid = read_object_folder(folder), Grid((0.5, 0.0), (0.0, 0.0), yaws=2)
    reach, grasps = Reach(load_robot("diana7_hit"), box), load_candidates("cube").select([0, 1])
    table = ReachTable.of(reach, grasps, grid, box.support, cache=tmp_path / "cache")
    (path,) = (tmp_path / "cache").iterdir()
    marked = replace(table, reason=6 - table.reason)
    marked.save(folder / path.name)
    path.unlink()
    found = ReachTable.of(reach, grasps, grid, box.support, cache=tmp_path / "cache")
    assert found.reason.tolist() == marked.reason.tolist()
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_users_mesh_is_written_as_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("DORA_CACHE", str(tmp_path / "cache"))
    trimesh.creation.box((30, 40, 50)).export(tmp_path / "brick.stl")
    (tmp_path / "labels.txt").write_text("\n".join(["top"] * 6 + ["bottom"] * 6))
    options = f"--mesh {tmp_path / 'brick.stl'} --units mm --labels {tmp_path / 'labels.txt'} --mass 0.35"
    monkeypatch.setattr("sys.argv", ["build", str(tmp_path / "my" / "mug"), *options.split()])
    assert build.main() == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "my" / "mug" / "object.toml")
    mug = load_object(tmp_path / "my" / "mug")
    assert (mug.name, mug.labels, mug.target, mug.mass) == ("mug", ("top", "bottom"), "top", 0.35)
    np.testing.assert_allclose(mug.mesh.extents, [0.03, 0.04, 0.05], atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("objects/spoon", "no model of 'spoon'; name the folder as one of: cube, hammer, jug, microwave"),
        ("--mesh mug.stl", "needs the one folder to write"),
        ("a/jug --mass 2", "belong to --mesh"),
        ("my/mug --mesh nowhere.stl", "no mesh file nowhere.stl"),
        ("/proc/nowhere/jug", "cannot make the folder"),
    ],
)
def test_the_command_refuses_bad_input(
    arguments: str, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("sys.argv", ["build", *arguments.split()])
    assert build.main() == 2
    assert words in capsys.readouterr().err


def test_meshes_that_are_no_part_any_more_are_removed(folder: Path):
    box = read_object_folder(folder)
    assert {path.name for path in folder.iterdir()} == {"object.toml", "mesh.ply", "solid.ply", "hull-1.ply"}
    write_object_folder(replace(box, solid=box.mesh, pieces=box.pieces[:1]), folder)
    assert {path.name for path in folder.iterdir()} == {"object.toml", "mesh.ply"}


@pytest.mark.parametrize("count", range(5))
def test_a_folder_that_is_half_written_is_as_before_or_refused(
    count: int, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    before, own, left = read_object_folder(folder), os.replace, iter(range(20))

    def cut(source: Any, target: Any) -> None:
        if Path(target).parent == folder and next(left) == count:
            raise KeyboardInterrupt
        own(source, target)

    monkeypatch.setattr(os, "replace", cut)
    larger = replace(before, mesh=trimesh.Trimesh(2 * before.mesh.vertices, before.mesh.faces), mass=9.0)
    with pytest.raises(KeyboardInterrupt):
        write_object_folder(larger, folder)
    monkeypatch.undo()
    if count:
        with pytest.raises(InputError, match="the format is 'unfinished', not 'dora-object 1'; write the folder again"):
            read_object_folder(folder)
    else:
        assert_same(read_object_folder(folder), before)
    write_object_folder(larger, folder)
    assert read_object_folder(folder).mass == 9.0


def test_what_could_not_be_read_again_is_not_written(folder: Path):
    before = read_object_folder(folder)
    with pytest.raises(InputError, match="mass is 1e"):
        write_object_folder(replace(before, mass=1e8), folder)
    assert_same(read_object_folder(folder), before)


def test_files_of_others_are_not_replaced(folder: Path, tmp_path: Path):
    (folder / "hull-old.ply").write_text("mine")
    write_object_folder(load_object(folder), folder)
    assert (folder / "hull-old.ply").read_text() == "mine"
    other = tmp_path / "scans"
    other.mkdir()
    (other / "mesh.ply").write_text("mine")
    with pytest.raises(InputError, match=r"mesh\.ply is in a folder without object\.toml: choose another folder"):
        write_object_folder(load_object(folder), other)
    assert [path.name for path in other.iterdir()] == ["mesh.ply"]


def test_the_source_of_an_object_is_not_replaced(folder: Path):
    mesh = folder / "mesh.ply"
    before = mesh.read_bytes()
    with pytest.raises(InputError, match="would be replaced by what is made of it: choose another folder"):
        build.run(build.Args((folder,), mesh=mesh, scale=2.0))
    assert mesh.read_bytes() == before


def test_without_a_home_what_is_cached_lies_among_temporary_files(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("DORA_CACHE", raising=False)
    assert cache_folder() == Path.home() / ".cache" / "dora"

    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    assert cache_folder() == Path(tempfile.gettempdir()) / f"dora-cache-{os.getuid()}"


def test_places_that_cannot_be_looked_into_hold_nothing(monkeypatch: pytest.MonkeyPatch):
    for variable in ("DORA_OBJECTS", "DORA_ROBOTS"):
        monkeypatch.setenv(variable, "x" * 5000)
    assert "jug" in available_objects()
    assert "diana7_hit" in available_robots()


@pytest.mark.parametrize("load", [load_object, load_robot, load_candidates, GraspCandidates.load, load_policy])
def test_names_that_are_too_long_get_a_sentence(load: Callable[[str], Any]):
    with pytest.raises(InputError):
        load("x" * 5000)
