"""What an object is mounted on: links with convex shapes and hinges, such as the microwave around its handle."""

from __future__ import annotations

import functools
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dora.affordance.objects.affordance_object import AffordanceObject
from dora.configs import built
from dora.digests import check_file
from dora.errors import InputError, shown
from dora.reading import read_toml
from dora.robot.shapes import Shape

ARTICULATION_FILE = "articulation.toml"
"""Name of the file of an object's folder that says what the object is mounted on."""
FORMAT = "dora-articulation 1"
"""Format and version of that file."""
SIZES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2}
"""Numbers that give the size of each primitive, see `dora.robot.shapes.Shape`."""
MOST_LINKS, MOST_SHAPES = 20, 200
"""Largest number of links, and of shapes of one link [1]."""
LARGEST = 100.0
"""Largest length, mass, angle or coefficient of the file, in SI units."""
UNIT = 1e-6
"""Largest deviation of the norm of a quaternion or axis from 1."""


@dataclass(frozen=True)
class Hinge:
    """A revolute joint about an axis through the origin of its link. At 0 the link is as the file places it.

    While it moves, it resists with `damping` times its speed and with the constant torque `friction`; below
    `latch_angle` the constant torque `latch` pulls it shut besides.

    Attributes:
        axis: unit vector in the frame of the link; positive angles turn about it by the right hand.
        limits: lowest and highest angle [rad].
        damping: [N m s/rad].
        friction: [N m].
        latch: [N m].
        latch_angle: [rad].
    """

    axis: tuple[float, float, float]
    limits: tuple[float, float]
    damping: float = 0.0
    friction: float = 0.0
    latch: float = 0.0
    latch_angle: float = 0.0


@dataclass(frozen=True)
class LinkShape:
    """One convex primitive of a link, in the link's frame.

    Attributes:
        shape: "box", "sphere", "cylinder" or "capsule".
        position: of its centre [m].
        size: as of `dora.robot.shapes.Shape` [m].
        quaternion: of its axes, wxyz.
        colour: red, green, blue and opacity, 0 to 1; None for a shape that is not drawn.
    """

    shape: str
    position: tuple[float, float, float]
    size: tuple[float, ...]
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    colour: tuple[float, float, float, float] | None = (0.8, 0.8, 0.8, 1.0)

    @property
    def primitive(self) -> Shape:
        """The shape as a `Shape`."""
        return Shape(self.shape, self.position, self.quaternion, self.size)  # pyright: ignore[reportArgumentType]


@dataclass(frozen=True)
class MountLink:
    """One body; the first one of an articulation is fixed in the world.

    Attributes:
        name: unique.
        parent: name of an earlier link; "" for the first one.
        position, quaternion: of its frame in the parent's, with all hinges at 0 [m], wxyz.
        mass: [kg]; spread over the volume of its shapes.
        friction: coefficient of its surface.
        shapes: convex primitives; none for the link that carries the object, whose target region they are.
        hinge: how it moves against its parent; None if it is fixed to it.
        object: whether it is the object of the folder: its frame is the object's.
    """

    name: str
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    parent: str = ""
    mass: float = 1.0
    friction: float = 0.6
    shapes: tuple[LinkShape, ...] = ()
    hinge: Hinge | None = None
    object: bool = False


@dataclass(frozen=True)
class Mount:
    """What an object is mounted on; frames as in `MountLink`, the first link's frame being that of the whole.

    Attributes:
        links: parents before children, with one hinge and one link that carries the object among them.
    """

    links: tuple[MountLink, ...]

    @property
    def hinge_link(self) -> MountLink:
        """The link that moves."""
        return next(link for link in self.links if link.hinge is not None)

    @property
    def hinge(self) -> Hinge:
        """How it moves."""
        hinge = self.hinge_link.hinge
        assert hinge is not None
        return hinge

    @property
    def object_link(self) -> MountLink:
        """The link that carries the object."""
        return next(link for link in self.links if link.object)


