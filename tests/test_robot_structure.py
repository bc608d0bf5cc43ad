"""The parts of a robot.toml fit together: arm, wrist, fingers, hand joints, contact settings, postures."""

import shutil
from pathlib import Path

import pytest
import yaml
from refusals import refused

from dora.robot import RobotDescription, load_robot
from dora.robot.mirror import write_mirrored
from dora.robot.motion.inverse_kinematics import InverseKinematics
from dora.robot.visuals import write_meshes

TOML, URDF = "robot.toml", "robot.urdf"
THUMB = '["Right_Thumb_0", "Right_Thumb_1", "Right_Thumb_2", "Right_Thumb_3"]'
WRIST, NAME = 'wrist_link = "base_link_hithand"', 'name = "diana7_hit"'
SHAPE = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
FAULTS = {
    "wrist at the root": (TOML, WRIST, 'wrist_link = "base_link"', "arm.joints must be .* in this order: none"),
    "wrist at a tip": (TOML, WRIST, 'wrist_link = "thumb_tip"', "arm.joints must be .* Right_Thumb_3"),
    "wrist before the last joint": (TOML, WRIST, 'wrist_link = "link6"', "in this order: joint1, .*, joint6[.]"),
    "arm in another order": (TOML, '"joint6", "joint7"', '"joint7", "joint6"', "in this order: joint1, joint2"),
    "palm at a tip": (TOML, 'palm_link = "base_link_hithand"', 'palm_link = "index_tip"', "palm_link is 'index_tip'"),
    "tip at the root": (TOML, 'tip = "thumb_tip"', 'tip = "base_link"', "thumb.tip is 'base_link', which is not below"),
    "tip at the wrist": (
        TOML,
        'tip = "thumb_tip"',
        'tip = "base_link_hithand"',
        "thumb.tip is .* not below wrist_link",
    ),
    "tip of another": (TOML, 'tip = "thumb_tip"', 'tip = "index_tip"', "fingers.thumb.joints must be .*Right_Index_0"),
    "tip at the medial": (TOML, 'tip = "thumb_tip"', 'tip = "Right_Thumb_Phamed"', "thumb.joints must be"),
    "tip at the distal": (TOML, 'tip = "thumb_tip"', 'tip = "Right_Thumb_Phadist"', "thumb.distal is .* not between"),
    "no joints": (TOML, f"[fingers.thumb]\njoints = {THUMB}", "[fingers.thumb]\njoints = []", "thumb.joints must be"),
    "fewer joints": (
        TOML,
        f"[fingers.thumb]\njoints = {THUMB}",
        '[fingers.thumb]\njoints = ["Right_Thumb_0"]',
        "must be",
    ),
    "joints of another": (
        TOML,
        f"[fingers.thumb]\njoints = {THUMB}",
        f"[fingers.thumb]\njoints = {THUMB.replace('Thumb', 'Index')}",
        "fingers.thumb.joints must be .*: Right_Thumb_0",
    ),
    "joints in another order": (
        TOML,
        f"[fingers.thumb]\njoints = {THUMB}",
        f"[fingers.thumb]\njoints = {THUMB.replace('_0', '_9').replace('_1', '_0').replace('_9', '_1')}",
        "in this order: Right_Thumb_0, Right_Thumb_1",
    ),
    "distal of another": (TOML, 'distal = "Right_Thumb_Phadist"', 'distal = "Right_Ring_Phadist"', "thumb.distal is"),
    "proximal at the wrist": (
        TOML,
        'proximal = "Right_Thumb_Phaprox"',
        'proximal = "base_link_hithand"',
        "proximal is",
    ),
    "links exchanged": (TOML, 'proximal = "Right_Thumb_Phaprox"', 'proximal = "Right_Thumb_Phadist"', "exchange them"),
    "distal that moves": (TOML, 'distal = "Right_Thumb_Phadist"', 'distal = "Right_Thumb_Phamed"', "not fixed to the"),
    "tip with a shape": (URDF, '<link name="thumb_tip"/>', f'<link name="thumb_tip">{SHAPE}</link>', "contact group"),
    "friction": (TOML, "friction = 0.9", "friction = -5", "contact.hand.friction is -5; it must be from 0 to 10"),
    "restitution": (TOML, "restitution = 0.0", "restitution = 500", "restitution is 500; it must be from 0 to 1"),
    "contact offset": (
        TOML,
        "contact_offset = 5e-3",
        "contact_offset = -1e8",
        "contact.arm.contact_offset is -1e[+]08",
    ),
    "rest offset": (TOML, "rest_offset = 0.0", "rest_offset = -1e8", "contact.arm.rest_offset is -1e[+]08"),
    "rest above contact": (TOML, "rest_offset = 0.0", "rest_offset = 0.01", "must be below its contact_offset"),
    "name with a folder": (TOML, NAME, 'name = "../x"', "the name is '../x'; use letters"),
    "name of a folder above": (TOML, NAME, 'name = ".."', "use letters"),
    "name with a drive": (TOML, NAME, "name = 'C:\\x'", "use letters"),
    "URDF with a zero": (TOML, 'urdf = "robot.urdf"', 'urdf = "a\\u0000"', "urdf is 'a.x00'"),
    "URDF at the folder": (TOML, 'urdf = "robot.urdf"', 'urdf = "."', "does not exist"),
}


