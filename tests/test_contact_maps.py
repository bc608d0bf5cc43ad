"""Candidates carry their contact semantic map: in files, in line with their rows, and the same as from their poses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import MAP_POINTS, GraspCandidates, concatenate
from dora.affordance.contact_maps import class_agreement, map_bundled_set, mapped, with_contact_maps
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.maps.packed_maps import COUNT, MOST_POINTS, PART, POINT, pack, unpack
from dora.affordance.maps.voting import HAND_PARTS, vote_over_map
from dora.affordance.objects.catalogue import available_objects, load_object
from dora.errors import InputError
from dora.files import read_tensors, write_tensors
from dora.robot import load_robot

ROBOT = load_robot("diana7_hit")
LARGEST_FILE = 500_000
"""Bytes of a bundled set of at most 160 candidates."""


@pytest.fixture(scope="module")
def jug() -> GraspCandidates:
    return load_candidates("jug")


@pytest.mark.parametrize("points", [40, 2**15, 2**15 + 1])
def test_maps_are_packed_without_loss(points: int):
    maps = torch.zeros(5, points, dtype=torch.uint8)
    maps[0, [0, 7, points - 1]] = torch.tensor([1, 6, 3], dtype=torch.uint8)
    maps[3] = 2
    tensors = pack(maps)
    assert tensors[COUNT].tolist() == [3, 0, 0, points, 0]
    assert torch.equal(unpack(tensors, 5, points, "a"), maps)
    assert tensors == {}


def test_maps_of_one_point_can_be_read_again():
    maps = torch.tensor([[2], [0], [6]], dtype=torch.uint8)
    assert torch.equal(unpack(pack(maps), 3, 1, "a"), maps)


@pytest.mark.parametrize(("points", "kind"), [(2**15, torch.int16), (2**15 + 1, torch.int32)])
def test_a_point_takes_two_bytes_where_that_is_enough(points: int, kind: torch.dtype):
    assert pack(torch.ones(1, points, dtype=torch.uint8))[POINT].dtype == kind


def test_maps_that_could_not_be_read_again_are_not_written(jug: GraspCandidates, tmp_path: Path):
    maps = torch.zeros((), dtype=torch.uint8).expand(2**16 + 1, 2**12)
    with pytest.raises(InputError, match=r"65537 contact maps of 4096 points .*keep at most 65536 candidates"):
        pack(maps)
    with pytest.raises(InputError, match="2097152 points each are too large"):
        replace(jug.select([0]), contact_map=torch.zeros(1, 2 * MOST_POINTS, dtype=torch.uint8)).save(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_a_file_keeps_the_maps_and_little_else(jug: GraspCandidates, tmp_path: Path):
    path = tmp_path / "jug.safetensors"
    jug.save(path)
    assert torch.equal(GraspCandidates.load(path).contact_map, jug.contact_map)
    plain = replace(jug, contact_map=torch.zeros(len(jug), 0, dtype=torch.uint8))
    plain.save(tmp_path / "plain.safetensors")
    more = path.stat().st_size - (tmp_path / "plain.safetensors").stat().st_size
    assert more < 3 * int((jug.contact_map > 0).sum()) + 4 * len(jug) + 500


def test_files_without_maps_load(jug: GraspCandidates, tmp_path: Path):
    """As they were written before: no tensor and no entry of the metadata says anything of maps."""
    path = tmp_path / "old.safetensors"
    jug.save(path)
    tensors, metadata = read_tensors(path, "dora-grasps 1")
    assert metadata.pop(MAP_POINTS) == jug.contact_map.shape[1]
    for name in (COUNT, POINT, PART):
        del tensors[name]
    write_tensors(path, "dora-grasps 1", tensors, metadata)
    old = GraspCandidates.load(path, load_object("jug"), ROBOT)
    assert old.contact_map.shape == (len(jug), 0)
    assert torch.equal(old.position, jug.position)


def integers(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.int32)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({COUNT: integers(1, 1)}, "do not fit 3 candidates"),
        ({COUNT: integers(1, 2, 1)}, "do not fit 3 candidates"),
        ({COUNT: integers(2, 0, 0, 1)}, "do not fit 3 candidates"),
        ({COUNT: integers(4, -1, 0)}, "do not fit 3 candidates"),
        ({PART: integers(1, 2)}, "do not fit 3 candidates"),
        ({POINT: integers(3, 9, 10)}, "not 0 to 9"),
        ({POINT: integers(3, -1, 2)}, "not 0 to 9"),
        ({POINT: integers(3, 3, 2)}, "ascending"),
        ({PART: integers(1, 0, 2)}, f"not 1 to {HAND_PARTS}"),
        ({PART: integers(1, 7, 2)}, f"not 1 to {HAND_PARTS}"),
        ({PART: torch.tensor([1.0, torch.nan, 2.0])}, "not one column of integers"),
        ({POINT: integers(3, 5, 2)[None]}, "not one column of integers"),
        ({POINT: None}, "incomplete"),
        ({MAP_POINTS: 0}, "of 0 points"),
        ({MAP_POINTS: MOST_POINTS + 1}, "points"),
        ({MAP_POINTS: "10"}, "points"),
    ],
)
def test_damaged_maps_are_refused_in_one_sentence(jug: GraspCandidates, tmp_path: Path, change: dict, words: str):
    """Each is a file whose digest fits, written by something else."""
    path = tmp_path / "wrong.safetensors"
    few = jug.select(slice(3))
    replace(few, contact_map=torch.zeros(3, 0, dtype=torch.uint8)).save(path)
    tensors, metadata = read_tensors(path, "dora-grasps 1")
    maps = {COUNT: integers(2, 0, 1), POINT: integers(3, 5, 2), PART: integers(1, 6, 2), MAP_POINTS: 10}
    for changed, good in ((change, False), ({}, True)):
        content = {name: value for name, value in (maps | changed).items() if value is not None}
        own = metadata | {MAP_POINTS: content.pop(MAP_POINTS)}
        write_tensors(path, "dora-grasps 1", tensors | content, own)
        if good:
            assert GraspCandidates.load(path).contact_map.sum(1).tolist() == [7, 0, 2]
            continue
        with pytest.raises(InputError) as error:
            GraspCandidates.load(path)
        assert words in str(error.value)
        assert str(error.value).startswith(f"{path} holds damaged contact maps")
        assert "\n" not in str(error.value)


def test_a_class_that_no_hand_has_is_refused(jug: GraspCandidates):
    wrong = jug.contact_map.clone()
    wrong[4, 7] = HAND_PARTS + 1
    with pytest.raises(InputError, match="contact_map holds a class that is not 0 to 6"):
        replace(jug, contact_map=wrong)


def test_maps_stay_with_their_rows(jug: GraspCandidates, tmp_path: Path):
    order = torch.randperm(len(jug), generator=torch.Generator().manual_seed(0))
    joined = concatenate([jug.select(order[:9]), jug.select(order[9:])])
    joined.save(tmp_path / "a.safetensors")
    found = GraspCandidates.load(tmp_path / "a.safetensors")
    assert torch.equal(found.position, jug.position[order])
    assert torch.equal(found.contact_map, jug.contact_map[order])
    assert torch.equal(jug.select(jug.valid).to("cpu").contact_map, jug.contact_map[jug.valid])


def test_sets_without_maps_or_with_other_points(jug: GraspCandidates):
    plain = replace(jug, contact_map=torch.zeros(len(jug), 0, dtype=torch.uint8))
    assert concatenate([jug, plain]).contact_map.shape == (2 * len(jug), 0)
    with pytest.raises(InputError, match="different numbers of points cannot be joined"):
        concatenate([jug, replace(jug, contact_map=jug.contact_map[:, :100])])


@pytest.mark.parametrize("name", ["cube", "hammer", "jug", "microwave"])
def test_bundled_maps_are_those_of_the_poses(name: str):
    assert name in available_objects()
    found, obj = load_candidates(name), load_object(name)
    map = AffordanceMap.from_object(obj)
    anew = with_contact_maps(found, map, HandModel(ROBOT))
    touched = (found.contact_map > 0) | (anew.contact_map > 0)
    assert touched.any(1).all()
    assert (found.contact_map == anew.contact_map)[touched].float().mean() > 0.999  # a point may be at 5 mm exactly
    assert mapped(found, map, HandModel(ROBOT)) is found
    assert obj.folder is not None
    assert (obj.folder / "grasps.safetensors").stat().st_size < LARGEST_FILE
    assert class_agreement(found, obj, map).grasps.sum() >= found.of_class(*obj.classes).sum()


def test_maps_over_the_points_of_another_file_of_the_same_surface_are_made_anew(jug: GraspCandidates):
    """As many points, elsewhere: their order is that of the mesh's faces."""
    obj, hand, some = load_object("jug"), HandModel(ROBOT), jug.select(slice(12))
    order = np.random.default_rng(0).permutation(len(obj.mesh.faces))
    mesh = trimesh.Trimesh(obj.mesh.vertices, obj.mesh.faces[order], process=False)
    other = AffordanceMap.from_object(replace(obj, mesh=mesh, face_labels=obj.face_labels[order]))
    found = mapped(some, other, hand)
    assert torch.equal(found.contact_map, with_contact_maps(some, other, hand).contact_map)
    own, votes = AffordanceMap.from_object(obj), vote_over_map(other, found.contact_map)
    assert torch.equal(votes, vote_over_map(own, some.contact_map))
    assert (vote_over_map(other, some.contact_map) != votes).any()
    assert mapped(found, other, hand) is found


def test_a_bundled_set_gets_maps_and_stays_as_it_is(
    jug: GraspCandidates, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    path = tmp_path / "grasps.safetensors"
    replace(jug, contact_map=torch.zeros(len(jug), 0, dtype=torch.uint8)).save(path)
    monkeypatch.setattr("dora.affordance.contact_maps.bundled_path", lambda name: path)
    monkeypatch.setattr("dora.affordance.contact_maps.load_candidates", lambda name: GraspCandidates.load(path))
    for _ in range(2):
        where, agreement = map_bundled_set("jug")
        assert where == path
        assert agreement.names == ("body", "handle", "rim")
        assert agreement.grasps.tolist() == [0, 96, 0]
        assert agreement.recall["handle"] > 0.95
        found = GraspCandidates.load(path)
        for name, value in jug.tensors().items():
            if name == "contact_map":
                assert (value == found.contact_map).float().mean() > 0.9999
            else:
                np.testing.assert_array_equal(found.tensors()[name].numpy(), value.numpy())
        assert (found.settings, found.grasp_class) == (jug.settings, jug.grasp_class)
