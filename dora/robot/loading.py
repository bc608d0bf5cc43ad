"""Search for robot folders, and checked reading of `robot.toml` into a `RobotDescription`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

import dora
from dora.digests import check_file, check_folder
from dora.errors import InputError, shown, suggestion
from dora.reading import Table, TomlTables, entries, read_toml
from dora.robot.description import Contact, Coupling, Finger, JointGroup, Posture, RobotDescription
from dora.robot.structure import faults
from dora.robot.urdf import UrdfModel, read_urdf

ROBOT_FILE = "robot.toml"
"""Name of the file that makes a folder a robot."""
SEARCH_VARIABLE = "DORA_ROBOTS"
"""Environment variable with further folders of robots, separated as in PATH."""

KEYS = {
    "robot.toml": (
        ("name", "urdf", "wrist_link", "palm_link", "tip_radius", "arm", "hand", "fingers", "postures", "contact"),
        ("coupling", "no_collision"),
    ),
    "joint group": (("joints", "stiffness", "damping", "armature"), ()),
    "coupling": (("follower", "leader", "multiplier", "offset"), ()),
    "finger": (("joints", "proximal", "medial", "distal", "tip", "pad"), ()),
    "posture": (("arm", "hand"), ()),
    "contact group": (("links", "friction", "restitution", "contact_offset", "rest_offset"), ()),
}
"""Required and optional keys of each kind of table."""

NAME = re.compile(r"\w[\w .+-]*")
"""Names of robots: plain, so that they can be names of folders."""
CONTACT = {
    "friction": (0.0, 10.0),
    "restitution": (0.0, 1.0),
    "contact_offset": (1e-6, 1.0),
    "rest_offset": (-1.0, 1.0),
}
"""Smallest and largest value of each setting of contacts, in the units of `Contact`."""


def robot_folders() -> dict[str, Path]:
    """Folder of every robot by name: those of the repository or the wheel, then those in `SEARCH_VARIABLE`."""
    package = Path(dora.__file__).parent
    own = package / "_robots"
    extra = [Path(part) for part in os.environ.get(SEARCH_VARIABLE, "").split(os.pathsep) if part]
    places = [own if own.is_dir() else package.parent / "robots", *extra]
    folders = [folder for place in places for folder in entries(place) if os.path.isfile(folder / ROBOT_FILE)]
    return {folder.name: folder for folder in folders}


def available_robots() -> list[str]:
    """Names that `load_robot` accepts, sorted."""
    return sorted(robot_folders())


def load_robot(name_or_folder: str | Path) -> RobotDescription:
    """The description of a robot, by its name or by the folder of its `robot.toml`; read once per process.

    Files that have checksums are compared each time.

    Raises:
        InputError: unknown robot, missing file, or a file whose content does not fit.
    """
    folders = robot_folders()
    folder = folders.get(str(name_or_folder), Path(name_or_folder))
    if not os.path.isfile(folder / ROBOT_FILE):
        hint = suggestion(name_or_folder, sorted(folders))
        raise InputError(f"unknown robot {str(name_or_folder)!r}: {hint}")
    check_folder(folder.resolve())
    return _load(folder.resolve())


@cache
def _load(folder: Path) -> RobotDescription:
    path = folder / ROBOT_FILE
    check_file(path)
    content = read_toml(path, "file about a robot")
    urdf = content.get("urdf", "robot.urdf")
    if not isinstance(urdf, str) or not urdf.isprintable() or not (folder / urdf).resolve().is_relative_to(folder):
        raise InputError(f"{path}: urdf is {shown(urdf)}; name a file in the folder of the robot.")
    return _Reader(path, read_urdf(folder / urdf)).robot(content)


class _Reader:
    """Reads the tables of one robot.toml into checked dataclasses; every error names the file."""

    def __init__(self, path: Path, model: UrdfModel) -> None:
        self.path, self.model = path, model
        self.check = TomlTables(path, KEYS)
        self.fail = self.check.fail

    def robot(self, content: Table) -> RobotDescription:
        """The whole description; InputError for the first value that does not fit."""
        self.check.keys(content, "robot.toml", "the file")
        arm, hand = self.group(content["arm"], "arm"), self.group(content["hand"], "hand")
        twice = set(arm.names) & set(hand.names)
        if twice:
            raise self.fail(f"joint {min(twice)!r} is both in arm and hand; keep it in one of them.")
        shapes = {link: shapes for link, shapes in self.model.shapes.items() if shapes}
        robot = RobotDescription(
            name=self.name(content["name"]),
            folder=self.path.parent,
            urdf=self.path.parent / content["urdf"],
            model=self.model,
            arm=arm,
            hand=hand,
            couplings=self.couplings(content.get("coupling", []), hand),
            wrist_link=self.link(content["wrist_link"]),
            palm_link=self.link(content["palm_link"]),
            tip_radius=self.check.positive(content["tip_radius"], "tip_radius"),
            fingers={
                n: self.finger(n, row, hand) for n, row in self.check.table(content["fingers"], "fingers").items()
            },
            postures={
                n: self.posture(n, row, arm, hand)
                for n, row in self.check.table(content["postures"], "postures").items()
            },
            shapes=shapes,
            contacts=self.contacts(content["contact"], shapes),
            ignored_pairs=self.pairs(content.get("no_collision", {}), shapes),
        )
        for fault in faults(robot):
            raise self.fail(fault)
        return robot

    def name(self, value: Any) -> str:
        name = self.check.text(value, "name", printable=True)
        if not NAME.fullmatch(name):
            raise self.fail(f"the name is {shown(name)}; use letters, digits, spaces and _ . + - after the first one.")
        return name

    def link(self, name: Any) -> str:
        if not isinstance(name, str) or name not in self.model.links:
            raise self.fail(f"the URDF has no link {shown(name)}; correct the name.")
        return name

    def array(self, value: Any, length: int, where: str) -> np.ndarray:
        """A float64 array of this length; a single number stands for all."""
        entries = value if isinstance(value, list) else [value] * length
        array = np.array(self.check.numbers(entries, length, where))
        array.flags.writeable = False
        return array

    def names(self, names: Any, where: str) -> tuple[str, ...]:
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names) or len(set(names)) != len(names):
            raise self.fail(f"{where} must be a list in which every name occurs once.")
        return tuple(names)

    def group(self, table: Any, name: str) -> JointGroup:
        """A joint group with limits from the URDF [rad, rad/s, N m] and gains from the table."""
        self.check.keys(table, "joint group", name)
        names = self.names(table["joints"], f"{name}.joints")
        for joint in names:
            if joint not in self.model.joints or not self.model.joints[joint].moves:
                raise self.fail(f"the URDF has no moving joint {joint!r}, which {name}.joints names.")
        joints = [self.model.joints[joint] for joint in names]
        limits = {
            key: self.array([getattr(joint, key) for joint in joints], len(names), f"{name} {key}")
            for key in ("lower", "upper", "velocity", "effort")
        }
        gains = {
            key: self.array(table[key], len(names), f"{name}.{key}") for key in ("stiffness", "damping", "armature")
        }
        for key in ("velocity", "effort"):
            if (limits[key] <= 0).any():
                raise self.fail(f"the {key} limits of {name} in the URDF must be positive.")
        for key, values in gains.items():
            if (values < 0).any():
                raise self.fail(f"{name}.{key} must not be negative.")
        return JointGroup(names=names, **limits, **gains)

    def couplings(self, rows: Any, hand: JointGroup) -> tuple[Coupling, ...]:
        """All couplings of the hand; InputError if a joint follows twice or leads while following."""
        if not isinstance(rows, list):
            raise self.fail("coupling must be a list of tables: write [[coupling]].")
        found = tuple(self.coupling(row, hand) for row in rows)
        followers = [coupling.follower for coupling in found]
        for coupling in found:
            name = hand.names[coupling.follower]
            if followers.count(coupling.follower) > 1:
                raise self.fail(f"joint {name!r} follows two leaders; keep one coupling.")
            if coupling.leader in followers:
                raise self.fail(f"the leader of {name!r} follows another joint; name that one as leader.")
        return found

    def coupling(self, table: Any, hand: JointGroup) -> Coupling:
        """One coupling, its joints as indices into the hand group."""
        self.check.keys(table, "coupling", "a coupling")
        for key in ("follower", "leader"):
            if not isinstance(table[key], str) or table[key] not in hand.names:
                raise self.fail(f"the {key} {shown(table[key])} of a coupling is not a joint of the hand.")
        factors = self.array([table["multiplier"], table["offset"]], 2, "a coupling's multiplier and offset")
        follower, leader = (hand.names.index(table[key]) for key in ("follower", "leader"))
        return Coupling(follower, leader, *factors.tolist())

    def finger(self, name: str, table: Any, hand: JointGroup) -> Finger:
        """One finger; `pad` is a point (3,) in its distal link's frame [m]."""
        self.check.keys(table, "finger", f"fingers.{name}")
        joints = self.names(table["joints"], f"fingers.{name}.joints")
        for joint in joints:
            if joint not in hand.names:
                raise self.fail(f"fingers.{name}: {joint!r} is not a joint of the hand.")
        links = {key: self.link(table[key]) for key in ("proximal", "medial", "distal", "tip")}
        return Finger(name, joints, **links, pad=self.array(table["pad"], 3, f"fingers.{name}.pad"))

    def posture(self, name: str, table: Any, arm: JointGroup, hand: JointGroup) -> Posture:
        """A named posture (n_arm,), (n_hand,) [rad] within the joint limits."""
        self.check.keys(table, "posture", f"postures.{name}")
        angles = {}
        for key, group in (("arm", arm), ("hand", hand)):
            angles[key] = self.array(table[key], len(group), f"postures.{name}.{key}")
            outside = (angles[key] < group.lower) | (angles[key] > group.upper)
            if outside.any():
                joint = group.names[int(np.argmax(outside))]
                raise self.fail(f"postures.{name} puts joint {joint!r} outside its limits.")
        return Posture(**angles)

    def contacts(self, groups: Any, shapes: Iterable[str]) -> dict[str, Contact]:
        """Contact settings by link; InputError if a link with shapes has none or two."""
        found: dict[str, Contact] = {}
        for name, table in self.check.table(groups, "contact").items():
            self.check.keys(table, "contact group", f"contact.{name}")
            contact = self.contact(table, f"contact.{name}")
            for link in map(self.link, self.names(table["links"], f"contact.{name}.links")):
                if link in found:
                    raise self.fail(f"link {link!r} is in two contact groups; keep it in one of them.")
                found[link] = contact
        missing = sorted(set(shapes) - set(found))
        if missing:
            raise self.fail(f"link {missing[0]!r} has collision shapes and is in no contact group; add it.")
        return found

    def contact(self, table: Table, where: str) -> Contact:
        """The settings of one group."""
        values = self.array([table[key] for key in CONTACT], len(CONTACT), where).tolist()
        for value, (key, (least, most)) in zip(values, CONTACT.items(), strict=True):
            if not least <= value <= most:
                raise self.fail(f"{where}.{key} is {value:g}; it must be from {least:g} to {most:g}.")
        contact = Contact(*values)
        if contact.rest_offset >= contact.contact_offset:
            raise self.fail(f"{where}.rest_offset must be below its contact_offset.")
        return contact

    def pairs(self, table: Any, shapes: Iterable[str]) -> frozenset[tuple[str, str]]:
        """Link pairs of `no_collision`; links joined by one joint, or by fixed joints, are added."""
        pairs = set()
        for link, others in self.check.table(table, "no_collision").items():
            for other in self.names(others, f"no_collision.{link}"):
                if link == other:
                    raise self.fail(f"no_collision.{link} names the link itself; remove it.")
                pairs.add((min(self.link(link), self.link(other)), max(link, other)))
        adjacent = {frozenset((joint.parent, joint.child)) for joint in self.model.joints.values()}
        known = sorted(shapes)
        pairs |= {(a, b) for a, b in combinations(known, 2) if frozenset((a, b)) in adjacent}
        stray = sorted(link for pair in pairs for link in pair if link not in known)
        if stray:
            raise self.fail(f"no_collision names {stray[0]!r}, which has no collision shapes; remove it.")
        return frozenset(pairs)
