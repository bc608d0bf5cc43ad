"""Grasp candidates of one object: wrist poses, hand joints, contacts and grasp class, with their files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dora.affordance.maps.packed_maps import COUNT, PART, POINT, pack, unpack
from dora.affordance.maps.voting import HAND_PARTS
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.stored_candidates import TEXTS, check_stored
from dora.digests import digest_of
from dora.errors import InputError
from dora.files import read_tensors, write_tensors
from dora.reading import parse_json
from dora.robot import RobotDescription

FORMAT = "dora-grasps 1"
"""Format and version of a file of candidates."""
MAP_POINTS = "map_points"
"""Entry of a file's metadata with the number of points of its contact maps; files without maps have none."""
UNKNOWN = torch.empty(0)
"""Marks a tensor field that is not given; replaced by its default in `__post_init__`."""
DIGITS = 9
"""Number of decimals of lengths [m] and angles [rad] that enter a digest."""


@dataclass(frozen=True, eq=False)
class GraspCandidates:
    """C grasps of one object, all poses in the object frame.

    Attributes:
        object: name of the object.
        position: (c, 3) wrist origin [m].
        quaternion: (c, 4) wrist orientation, wxyz.
        approach: (c, 3) unit direction in which the wrist approaches the grasp.
        pregrasp: (c, hand) hand joints before closing [rad].
        grasp: (c, hand) commanded hand joints of the closed hand [rad]; beyond contact, so that the drives squeeze.
        grasp_class: c names such as "BodyGrasp" or "HandleGrasp".
        joints: (c, hand) hand joints at contact [rad]; `grasp` if not given.
        contacts: (c, k, 3) contact points of the closed hand on the object [m]; k = 0 if not given.
        contact_finger: (c, k) contact class of each: 0 no contact, 1 palm, 2 thumb, ... 6 pinky.
        contact_map: (c, p) contact semantic map of the hand at `joints`: contact class of each of the p points of the
            object's affordance map (`AffordanceMap.from_object`); p = 0 if not given.
        energy: (c,) unweighted value per name of an energy term.
        penetration: (c,) penetration depth of hand and object at `joints` [m]; nan = not measured.
        self_penetration: (c,) penetration depth between links of the hand at `joints` [m]; nan = not measured.
        valid: (c,) whether the grasp passed its validation; true if not given.
        score: (c,) share of simulated executions that succeeded [1]; nan = not ranked.
        digest: digest of the object's geometry and labels; "" = unknown.
        robot: name of the robot; "" = unknown.
        robot_digest: `hand_digest` of the robot; "" = unknown.
        settings: settings of search, grasp test and ranking, as text.

    Raises:
        InputError: no candidate, fields of different lengths, a pose or joint that is not finite, or a contact map with
            a class that is not 0 to 6.
    """

    object: str
    position: Float[Tensor, "c 3"]
    quaternion: Float[Tensor, "c 4"]
    approach: Float[Tensor, "c 3"]
    pregrasp: Float[Tensor, "c hand"]
    grasp: Float[Tensor, "c hand"]
    grasp_class: tuple[str, ...]
    joints: Float[Tensor, "c hand"] = UNKNOWN
    contacts: Float[Tensor, "c k 3"] = UNKNOWN
    contact_finger: Int[Tensor, "c k"] = UNKNOWN
    contact_map: UInt8[Tensor, "c p"] = UNKNOWN
    energy: dict[str, Float[Tensor, " c"]] = field(default_factory=dict)
    penetration: Float[Tensor, " c"] = UNKNOWN
    self_penetration: Float[Tensor, " c"] = UNKNOWN
    valid: Bool[Tensor, " c"] = UNKNOWN
    score: Float[Tensor, " c"] = UNKNOWN
    digest: str = ""
    robot: str = ""
    robot_digest: str = ""
    settings: str = ""

    def __post_init__(self) -> None:
        count = len(self)
        if count == 0:
            raise InputError(f"there is no grasp candidate for {self.object!r}; generate some first")
        device = self.position.device
        missing = torch.full((count,), torch.nan, device=device)
        defaults = {
            "joints": self.grasp,
            "contacts": torch.zeros(count, 0, 3, device=device),
            "contact_finger": torch.zeros(count, 0, dtype=torch.long, device=device),
            "contact_map": torch.zeros(count, 0, dtype=torch.uint8, device=device),
            "penetration": missing,
            "self_penetration": missing,
            "valid": torch.ones(count, dtype=torch.bool, device=device),
            "score": missing,
        }
        for name, value in defaults.items():
            if getattr(self, name) is UNKNOWN:
                object.__setattr__(self, name, value)
        for name, value in self.tensors().items():
            if len(value) != count:
                raise InputError(f"candidates of {self.object!r}: {name} has {len(value)} rows, not {count}")
            if name in FINITE and not torch.isfinite(value).all():
                raise InputError(f"candidates of {self.object!r}: {name} holds a value that is not finite")
        if bool((self.contact_map > HAND_PARTS).any()):
            raise InputError(f"candidates of {self.object!r}: contact_map holds a class that is not 0 to {HAND_PARTS}")

    @property
    def ranking_steps(self) -> int | None:
        """Control steps that were simulated to rank the set, as its settings say; None if they do not."""
        try:
            made = parse_json(self.settings or "{}", "the settings of candidates")
        except InputError:
            return None
        steps = made.get("ranking_steps") if isinstance(made, dict) else None
        return steps if type(steps) is int else None

    def __len__(self) -> int:
        return len(self.grasp_class)

    def tensors(self) -> dict[str, Tensor]:
        """Every tensor by its name; energies as "energy/<term>"."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in own.items() if isinstance(value, Tensor)} | {
            f"energy/{name}": value for name, value in self.energy.items()
        }

    def with_tensors(self, tensors: dict[str, Tensor], grasp_class: tuple[str, ...]) -> GraspCandidates:
        """A copy with other tensors, named as in `tensors`; object, robot and settings stay."""
        own, energy = _split_energy(tensors)
        return replace(self, grasp_class=grasp_class, energy=energy, **own)

    def to(self, device: torch.device | str) -> GraspCandidates:
        """The same candidates on another device."""
        return self.with_tensors({k: v.to(device) for k, v in self.tensors().items()}, self.grasp_class)

    def select(self, rows: Tensor | Sequence[int] | slice) -> GraspCandidates:
        """The candidates of a mask (c,) or of indices, in that order.

        Raises:
            InputError: if none is left.
        """
        index = torch.arange(len(self))[rows.cpu() if isinstance(rows, Tensor) else rows]
        classes = tuple(self.grasp_class[i] for i in index.tolist())
        return self.with_tensors({k: v[index.to(v.device)] for k, v in self.tensors().items()}, classes)

    def of_class(self, *names: str) -> Bool[Tensor, " c"]:
        """Mask of the candidates of the given grasp classes."""
        return torch.tensor([name in names for name in self.grasp_class], device=self.position.device)

    def counts(self) -> dict[str, int]:
        """Number of candidates per grasp class, most frequent first."""
        return dict(Counter(self.grasp_class).most_common())

    def save(self, path: Path | str) -> None:
        """Write a safetensors file, atomically; of contact maps, only the points that are touched.

        Raises:
            InputError: it cannot be written.
        """
        names = sorted(set(self.grasp_class))
        index = torch.tensor([names.index(name) for name in self.grasp_class])
        metadata: dict[str, Any] = {name: getattr(self, name) for name in TEXTS} | {"classes": names}
        tensors = self.tensors() | {"grasp_class": index}
        maps = tensors.pop("contact_map")
        if points := maps.shape[1]:
            tensors, metadata = tensors | pack(maps), metadata | {MAP_POINTS: points}
        write_tensors(Path(path), FORMAT, tensors, metadata)

    @classmethod
    def load(
        cls, path: Path | str, object: AffordanceObject | None = None, robot: RobotDescription | None = None
    ) -> GraspCandidates:
        """Read a file that `save` wrote and check that it was made for the given object and robot.

        Raises:
            InputError: no such file, damaged, of another format, or made for something else.
        """
        path = Path(path)
        tensors, metadata = read_tensors(path, FORMAT)
        points = metadata.pop(MAP_POINTS, 0)
        packed = {name: tensors.pop(name) for name in (COUNT, POINT, PART) if name in tensors}
        names = check_stored(path, tensors, metadata)
        if points or packed:
            tensors["contact_map"] = unpack(packed, len(names), points, str(path))
        own, energy = _split_energy(tensors)
        candidates = cls(grasp_class=names, energy=energy, **own, **metadata)
        candidates.check_fits(path, object, robot)
        return candidates

    def check_fits(
        self, what: Path | str, object: AffordanceObject | None, robot: RobotDescription | None, stored: bool = True
    ) -> None:
        """Refuse candidates of another object or robot.

        Args:
            what: that holds them, for the message.
            object: that they have to be of, if given.
            robot: that they have to be of, if given.
            stored: they say what they are of. Otherwise unknown digests are let pass, and another robot with the same
                hand.

        Raises:
            InputError: naming what differs.
        """
        again = "make it again with `dora grasps`"
        if object is not None and self.object != object.name:
            raise InputError(f"{what} holds grasps of {self.object!r}, not of {object.name!r}: give those of that one.")
        if object is not None and self.digest != object.digest and (stored or self.digest):
            raise InputError(f"{what} was made for another shape or labelling of {object.name!r}: {again}.")
        if robot is not None:
            self.check_joints(what, robot)
        if robot is None or (not stored and self.robot_digest in ("", hand_digest(robot))):
            return
        if self.robot != robot.name:
            of = f"{what} holds grasps for the robot {self.robot!r}, not {robot.name!r}"
            raise InputError(f"{of}: give those of that one (`dora grasps --robot {robot.name}` makes some).")
        if self.robot_digest != hand_digest(robot):
            raise InputError(f"{what} was made for another version of the hand of {robot.name!r}: {again}.")

    def check_joints(self, what: Path | str, robot: RobotDescription) -> None:
        """Refuse candidates of a hand with another number of joints; arguments as for `check_fits`.

        Raises:
            InputError: they are.
        """
        if self.grasp.shape[1] != len(robot.hand.names):
            joints = f"{self.grasp.shape[1]} joints of a hand, and {robot.name!r} has {len(robot.hand.names)}"
            raise InputError(f"{what} holds {joints}: give the grasps of that one.")


FINITE = ("position", "quaternion", "approach", "pregrasp", "grasp", "joints", "contacts")
"""Names of the fields in which NaN and infinity are refused."""


def _split_energy(tensors: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Plain fields, and the energies without their prefix."""
    prefix = "energy/"
    energy = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    return {k: v for k, v in tensors.items() if not k.startswith(prefix)}, energy


