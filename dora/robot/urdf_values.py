"""Values of the elements of a URDF: texts, numbers, origins, sizes; checks of what only the simulator reads.

What does not fit is a ValueError, whose message says what it is.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np

from dora.errors import shown
from dora.geometry.rotations import quaternion_from_rpy

LARGEST_NUMBER = 1e9
"""Every number of a URDF is smaller, in SI units; a larger limit stands for none, and has to be left out."""
FARTHEST = 1000.0
"""Largest coordinate of an <origin> [m]."""
THINNEST, FINEST, LONGEST = 1e-4, 1e-6, 10.0
"""Smallest length of a shape that collides, and of one that is only seen; largest length of both [m]."""
MASSES = (1e-9, 1e6)
"""Smallest and largest mass of a link [kg]."""
SMALLEST_MOMENT = 1e-15
"""Smallest principal moment of inertia of a link [kg m^2]."""
SLACK = 0.05
"""What two principal moments of inertia may lack to the third, as a share of that: tables of robots are rounded."""
SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
"""Attributes with the lengths of each primitive [m]."""
INERTIA_NAMES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
"""Attributes of <inertia> [kg m^2]."""


def child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    """The first element with this tag in another."""
    found = element.find(tag)
    if found is None:
        name = element.get("name")
        raise ValueError(f"<{element.tag}{'' if name is None else f' name={name!r}'}> has no <{tag}>")
    return found


def text(element: ElementTree.Element, attribute: str) -> str:
    """An attribute."""
    if attribute not in element.attrib:
        raise ValueError(f"a <{element.tag}> has no attribute {attribute!r}")
    return element.attrib[attribute]


def numbers(element: ElementTree.Element, attribute: str, count: int = 3) -> tuple[float, ...]:
    """The numbers of an attribute, as many as are expected."""
    words = text(element, attribute).split()
    if len(words) != count:
        expected = {1: "one number", 3: "three numbers"}.get(count, f"{count} numbers")
        raise ValueError(f"attribute {attribute!r} of a <{element.tag}> needs {expected}")
    try:
        return tuple(number(word) for word in words)
    except ValueError as error:
        raise ValueError(f"attribute {attribute!r} of a <{element.tag}>: {error}") from error


def number(word: str) -> float:
    """A number, which has to be below `LARGEST_NUMBER`."""
    if "_" in word or not word.isascii():  # which `float` reads, and other readers of the file do not
        raise ValueError(f"{shown(word)} is no number")
    value = float(word)
    if not abs(value) < LARGEST_NUMBER:
        raise ValueError(f"the number {shown(word)} is not finite, or too large")
    return value


def origin(element: ElementTree.Element) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Position [m] and quaternion (wxyz) of an element's <origin>, the identity when it has none."""
    found = element.find("origin")
    x, y, z = (0.0, 0.0, 0.0) if found is None or "xyz" not in found.attrib else numbers(found, "xyz")
    rpy = (0.0, 0.0, 0.0) if found is None or "rpy" not in found.attrib else numbers(found, "rpy")
    if max(abs(x), abs(y), abs(z)) > FARTHEST:
        raise ValueError(f"an <origin> is farther away than {FARTHEST:g} m")
    return (x, y, z), quaternion_from_rpy(*rpy)


def lengths(geometry: ElementTree.Element, what: str, least: float) -> tuple[float, ...]:
    """Lengths of a primitive in the order of `SIZES`: three of a box, a radius, or a radius and a length [m].

    Args:
        geometry: <box>, <sphere>, <cylinder> or <capsule>.
        what: it is for, for messages, such as "collision".
        least: smallest length [m].
    """
    count = 3 if geometry.tag == "box" else 1
    found = tuple(value for key in SIZES[geometry.tag] for value in numbers(geometry, key, count))
    if min(found) <= 0:
        raise ValueError(f"a {what} <{geometry.tag}> has a size that is not positive")
    if not (min(found) >= least and max(found) <= LONGEST):
        raise ValueError(f"a {what} <{geometry.tag}> has a size that is not from {least:g} to {LONGEST:g} m")
    return found


def check_inertial(link: ElementTree.Element) -> None:
    """Refuses mass and inertia that no body has. Zeros for all of them stand for none, as <inertial> left out does."""
    found = link.find("inertial")
    if found is None:
        return
    name = shown(link.get("name"))
    try:
        origin(found)
        (mass,) = numbers(child(found, "mass"), "value", 1)
        inertia = child(found, "inertia")
        xx, xy, xz, yy, yz, zz = (numbers(inertia, key, 1)[0] for key in INERTIA_NAMES)
    except ValueError as error:
        raise ValueError(f"link {name}: {error}") from error
    if not any((mass, xx, xy, xz, yy, yz, zz)):
        return
    if not MASSES[0] <= mass <= MASSES[1]:
        raise ValueError(f"link {name} has a mass of {mass:g} kg, and has to have {MASSES[0]:g} to {MASSES[1]:g} kg")
    least, middle, most = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if not (least >= SMALLEST_MOMENT and least + middle >= (1 - SLACK) * most):
        raise ValueError(f"link {name} has an <inertia> that no body has about its centre of mass [kg m^2]")


def check_visual(visual: ElementTree.Element) -> None:
    """Refuses what is seen of a link if it has no place, no size, or an odd material."""
    origin(visual)
    known = [element for element in child(visual, "geometry") if element.tag in (*SIZES, "mesh")]
    if not known:
        raise ValueError(f"the <geometry> of a <visual> has none of {', '.join(SIZES)}, mesh")
    for geometry in known:
        if geometry.tag != "mesh":
            lengths(geometry, "visual", FINEST)
        elif not text(geometry, "filename"):
            raise ValueError("a <mesh> names no file")
        elif "scale" in geometry.attrib and not all(numbers(geometry, "scale")):
            raise ValueError("the scale of a <mesh> is zero")
    material = visual.find("material")
    if material is not None:
        check_material(material)


def check_material(material: ElementTree.Element) -> None:
    """Refuses a material without a name, or with a colour that is none."""
    text(material, "name")
    for color in material.findall("color"):
        numbers(color, "rgba", 4)
    for texture in material.findall("texture"):
        text(texture, "filename")