@pytest.fixture
def folder(robot: RobotDescription, tmp_path: Path) -> Path:
    return Path(shutil.copytree(robot.folder, tmp_path / "spoiled", ignore=shutil.ignore_patterns("meshes")))


def change(path: Path, *changes: tuple[str, str]) -> None:
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text)


@pytest.mark.parametrize("case", FAULTS)
def test_parts_that_do_not_fit_are_refused(folder: Path, case: str):
    name, old, new, words = FAULTS[case]
    change(folder / name, (old, new))
    with refused(words):
        load_robot(folder)


def test_a_hand_joint_without_a_finger_is_refused(folder: Path):
    text = (folder / TOML).read_text()
    start, end = text.index("[fingers.pinky]"), text.index("# Arm straight up")
    (folder / TOML).write_text(text[:start] + text[end:])
    with refused("the hand joint 'Right_Little_0' belongs to no finger"):
        load_robot(folder)


def test_a_tip_is_a_bare_frame(folder: Path):
    change(folder / URDF, ('<link name="thumb_tip"/>', f'<link name="thumb_tip">{SHAPE}</link>'))
    change(folder / TOML, ('links = ["base_link",', 'links = ["thumb_tip", "base_link",'))
    with refused("thumb.tip is 'thumb_tip', which has shapes or links below it"):
        load_robot(folder)


def test_a_finger_of_fewer_links_is_read(folder: Path):
    """A proximal link may be the medial one, too."""
    change(folder / TOML, ('proximal = "Right_Thumb_Phaprox"', 'proximal = "Right_Thumb_Phamed"'))
    assert load_robot(folder).fingers["thumb"].links[0] == "Right_Thumb_Phamed"


def test_a_robot_without_the_posture_of_a_task_is_refused(folder: Path):
    change(folder / TOML, ("[postures.home]", "[postures.rest]"))
    robot = load_robot(folder)
    with refused("robot 'diana7_hit' has no posture 'home'; add it to .*robot.toml, which has zero, rest, above"):
        InverseKinematics(robot)


@pytest.mark.parametrize("name", ["a(b)", "-x"])
def test_an_image_has_a_name_that_can_be_read(robot: RobotDescription, tmp_path: Path, name: str):
    with refused("has a name that no robot may have"):
        write_mirrored(robot.folder, tmp_path / name)
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize("name", ["../../esc", "/nowhere/esc", "a/b", "..", "", "a\\b", "x" * 300, 7, "a\0b"])
def test_meshes_have_names_of_files_in_their_folder(robot: RobotDescription, tmp_path: Path, name: object):
    table = yaml.safe_load((robot.folder / "visuals.yaml").read_text())
    ball = {"part": "hull", "material": "m", "of": [{"at": [0, 0, 0], "radius": 0.01}]}
    table = {"materials": {"m": next(iter(table["materials"].values()))}, "meshes": {"good": [ball], name: [ball]}}
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "visuals.yaml").write_text(yaml.safe_dump(table))
    with refused("visuals.yaml names a mesh .*; use letters"):
        write_meshes(tmp_path / "robot")
    assert [path.name for path in tmp_path.rglob("*")] == ["robot", "visuals.yaml"]
