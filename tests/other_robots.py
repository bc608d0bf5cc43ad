"""Robots that differ from the one that comes with Dora, as folders."""

import shutil
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import tomli_w

from dora.robot import RobotDescription, load_robot

SOURCE = Path(__file__).parents[1] / "robots" / "diana7_hit"
SHORT = "Right_Little_3"
"""The joint that a short little finger lacks."""


def changed(folder: Path, change: Callable[[ElementTree.Element], None], short: bool = False) -> RobotDescription:
    """The robot with another URDF in a new folder.

    Args:
        folder: where it is written.
        change: what is done to the root of the URDF.
        short: the last joint of the little finger is fixed.
    """
    shutil.copytree(SOURCE, folder, dirs_exist_ok=True)
    root = ElementTree.parse(SOURCE / "robot.urdf").getroot()
    about = tomllib.loads((SOURCE / "robot.toml").read_text())
    about["name"] = folder.name
    if short:
        _shorten(root, about)
    change(root)
    (folder / "robot.toml").write_text(tomli_w.dumps(about))
    ElementTree.ElementTree(root).write(folder / "robot.urdf")
    return load_robot(folder)


def unchanged(root: ElementTree.Element) -> None:
    """The URDF stays as it is."""


def mounted(root: ElementTree.Element) -> None:
    """Puts the robot on a fixed joint that changes nothing."""
    children = {child.get("link") for child in root.iterfind("joint/child")}
    (base,) = [link.get("name") for link in root.findall("link") if link.get("name") not in children]
    ElementTree.SubElement(root, "link", name="world")
    joint = ElementTree.SubElement(root, "joint", name="mount", type="fixed")
    ElementTree.SubElement(joint, "parent", link="world")
    ElementTree.SubElement(joint, "child", link=str(base))


def _shorten(root: ElementTree.Element, about: dict) -> None:
    at = about["hand"]["joints"].index(SHORT)
    for name in ("joints", "stiffness", "damping"):
        about["hand"][name].pop(at)
    about["coupling"] = [each for each in about["coupling"] if each["follower"] != SHORT]
    about["fingers"]["pinky"]["joints"].remove(SHORT)
    for posture in about["postures"].values():
        if isinstance(posture["hand"], list):
            posture["hand"].pop(at)
    (joint,) = [joint for joint in root.iter("joint") if joint.get("name") == SHORT]
    joint.set("type", "fixed")
    for tag in ("axis", "limit"):
        joint.remove(joint.find(tag))  # pyright: ignore[reportArgumentType]
