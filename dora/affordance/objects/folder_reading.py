"""Reading an object's folder: `object.toml` and its meshes become an `AffordanceObject`, or are refused."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import trimesh
from jaxtyping import Float, Int

from dora.affordance.objects.affordance_object import (
    FRICTION,
    HOME,
    UPRIGHT,
    AffordanceObject,
    Piece,
    Placement,
    corners,
    support_height,
    surface_digest,
)
from dora.affordance.objects.importing import LARGEST, SMALLEST
from dora.affordance.objects.mesh_files import LABEL, read_ply
from dora.affordance.objects.surfaces.weighing import MASSES
from dora.containers import MOST_FACES
from dora.digests import check_file
from dora.errors import InputError, shown
from dora.reading import Table, TomlTables, check_size, read_toml
from dora.robot.shapes import Shape

OBJECT_FILE = "object.toml"
"""Name of the file of an object's folder that says what the object is."""
FORMAT = "dora-object 1"
"""Format and version of an object's folder."""
MOST_PIECES = 1000
"""Largest number of tables in a list [1]."""
MOST_CORNERS = 255
"""Largest number of vertices of a convex hull, which is PhysX's [1]."""
MOST_HULL_BYTES = 1_000_000
"""Size of the file of a convex hull above which it is not read [bytes]."""
MOST_FRICTION = 10.0
"""Largest coefficient of friction; rubber on rubber has 1 to 4 [1]."""
GYRATION = (1e-4, 10.0)
"""Range of the largest moment of inertia, as a share of mass times squared reach from the origin; a ring has 1 [1]."""
FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*\.ply")
"""Names of mesh files: plain, so that they lie in the folder itself."""
SIZES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2}
"""Numbers that give the size of each primitive, see `dora.robot.shapes.Shape`."""
UNIT = 1e-6
"""Largest deviation of a quaternion's norm from 1."""
SYMMETRY = 1e-9
"""Largest difference of mirrored entries of an inertia, and of what its moments may lack, as a share of the largest."""
KEYS = {
    "object": (
        ("format", "name", "mesh", "target", "mass", "inertia", "regions", "pieces"),
        ("solid", "friction", "placement", "rest", "start_posture"),
    ),
    "region": (("name", "grasp_class"), ()),
    "primitive": (("region", "shape", "position", "quaternion", "size"), ()),
    "hull": (("region", "mesh"), ()),
}
"""Required and optional keys of each kind of table."""
RESERVED = ("joints", "links")
"""Keys kept for objects of several bodies."""


def read_object_folder(folder: Path) -> AffordanceObject:
    """The object of a folder, with every number as it is written there (docs/objects.md has the format).

    Raises:
        InputError: a file is missing, damaged or too large, or its content does not fit; the file is named.
    """
    return _Reader(folder).object()