def load_mount(obj: AffordanceObject) -> Mount:
    """What an object of a folder is mounted on.

    Raises:
        InputError: the folder says nothing of it, or its file is damaged or does not fit.
    """
    if obj.folder is None or not os.path.isfile(obj.folder / ARTICULATION_FILE):
        why = f"the object {obj.name!r} is not mounted on anything: its folder has no {ARTICULATION_FILE}"
        raise InputError(f"{why}: write one, or choose an object that has one.")
    path = obj.folder / ARTICULATION_FILE
    return _read(path, path.stat().st_mtime_ns)


@functools.cache
def _read(path: Path, time: int) -> Mount:
    """The mount of a file as it was at a time of its last change."""
    check_file(path)
    content = read_toml(path, "file about what an object is mounted on")
    if content.get("format") != FORMAT:
        found = shown(content.get("format"))
        raise InputError(f"{path}: the format is {found}, not {FORMAT!r}: write the file again.")
    values = {name: value for name, value in content.items() if name != "format"}
    mount = built(Mount, values, str(path))
    try:
        _check(mount)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return mount


def _check(mount: Mount) -> None:
    """Refuses links that cannot be built; the message does not name the file."""
    names = [link.name for link in mount.links]
    if not 2 <= len(names) <= MOST_LINKS:
        raise InputError(f"there are {len(names)} links: write 2 to {MOST_LINKS}.")
    if sum(link.hinge is not None for link in mount.links) != 1 or sum(link.object for link in mount.links) != 1:
        raise InputError("exactly one link must have a hinge, and one must be the object: correct the links.")
    for k, link in enumerate(mount.links):
        where = f"link {shown(link.name)}"
        if not link.name or names.count(link.name) > 1:
            raise InputError(f"{where} needs a name of its own: rename it.")
        if (k == 0) != (link.parent == "") or (k and link.parent not in names[:k]):
            raise InputError(f"{where} must have an earlier link as its parent, and the first link none: correct it.")
        if k == 0 and (link.hinge or link.object):
            raise InputError(f"{where} is fixed in the world: leave its hinge out, and let another one be the object.")
        if link.object == bool(link.shapes) or len(link.shapes) > MOST_SHAPES:
            shapes = f"1 to {MOST_SHAPES} shapes, and none if it is the object"
            raise InputError(f"{where} has {len(link.shapes)} shapes: give it {shapes}.")
        if link.object and link.parent != mount.hinge_link.name:
            raise InputError(f"{where} is the object: make the link with the hinge its parent.")
        _check_numbers(link, where)


def _check_numbers(link: MountLink, where: str) -> None:
    numbers = [*link.position, link.mass, link.friction]
    turns = [link.quaternion]
    for shape in link.shapes:
        if SIZES.get(shape.shape) != len(shape.size):
            raise InputError(f"{where} has a shape {shown(shape.shape)} with {len(shape.size)} sizes: correct it.")
        if min(shape.size) <= 0:
            raise InputError(f"{where} has a shape whose size is not positive: make it larger.")
        numbers += [*shape.position, *shape.size, *(shape.colour or ())]
        turns.append(shape.quaternion)
    if link.hinge is not None:
        h = link.hinge
        numbers += [*h.limits, h.damping, h.friction, h.latch, h.latch_angle]
        turns.append((*h.axis, 0.0))
        if h.limits[0] >= h.limits[1] or min(h.damping, h.friction, h.latch) < 0:
            wrong = "has a hinge whose limits are not ordered, or whose resistance is negative"
            raise InputError(f"{where} {wrong}: correct them.")
    if not all(abs(number) <= LARGEST for number in numbers):
        raise InputError(f"{where} has a number that is not finite or above {LARGEST:g}: correct it.")
    if not (link.mass > 0 and link.friction >= 0):
        raise InputError(f"{where} needs a positive mass and a friction that is not negative: correct them.")
    if not all(abs(math.sqrt(float(np.square(turn).sum())) - 1) < UNIT for turn in turns):
        raise InputError(f"{where} has a quaternion or axis whose norm is not 1: divide it by its norm.")
