"""Make the mirror image of a robot folder: `python -m dora.robot.mirror robots/diana7_hit robots/diana7_hit_left`.

The image is that in the plane y = 0 of the base. With S = diag(1, -1, 1) in the frame of every link, a transform T
becomes S T S: a point (x, y, z) becomes (x, -y, z), the angles (roll, pitch, yaw) become (-roll, pitch, -yaw), the axis
of a rotation, which is a pseudovector, becomes (-x, y, -z), that of a slide (x, -y, z), and the products of inertia
with y change their sign. Joint angles keep their meaning, so limits, gains and postures stay as they are: with the same
angles every frame of the image is S T S of the original's. "Right" and "left" are exchanged in names.
"""

from __future__ import annotations

import os
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import tomli_w
import trimesh

from dora.containers import MOST_FACES, check_container, check_triangles
from dora.errors import InputError, command
from dora.files import make_folder, renew_checksums, write_bytes
from dora.reading import read_text, read_toml
from dora.robot.build import urdf_number
from dora.robot.loading import NAME, ROBOT_FILE, load_robot
from dora.robot.urdf import MOVING

POINT, ANGLES, AXIS = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (-1.0, 1.0, -1.0)
"""What the components of a point, of roll, pitch and yaw, and of an axis of rotation are multiplied by."""
PRODUCTS = ("ixy", "iyz")
"""Elements of an inertia tensor that change their sign."""
SIDES = {"Right": "Left", "Left": "Right", "right": "left", "left": "right", "RIGHT": "LEFT", "LEFT": "RIGHT"}
"""Words in names that are exchanged."""
HEADER = "Generated from robots/{name} by `python -m dora.robot.mirror`: edit that, not this."
"""First comment of the generated files."""
SOURCE = """# Where this comes from

The mirror image of [{name}](../{name}/SOURCE.md) in the plane y = 0 of its base, made by

    python -m dora.robot.mirror robots/{name} robots/{image}

Joint angles, limits, gains and postures are those of the original; frames, axes, inertias, shapes and meshes are
mirrored.
"""
"""Content of the image's SOURCE.md."""


def mirrored_name(text: str) -> str:
    """A name of the image: "Right_Thumb_0" becomes "Left_Thumb_0", and the other way round; "upright" stays."""
    return re.sub(f"(?<![a-z])(?:{'|'.join(SIDES)})|(?<=[a-z])(?:Right|Left)", lambda found: SIDES[found[0]], text)


def mirrored_urdf(text: str, name: str, source: str) -> str:
    """URDF of the image.

    Args:
        text: of the original.
        name: of the image.
        source: name of the original, for the first comment.

    Raises:
        InputError: a number cannot be read, or a mesh lies outside the folder.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"the URDF of {source!r} is no XML ({error}); correct it.") from error
    for joint in root.iter("joint"):
        if joint.get("type") in MOVING and joint.find("axis") is None:
            ET.SubElement(joint, "axis", xyz="1 0 0")  # what a missing one means
    slides = {axis for joint in root.iter("joint") if joint.get("type") == "prismatic" for axis in joint.iter("axis")}
    for element in root.iter():
        for key, value in element.attrib.items():
            if key in ("name", "link", "joint", "filename"):
                element.set(key, mirrored_name(value))
        if element.tag in ("origin", "axis", "inertia"):
            _mirror(element, source, POINT if element in slides or element.tag != "axis" else AXIS)
        if element.tag == "mesh" and _is_outside(element.get("filename", "")):
            raise InputError(
                f"the mesh {element.get('filename')} lies outside the folder of {source!r}; move it there."
            )
    root.set("name", name)
    ET.indent(root)
    body = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n<!-- {HEADER.format(name=source)} -->\n{body}\n'


def _is_outside(filename: str) -> bool:
    """Whether what a URDF names is an address, or no place within the folder of the URDF."""
    return ":" in filename or ".." in filename or Path(filename).is_absolute()


def _mirror(element: ET.Element, source: str, vector: tuple[float, float, float]) -> None:
    """Mirrors the numbers of an origin, an axis or an inertia; `vector` are the factors of its `xyz`."""
    try:
        if element.tag == "inertia":
            for key in PRODUCTS:
                element.set(key, urdf_number(-float(element.get(key, "0"))))
        for key, factors in (("xyz", vector), ("rpy", ANGLES)):
            if key in element.attrib:
                values = zip(element.attrib[key].split(), factors, strict=True)
                element.set(key, " ".join(urdf_number(float(value) * factor) for value, factor in values))
    except ValueError as error:
        raise InputError(f"the URDF of {source!r} has an <{element.tag}> that cannot be read ({error}).") from error


def mirrored_table(table: dict[str, Any], name: str) -> dict[str, Any]:
    """`robot.toml` of the image: other names, and the contact points of the fingers' pads mirrored."""
    image = _renamed(table, mirrored_name)
    image["name"] = name
    for finger, row in image["fingers"].items():
        try:
            row["pad"] = [float(value) * factor + 0.0 for value, factor in zip(row["pad"], POINT, strict=True)]
        except (TypeError, ValueError) as error:
            raise InputError(f"the pad of the finger {finger!r} has to be three numbers [m].") from error
    return image


