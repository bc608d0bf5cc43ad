"""Hands, names, meshes and settings that are not those of the robot and the objects that come with Dora."""

import dataclasses
import functools
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from other_robots import changed
from refusals import refused

from dora.affordance.hand.hand_model import MOST_FINGERS, HandModel
from dora.affordance.objects.affordance_object import UPRIGHT, corners, support_height
from dora.affordance.objects.catalogue import object_places
from dora.affordance.search.backends import described
from dora.affordance.search.native import compiling, field
from dora.affordance.search.search import Settings
from dora.robot import load_robot
from dora.robot.mirror import mirrored_name
from dora.robot.motion.collision import CollisionModel
from dora.robot.synergies import expand_fingers, reduce_fingers


def test_more_fingers_than_contact_classes_are_refused():
    robot = load_robot("diana7_hit")
    fingers = robot.fingers | {"sixth": next(iter(robot.fingers.values()))}
    with refused(f"has 6 fingers; there are contact classes for {MOST_FINGERS}"):
        HandModel(dataclasses.replace(robot, fingers=fingers))


def test_a_finger_with_one_joint_bends_with_it():
    robot = load_robot("diana7_hit")
    short = {name: dataclasses.replace(finger, joints=finger.joints[:1]) for name, finger in robot.fingers.items()}
    robot = dataclasses.replace(robot, fingers=short)
    joints = expand_fingers(robot, torch.eye(6))
    for number, finger in enumerate(short.values()):
        follows = torch.zeros(len(robot.hand))
        follows[robot.hand.names.index(finger.joints[0])] = 1.0
        assert torch.equal(joints[number], follows)
    assert torch.equal(joints[5], torch.zeros(len(robot.hand)))  # such a thumb does not move aside
    command = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.0]])
    torch.testing.assert_close(reduce_fingers(robot, expand_fingers(robot, command)), command)


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("Right_Thumb_0", "Left_Thumb_0"), ("left_hand", "right_hand"), ("righthand", "lefthand"),
        ("upright", "upright"), ("palmRight", "palmLeft"), ("RIGHT_ARM", "LEFT_ARM"), ("up_right", "up_left"),
    ],
)  # fmt: skip
def test_sides_are_exchanged_where_they_are_words(name: str, image: str):
    assert (mirrored_name(name), mirrored_name(image)) == (image, name)


def test_a_joint_may_have_the_name_of_a_link(tmp_path: Path):
    pytest.importorskip("pinocchio")
    shaped = next(iter(load_robot("diana7_hit").shapes))

    def namesake(root: ElementTree.Element) -> None:
        ElementTree.SubElement(root, "link", name="plate")
        joint = ElementTree.SubElement(root, "joint", name=shaped, type="fixed")
        ElementTree.SubElement(joint, "parent", link=shaped)
        ElementTree.SubElement(joint, "child", link="plate")

    robot = changed(tmp_path / "namesake", namesake)
    usual, other = CollisionModel(load_robot("diana7_hit")), CollisionModel(robot)
    arm, hand = np.zeros((1, len(robot.arm))), np.zeros(len(robot.hand))
    assert other.free(arm, hand) == usual.free(arm, hand)


def test_vertices_of_no_triangle_are_no_part_of_an_object():
    """Editors of meshes leave them behind; the height above the table and the size are of the surface."""
    box = trimesh.creation.box((0.06, 0.06, 0.06))
    stray = trimesh.Trimesh(np.vstack([box.vertices, [[0.0, 0.0, -0.5]]]), box.faces, process=False)
    assert support_height(stray, UPRIGHT) == support_height(box, UPRIGHT) == pytest.approx(0.03)
    assert len(corners(stray)) == 8


def test_a_folder_counts_before_the_mesh_that_it_was_made_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "mug").mkdir()
    for path in (tmp_path / "mug" / "object.toml", tmp_path / "mug.stl", tmp_path / "pan.stl"):
        path.touch()
    monkeypatch.setenv("DORA_OBJECTS", str(tmp_path))
    assert object_places()["mug"] == tmp_path / "mug"
    assert object_places()["pan"] == tmp_path / "pan.stl"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"polish": 0}, "polish of at least 1"),
        ({"oversampling": 0.5}, "oversampling of at least 1"),
        ({"field_size": float("nan")}, "field_size of at least 1"),
        ({"ramp_start": 1.0}, "ramp_start from 0 to below 1"),
    ],
)
def test_settings_with_which_no_search_ends_are_refused(settings: dict[str, Any], words: str):
    with refused(words):
        Settings(**settings)


class Soft(torch.nn.Module):
    """An energy that is an object."""


def test_an_energy_may_be_anything_that_can_be_called():
    """Its name stands in the text that goes with candidates."""
    extra: Any = {"a": (1.0, functools.partial(len)), "b": (2.0, Soft()), "c": (3.0, len)}
    text = described("pytorch_kinematics", extra)
    assert "a=1.0*functools.partial" in text
    assert f"b=2.0*{__name__}.Soft" in text
    assert "c=3.0*builtins.len" in text


def test_compiled_code_belongs_to_the_text_of_all_that_goes_into_it(tmp_path: Path):
    """Numba alone looks at the file of a function, and would keep the constants of another one."""
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "a.py").write_text("A = 1\n")
    (tmp_path / "b.py").write_text("B = 1\n")
    places = [tmp_path / "below", tmp_path / "b.py"]
    before = compiling.digest_of_sources(places)
    assert before == compiling.digest_of_sources(places)
    for path in (tmp_path / "below" / "a.py", tmp_path / "b.py"):
        text = path.read_text()
        path.write_text(text.replace("1", "2"))
        assert compiling.digest_of_sources(places) != before
        path.write_text(text)
    function: Any = field.sample
    assert compiling.digest_of_sources(compiling.SOURCES) in str(function._cache.cache_path)
    assert "numba-" not in (compiling.SETTINGS.CACHE_DIR or "")
    files = {path.name for place in compiling.SOURCES for path in ([place] if place.is_file() else place.rglob("*.py"))}
    assert {"energies.py", "signed_distance.py", "closing.py"} <= files