def concatenate(sets: Sequence[GraspCandidates]) -> GraspCandidates:
    """All candidates of several sets of one object and one robot; settings are those of the first.

    Sets with fewer contacts per candidate are padded with contact class 0; energies that a set lacks are nan. Contact
    maps are left out unless all sets have them.

    Raises:
        InputError: no set, or sets of different objects, robots, digests or numbers of points of their contact maps.
    """
    if not sets:
        raise InputError("there is no set of candidates to join; give at least one")
    first = sets[0]
    for name in ("object", "digest", "robot", "robot_digest"):
        values = {getattr(each, name) for each in sets}
        if len(values) > 1:
            raise InputError(f"candidates with different {name} cannot be joined: {', '.join(sorted(values))}")
    width = max(each.contacts.shape[1] for each in sets)
    points = {each.contact_map.shape[1] for each in sets}
    if len(points - {0}) > 1:
        raise InputError("candidates with contact maps over different numbers of points cannot be joined")
    tables = [_widened(each, width) | {"contact_map": each.contact_map[:, : min(points)]} for each in sets]
    names = {name: None for table in tables for name in table}
    joined = {
        name: torch.cat(
            [table.get(name, torch.full((len(each),), torch.nan)) for each, table in zip(sets, tables, strict=True)]
        )
        for name in names
    }
    return first.with_tensors(joined, tuple(name for each in sets for name in each.grasp_class))