def _renamed(value: Any, rename: Callable[[str], str]) -> Any:
    """A table with other names, as keys and as values."""
    if isinstance(value, dict):
        return {rename(key): _renamed(part, rename) for key, part in value.items()}
    if isinstance(value, list):
        return [_renamed(part, rename) for part in value]
    return rename(value) if isinstance(value, str) else value


def mirrored_mesh(scene: trimesh.Scene) -> trimesh.Scene:
    """Image of a mesh, with the transforms of its nodes in its vertices; its faces stay turned outwards."""
    image = trimesh.Scene()
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph.get(node)
        part = scene.geometry[name].copy()
        part.apply_transform(np.diag([*POINT, 1.0]) @ transform)
        image.add_geometry(part, node_name=str(node), geom_name=str(name))
    return image


def _mesh_image(path: Path) -> bytes:
    """The image of a mesh file as glTF.

    Raises:
        InputError: there is no such file, it is not binary glTF, it is damaged, or declares more than it can hold.
    """
    if path.suffix != ".glb" or not os.path.isfile(path):
        raise InputError(f"the mesh {path} is {'no .glb file' if os.path.isfile(path) else 'missing'}; put one there.")
    check_container(path)
    try:
        scene = trimesh.load_scene(path)
        faces = sum(len(scene.geometry[scene.graph[node][1]].faces) for node in scene.graph.nodes_geometry)
        image = mirrored_mesh(scene) if faces <= MOST_FACES else trimesh.Scene()
    except Exception as error:  # the reader raises whatever it meets in a damaged file
        raise InputError(
            f"the mesh {path} is no intact glTF ({type(error).__name__}: {error}); export it again."
        ) from error
    if faces > MOST_FACES:
        raise InputError(f"{path} has {faces} faces; reduce it to at most {MOST_FACES}.")
    if not image.geometry:
        raise InputError(f"the mesh {path} shows nothing; export it again.")
    for part in image.geometry.values():
        check_triangles(path, np.asarray(part.vertices), np.asarray(part.faces))
    return cast(bytes, image.export(file_type="glb", include_normals=True))


def write_mirrored(source: Path, target: Path) -> list[Path]:
    """Write the image of a robot folder; its name is that of the new folder.

    Args:
        source: folder with `robot.toml`, a URDF and the meshes that it names, as .glb; or the name of a robot.
        target: folder of the image; files that are there already are replaced.

    Returns:
        The written files.

    Raises:
        InputError: the robot or one of its meshes cannot be read, or the folder cannot be written.
    """
    robot = load_robot(source)
    if target.resolve() == robot.folder:
        raise InputError(f"{target} is the robot itself; give the folder of its image another name.")
    if not NAME.fullmatch(target.name):
        raise InputError(f"{target} has a name that no robot may have; use letters, digits, spaces and _ . + -")
    written: dict[Path, bytes] = {}
    text = read_text(robot.urdf, "URDF")
    urdf = mirrored_urdf(text, target.name, robot.name)
    written[target / mirrored_name(robot.urdf.name)] = urdf.encode()
    table = mirrored_table(read_toml(robot.folder / ROBOT_FILE, "robot"), target.name)
    written[target / ROBOT_FILE] = f"# {HEADER.format(name=robot.name)}\n{tomli_w.dumps(table)}".encode()
    written[target / "SOURCE.md"] = SOURCE.format(name=robot.name, image=target.name).encode()
    for name in sorted({mesh.get("filename", "") for mesh in ET.fromstring(text).iter("mesh")}):
        written[target / mirrored_name(name)] = _mesh_image(robot.folder / name)
    for path, content in written.items():
        make_folder(path.parent)
        write_bytes(path, content)
    renew_checksums(written)
    return list(written)


@command
def main() -> None:
    """Write the image of the first folder that is named on the command line into the second one."""
    if len(sys.argv) != 3:
        raise SystemExit("usage: python -m dora.robot.mirror FOLDER FOLDER_OF_THE_IMAGE")
    for path in write_mirrored(Path(sys.argv[1]), Path(sys.argv[2])):
        print(path, path.stat().st_size)


if __name__ == "__main__":
    sys.exit(main())