class _Reader:
    """Turns the tables of one object.toml into a checked object; every error names the file."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / OBJECT_FILE
        self.check = TomlTables(self.path, KEYS)
        self.fail = self.check.fail
        self.hulls: dict[str, trimesh.Trimesh] = {}

    def content(self) -> Table:
        """The tables of the file, with known keys alone."""
        if not os.path.isfile(self.path):
            raise InputError(f"{self.folder} has no {OBJECT_FILE}; give the folder of an object.")
        check_file(self.path)
        content = read_toml(self.path, "file about an object")
        for key in RESERVED:
            if key in content:
                raise self.fail(
                    f"{key!r} belongs into articulation.toml, which says what the object is mounted on; move it there."
                )
        self.check.keys(content, "object", "the file")
        if content["format"] != FORMAT:
            raise self.fail(f"the format is {shown(content['format'])}, not {FORMAT!r}; write the folder again.")
        if content["name"] != self.folder.name:
            raise self.fail(
                f"the name is {shown(content['name'])}, and the folder is {self.folder.name!r}; make them equal."
            )
        return content

    def object(self) -> AffordanceObject:
        """The whole object; InputError about the first thing that does not fit."""
        content = self.content()
        names, classes = self.regions(content["regions"])
        mesh, labels = self.surface(content["mesh"], names)
        mass = self.within(content["mass"], MASSES, "mass")
        reach = float(np.linalg.norm(corners(mesh), axis=1).max())
        rest = self.quaternion(content.get("rest", list(UPRIGHT)), "rest")
        return AffordanceObject(
            name=content["name"],
            mesh=mesh,
            face_labels=labels,
            labels=names,
            classes=classes,
            target=self.check.one_of(content["target"], names, "target"),
            solid=self.closed(content["solid"])[0] if "solid" in content else mesh,
            mass=mass,
            inertia=self.inertia(content["inertia"], mass * reach**2),
            pieces=self.pieces(content["pieces"], names),
            support=support_height(mesh, rest),
            rest=rest,
            digest=surface_digest(mesh, labels, names),
            friction=self.within(content.get("friction", FRICTION), (0.0, MOST_FRICTION), "friction"),
            placement=self.check.one_of(content.get("placement", "table"), get_args(Placement), "placement"),
            start_posture=self.check.text(content.get("start_posture", HOME), "start_posture"),
            folder=self.folder,
        )

    def rows(self, value: Any, where: str) -> list[Any]:
        if not isinstance(value, list) or not 0 < len(value) <= MOST_PIECES:
            raise self.fail(f"[[{where}]] must have at least one table, and at most {MOST_PIECES}.")
        return value

    def quaternion(self, value: Any, where: str) -> tuple[float, float, float, float]:
        """A unit quaternion (wxyz)."""
        w, x, y, z = self.check.numbers(value, 4, where)
        if not abs(math.sqrt(w * w + x * x + y * y + z * z) - 1) < UNIT:
            raise self.fail(f"{where} must be a quaternion (w, x, y, z) of norm 1.")
        return w, x, y, z

    def within(self, value: Any, bounds: tuple[float, float], where: str) -> float:
        """A positive number in a range."""
        number = self.check.positive(value, where)
        if not bounds[0] <= number <= bounds[1]:
            raise self.fail(f"{where} is {number:g}; it must be {bounds[0]:g} to {bounds[1]:g}.")
        return number

    def inertia(self, value: Any, scale: float) -> Float[np.ndarray, "3 3"]:
        """An inertia [kg m^2] that a body can have: symmetric, no principal moment above the sum of the others, and
        not far from `scale`, its mass times its squared reach [kg m^2]."""
        if not isinstance(value, list) or len(value) != 3:
            raise self.fail("inertia must be a list of 3 lists of 3 numbers.")
        found = np.array([self.check.numbers(row, 3, "each row of inertia") for row in value])
        slack = SYMMETRY * np.abs(found).max()
        if np.abs(found - found.T).max() > slack:
            raise self.fail("inertia must be symmetric.")
        least, middle, most = np.linalg.eigvalsh(found)
        if not (least > 0 and least + middle >= most - slack):
            raise self.fail("inertia belongs to no body: check that it is about the centre of mass, in kg m^2.")
        if not GYRATION[0] * scale <= most <= GYRATION[1] * scale:
            raise self.fail(
                f"inertia has the moment {most:g}, and a body of this mass and size has {GYRATION[0] * scale:.2g} to "
                f"{GYRATION[1] * scale:.2g}: check that it is in kg m^2."
            )
        return found

    def regions(self, value: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the regions and their grasp classes, in the order of the file."""
        names, classes = [], []
        for row in self.rows(value, "regions"):
            self.check.keys(row, "region", "a region")
            names.append(self.check.text(row["name"], "the name of a region"))
            classes.append(self.check.text(row["grasp_class"], f"grasp_class of {shown(row['name'])}"))
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise self.fail(f"two regions are named {twice!r}; rename one of them.")
        twice = next((name for name in classes if classes.count(name) > 1), None)
        if twice is not None:
            raise self.fail(f"two regions have the grasp_class {twice!r}; give each region its own.")
        return tuple(names), tuple(classes)

    def mesh(self, name: Any) -> tuple[trimesh.Trimesh, Int[np.ndarray, " f"] | None]:
        """A mesh of the folder and the labels of its faces, if it has any."""
        if not isinstance(name, str) or not FILE_NAME.fullmatch(name):
            raise self.fail(f"{shown(name)} is no name of a mesh; name a .ply file in the folder itself.")
        mesh, labels = read_ply(self.folder / name)
        if np.abs(mesh.vertices).max() > LARGEST:
            raise InputError(f"{self.folder / name} reaches farther than {LARGEST} m from its origin: use metres.")
        return mesh, labels

    def hull(self, name: Any) -> trimesh.Trimesh:
        """A convex mesh that PhysX can take; each file is read once."""
        if isinstance(name, str) and name in self.hulls:
            return self.hulls[name]
        path = self.folder / str(name)
        if isinstance(name, str) and FILE_NAME.fullmatch(name) and os.path.isfile(path):
            check_size(path, "convex hull", MOST_HULL_BYTES)
        hull, _ = self.mesh(name)
        if len(hull.vertices) > MOST_CORNERS:
            raise InputError(f"{path} has {len(hull.vertices)} vertices; a hull may have at most {MOST_CORNERS}.")
        if not hull.is_convex:
            raise InputError(f"{path} is not convex: cut it into convex pieces.")
        self.hulls[name] = hull
        return hull

    def closed(self, name: Any) -> tuple[trimesh.Trimesh, Int[np.ndarray, " f"] | None]:
        """A closed surface with outward faces."""
        mesh, labels = self.mesh(name)
        if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
            raise InputError(f"{self.folder / name} is no closed surface with outward faces: repair the mesh.")
        return mesh, labels

    def surface(self, name: Any, regions: tuple[str, ...]) -> tuple[trimesh.Trimesh, Int[np.ndarray, " f"]]:
        """The object's surface around its origin, with a region for every face and a face for every region."""
        mesh, labels = self.closed(name)
        if mesh.extents.max() < SMALLEST:
            raise InputError(f"{self.folder / name} is smaller than {SMALLEST} m: use metres.")
        if not ((mesh.bounds[0] < 0) & (mesh.bounds[1] > 0)).all():
            raise InputError(f"{self.folder / name} lies beside its origin: move the centre of mass there.")
        if labels is None:
            if len(regions) > 1:
                raise InputError(f"{self.folder / name} has no face property {LABEL!r}: add it, or keep one region.")
            labels = np.zeros(len(mesh.faces), np.int64)
        if labels.min() < 0 or labels.max() >= len(regions):
            raise InputError(f"{self.folder / name} has labels that are not in 0 to {len(regions) - 1}: correct them.")
        bare = sorted(set(range(len(regions))) - set(labels.tolist()))
        if bare:
            raise self.fail(f"the region {regions[bare[0]]!r} has no face in {name}; label some, or remove it.")
        return mesh, labels

    def pieces(self, value: Any, regions: tuple[str, ...]) -> tuple[Piece, ...]:
        """The convex collision shapes."""
        found = tuple(self.piece(row, regions, f"piece {i}") for i, row in enumerate(self.rows(value, "pieces")))
        faces = sum(len(piece.shape.faces) for piece in found if isinstance(piece.shape, trimesh.Trimesh))
        if faces > MOST_FACES:
            raise self.fail(f"the hulls of its pieces have {faces} faces; reduce them to at most {MOST_FACES}.")
        return found

    def piece(self, row: Any, regions: tuple[str, ...], where: str) -> Piece:
        """One collision shape: a primitive, or the file of a convex hull."""
        self.check.keys(row, "hull" if isinstance(row, dict) and "mesh" in row else "primitive", where)
        region = self.check.one_of(row["region"], regions, f"the region of {where}")
        if "mesh" in row:
            return Piece(region, self.hull(row["mesh"]))
        kind = self.check.one_of(row["shape"], tuple(SIZES), f"the shape of {where}")
        x, y, z = self.check.numbers(row["position"], 3, f"the position of {where}")
        size = self.check.numbers(row["size"], SIZES[kind], f"the size of {where}")
        if min(size) <= 0:
            raise self.fail(f"the size of {where} must be positive.")
        if math.hypot(x, y, z) + max(size) > LARGEST:
            raise self.fail(f"{where} reaches farther than {LARGEST} m from the origin: use metres.")
        return Piece(
            region, Shape(kind, (x, y, z), self.quaternion(row["quaternion"], f"the quaternion of {where}"), size)
        )
