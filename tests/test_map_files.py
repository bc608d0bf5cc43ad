"""Files of affordance maps: what they keep, and damage of every part, refused in one sentence."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from dora.affordance.maps.affordance_map import FORMAT, AffordanceMap
from dora.affordance.maps.voting import VotingSettings, vote_over_map
from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError
from dora.files import read_tensors, write_tensors

SOUP = trimesh.Trimesh(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1], [1, 0, 0]], [[0, 1, 2], [3, 4, 5]], process=False
)
"""Two triangles whose common corners are stored twice."""


@pytest.fixture
def map() -> AffordanceMap:
    return AffordanceMap(
        name="soup", points=torch.tensor([[0.1, 0.1, 0.0], [0.5, 0.0, 0.5]]), normals=torch.eye(3)[[2, 1]],
        areas=torch.tensor([0.4, 0.6]), labels=torch.tensor([0, 1]), names=("a", "b"), mesh=SOUP,
        face_labels=np.array([0, 1]), digest="d",
    )  # fmt: skip


def test_a_map_is_read_without_its_object_as_it_was_written(map: AffordanceMap, tmp_path: Path):
    map.save(tmp_path / "a")
    found = AffordanceMap.load(tmp_path / "a")
    assert (found.name, found.names, found.digest) == ("soup", ("a", "b"), "d")
    np.testing.assert_array_equal(found.mesh.vertices, SOUP.vertices)
    np.testing.assert_array_equal(found.mesh.faces, SOUP.faces)
    assert found.face_labels.tolist() == [0, 1]
    cube = load_object("cube")
    with pytest.raises(InputError, match="another shape or labelling than cube"):
        AffordanceMap.load(tmp_path / "a", cube)
    replace(map, digest=cube.digest).save(tmp_path / "b")
    assert AffordanceMap.load(tmp_path / "b", cube).digest == cube.digest


def test_a_map_on_another_device_builds_its_tables_again(map: AffordanceMap):
    map.nearest(map.points, 1)
    map.region_distance(map.points, "a")
    moved = map.to("cpu")
    assert moved.nearest(moved.points, 2)[1].tolist() == [[0, 1], [1, 0]]
    assert moved.region_distance(moved.points[:1], "a").tolist() == pytest.approx([0.0], abs=1e-6)


@pytest.mark.parametrize("count", [3, 4])
def test_a_point_for_each_region_is_enough(count: int):
    assert len(AffordanceMap.from_object(load_object("jug"), count)) == count


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        ("name", 5, "lacks tensors or texts"),
        ("digest", None, "lacks tensors or texts"),
        ("names", "ab", "lacks tensors or texts"),
        ("names", ["a", 1], "lacks tensors or texts"),
        ("names", ["a"], "labels without a name"),
        ("names", [], "labels without a name"),
        ("areas", None, "lacks tensors or texts"),
        ("more", torch.zeros(2), "lacks tensors or texts"),
        ("points", torch.zeros(2, 2), "points of shape (2, 2)"),
        ("points", torch.zeros(3, 3), "normals of shape (2, 3)"),
        ("areas", torch.zeros(2, 1), "areas of shape (2, 1)"),
        ("areas", torch.zeros(3), "areas of shape (3,)"),
        ("face_labels", torch.zeros(6, dtype=torch.int64), "face_labels of shape (6,)"),
        ("labels", torch.zeros(2), "labels of the type torch.float32"),
        ("normals", torch.zeros(2, 3, dtype=torch.int64), "normals of the type torch.int64"),
        ("normals", torch.full((2, 3), torch.nan), "normals that are not finite"),
        ("areas", torch.tensor([0.1, torch.inf]), "areas that are not finite"),
        ("labels", torch.tensor([0, -1]), "labels without a name"),
        ("labels", torch.tensor([2, 0]), "labels without a name"),
        ("face_labels", torch.tensor([0, 2]), "labels without a name"),
        ("face_labels", torch.tensor([-1, 0]), "labels without a name"),
        ("faces", torch.tensor([[0, 1, 2], [3, 4, 6]]), ""),
    ],
)
def test_damage_of_a_map_is_refused(map: AffordanceMap, tmp_path: Path, part: str, value: Any, words: str):
    path = tmp_path / "a"
    map.save(path)
    tensors, metadata = read_tensors(path, FORMAT)
    texts = part in ("name", "names", "digest")
    changed: dict[str, Any] = {**(metadata if texts else tensors), part: value}
    changed = {name: content for name, content in changed.items() if content is not None}
    write_tensors(path, FORMAT, tensors if texts else changed, changed if texts else metadata)
    with pytest.raises(InputError) as error:
        AffordanceMap.load(path)
    assert words in str(error.value)
    assert str(error.value).startswith(f"{path} ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("whole", [torch.int32, torch.uint8])
def test_a_map_of_other_types_of_numbers_can_be_asked_all_the_same(
    map: AffordanceMap, tmp_path: Path, whole: torch.dtype
):
    path = tmp_path / "a"
    map.save(path)
    tensors, metadata = read_tensors(path, FORMAT)
    tensors = {name: value.to(torch.float64 if value.is_floating_point() else whole) for name, value in tensors.items()}
    write_tensors(path, FORMAT, tensors, metadata)
    found = AffordanceMap.load(path)
    assert found.nearest(map.points, 1)[1].tolist() == [[0], [1]]
    parts = torch.tensor([[0, 2], [3, 0]], dtype=torch.uint8)
    assert vote_over_map(found, parts, VotingSettings(neighbours=1)).tolist() == [1, 0]
    assert found.region_distance(map.points, "b").tolist() == pytest.approx([0.1, 0.0], abs=5e-3)


def test_a_map_without_points_is_refused(map: AffordanceMap, tmp_path: Path):
    path = tmp_path / "a"
    map.save(path)
    tensors, metadata = read_tensors(path, FORMAT)
    for name in ("points", "normals", "areas", "labels"):
        tensors[name] = tensors[name][:0].clone()
    write_tensors(path, FORMAT, tensors, metadata)
    with pytest.raises(InputError, match="has no points"):
        AffordanceMap.load(path)
