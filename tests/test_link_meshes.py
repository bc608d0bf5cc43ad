"""Pictures and pages show the visual meshes of a robot where its URDF puts them."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from other_robots import changed, unchanged

from dora.affordance.hand.link_meshes import link_meshes
from dora.robot import load_robot

LINK = "base_link_hithand"


def bounds(robot) -> np.ndarray:
    """Lowest and highest coordinates (2, 3) of what is drawn of the palm [m]."""
    return link_meshes(robot, [LINK])[LINK].bounds


def test_meshes_have_the_place_and_the_scale_of_the_urdf(tmp_path: Path):
    usual = bounds(load_robot("diana7_hit"))

    def elsewhere(root: ElementTree.Element) -> None:
        (link,) = [link for link in root.findall("link") if link.get("name") == LINK]
        for visual in link.findall("visual"):
            ElementTree.SubElement(visual, "origin", xyz="0 0 0.5", rpy="0 0 3.141592653589793")
            for mesh in visual.iter("mesh"):
                mesh.set("scale", "2 2 2")

    robot = changed(tmp_path / "elsewhere", elsewhere)
    found = bounds(robot)
    np.testing.assert_allclose(found[:, 2], 2 * usual[:, 2] + 0.5, atol=1e-6)
    np.testing.assert_allclose(found[:, :2], -2 * usual[::-1, :2], atol=1e-6)
    np.testing.assert_allclose(bounds(changed(tmp_path / "same", unchanged)), usual)
    np.testing.assert_allclose(bounds(robot), found)  # files are read once, and not moved twice
