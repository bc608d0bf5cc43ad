"""Write a robot's URDF from its parameter table: `python -m dora.robot.build robots/diana7_hit`.

The table (`parameters.yaml`) holds links, joints and, for hands of identical fingers, a finger template.
The output is standard URDF: a capsule becomes a cylinder and two spheres (`dora.robot.urdf` reads them back
as one capsule), and no joint carries `<mimic>`, because coupling is a matter of commanded targets
(`robot.toml`). Numbers are written with 12 digits, so equal tables give equal bytes.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from dora.digests import check_file
from dora.errors import InputError, command
from dora.files import renew_checksums, write_bytes
from dora.geometry.rotations import rpy_from_z_axis
from dora.reading import read_yaml

Row = Mapping[str, Any]
"""One row of the parameter table."""
INERTIA_NAMES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
"""Attributes of <inertia>, in the order of a row's `inertia` [kg m^2]."""
HEADER = "<!-- Generated from parameters.yaml by `python -m dora.robot.build`: edit that, not this. -->"
"""First comment of a generated URDF."""


def build_urdf(parameters: Row) -> str:
    """URDF text of a parameter table.

    Args:
        parameters: the content of `parameters.yaml`: lengths [m], angles [rad], masses [kg].

    Returns:
        The XML text, links and joints in the order of the table.

    Raises:
        InputError: a key is missing.
    """
    try:
        links, joints = _expand(parameters)
        lines = ['<?xml version="1.0"?>', HEADER, f'<robot name="{escape(parameters["name"])}">']
        for name, link in links.items():
            lines += _link_lines(name, link)
        for joint in joints:
            lines += _joint_lines(joint)
    except KeyError as error:
        raise InputError(f"parameters.yaml lacks the key {error.args[0]!r}; add it.") from error
    return "\n".join([*lines, "</robot>", ""])


def write_urdf(folder: Path) -> Path:
    """Write `folder`/robot.urdf from `folder`/parameters.yaml and return its path.

    Raises:
        InputError: the table is missing or incomplete.
    """
    table = folder / "parameters.yaml"
    if not os.path.isfile(table):
        raise InputError(f"{table} does not exist; give the folder of a robot that has a parameter table.")
    check_file(table)
    content = read_yaml(table, "parameter table")
    try:
        text = build_urdf(content)
    except (TypeError, ValueError, LookupError, AttributeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{table} has a value of the wrong type ({error}): correct it.") from error
    target = folder / "robot.urdf"
    write_bytes(target, text.encode())
    renew_checksums([target])
    return target


def _expand(parameters: Row) -> tuple[dict[str, Row], list[Row]]:
    """Links and joints with the finger template expanded for every finger."""
    links, joints = dict(parameters["links"]), list(parameters["joints"])
    template = parameters.get("fingers", {"instances": {}})
    for finger, own in template["instances"].items():

        def fill(text: str, finger: str = finger, tip: str = own["tip"]) -> str:
            return text.replace("{finger}", finger).replace("{tip}", tip)

        links |= {fill(name): link for name, link in template["links"].items()}
        links[own["tip"]] = {}
        for joint in template["joints"]:
            names = {key: fill(joint[key]) for key in ("name", "parent", "child")}
            origin = {key: joint.get(key, own[key]) for key in ("xyz", "rpy")}
            joints.append({**joint, **names, **origin})
    return links, joints


def _link_lines(name: str, link: Row) -> list[str]:
    """`<link>` with inertial, visual and collision elements; an empty row is a bare frame."""
    if not link:
        return [f'  <link name="{escape(name)}"/>']
    inertia = " ".join(f'{k}="{urdf_number(v)}"' for k, v in zip(INERTIA_NAMES, link["inertia"], strict=True))
    lines = [
        f'  <link name="{escape(name)}">',
        "    <inertial>",
        f"      {_origin(link['com'])}",
        f'      <mass value="{urdf_number(link["mass"])}"/>',
        f"      <inertia {inertia}/>",
        "    </inertial>",
        f'    <visual><geometry><mesh filename="meshes/{escape(link["mesh"])}"/></geometry></visual>',
    ]
    for shape in link.get("shapes", ()):
        for origin, geometry in _SHAPES[shape["kind"]](shape):
            lines.append(f"    <collision>{origin}<geometry>{geometry}</geometry></collision>")
    return [*lines, "  </link>"]


def _joint_lines(joint: Row) -> list[str]:
    """`<joint>`: revolute when the row has limits, fixed otherwise."""
    kind = "revolute" if "lower" in joint else "fixed"
    lines = [
        f'  <joint name="{escape(joint["name"])}" type="{kind}">',
        f'    <parent link="{escape(joint["parent"])}"/>',
        f'    <child link="{escape(joint["child"])}"/>',
        f"    {_origin(joint['xyz'], joint['rpy'])}",
    ]
    if kind == "revolute":
        limits = " ".join(f'{k}="{urdf_number(joint[k])}"' for k in ("lower", "upper", "velocity", "effort"))
        lines += [f'    <axis xyz="{_vector(joint["axis"])}"/>', f"    <limit {limits}/>"]
    return [*lines, "  </joint>"]


def _box(shape: Row) -> list[tuple[str, str]]:
    return [(_origin(shape["center"]), f'<box size="{_vector(shape["size"])}"/>')]


def _sphere(shape: Row) -> list[tuple[str, str]]:
    return [(_origin(shape["center"]), f'<sphere radius="{urdf_number(shape["radius"])}"/>')]


def _cylinder(shape: Row) -> list[tuple[str, str]]:
    start, end = shape["p0"], shape["p1"]
    center = [(a + b) / 2 for a, b in zip(start, end, strict=True)]
    rpy = rpy_from_z_axis([b - a for a, b in zip(start, end, strict=True)])
    size = f'radius="{urdf_number(shape["radius"])}" length="{urdf_number(math.dist(start, end))}"'
    return [(_origin(center, rpy), f"<cylinder {size}/>")]


def _capsule(shape: Row) -> list[tuple[str, str]]:
    ball = f'<sphere radius="{urdf_number(shape["radius"])}"/>'
    return [*_cylinder(shape), (_origin(shape["p0"]), ball), (_origin(shape["p1"]), ball)]


_SHAPES = {"box": _box, "sphere": _sphere, "cylinder": _cylinder, "capsule": _capsule}
"""Functions that write each kind of shape as pairs of <origin> and geometry."""


def _origin(xyz: Sequence[int | float], rpy: Sequence[int | float] = (0.0, 0.0, 0.0)) -> str:
    return f'<origin xyz="{_vector(xyz)}" rpy="{_vector(rpy)}"/>'


def _vector(values: Iterable[int | float]) -> str:
    return " ".join(map(urdf_number, values))


def urdf_number(value: int | float) -> str:
    """Shortest text with 12 significant digits, without negative zero."""
    return f"{float(value) + 0.0:.12g}"


@command
def main() -> None:
    """Build the URDF of every folder named on the command line."""
    if len(sys.argv) < 2:
        raise SystemExit("usage: python -m dora.robot.build FOLDER [FOLDER ...]")
    for folder in sys.argv[1:]:
        print(write_urdf(Path(folder)))


if __name__ == "__main__":
    sys.exit(main())