def _widened(candidates: GraspCandidates, width: int) -> dict[str, Tensor]:
    """The tensors of candidates, padded to `width` contacts per candidate."""
    more = width - candidates.contacts.shape[1]
    contacts = torch.nn.functional.pad(candidates.contacts, (0, 0, 0, more))
    finger = torch.nn.functional.pad(candidates.contact_finger, (0, more))
    return candidates.tensors() | {"contacts": contacts, "contact_finger": finger}


def hand_digest(robot: RobotDescription) -> str:
    """sha256 of what a stored grasp depends on in the robot.

    These are the hand's joints, limits and couplings, and the tree and collision shapes of the links that the wrist
    carries. Gains and the arm do not enter.
    """
    joints = [joint for joint in robot.model.joints.values() if _carried(robot, joint.child)]
    links = sorted({robot.wrist_link} | {joint.child for joint in joints})
    tree = {
        joint.name: {
            "kind": joint.kind,
            "parent": joint.parent,
            "child": joint.child,
            "numbers": np.round([*joint.origin.ravel(), *joint.axis, joint.lower, joint.upper], DIGITS),
        }
        for joint in joints
    }
    shapes = {link: robot.shapes.get(link, ()) for link in links}
    return digest_of({"joints": tree, "shapes": shapes, "order": robot.hand.names, "couplings": robot.couplings})


def _carried(robot: RobotDescription, link: str) -> bool:
    """Whether the wrist link carries a link, directly or through others."""
    return any(joint.parent == robot.wrist_link for joint in robot.model.chain(link))
