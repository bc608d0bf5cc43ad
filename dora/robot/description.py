"""The description of a robot without a simulator: joints, fingers, postures, collision shapes, contact settings.

A robot is a folder with `robot.toml` and a URDF; `dora.robot.loading` reads it. Adding one needs no Python.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from dora.errors import InputError, shown
from dora.robot.shapes import Shape
from dora.robot.urdf import UrdfModel

MAX_COLLISION_BITS = 30
"""Number of bits of PhysX's collision word that a robot may use; the last two stay free for tasks."""

Array = TypeVar("Array", np.ndarray, torch.Tensor)


@dataclass(frozen=True, eq=False)
class JointGroup:
    """A group of joints that are controlled together; every array is float64 of shape (n,).

    Attributes:
        names: n names of joints.
        lower, upper: limits [rad].
        velocity: velocity limits [rad/s].
        effort: torque limits [N m].
        stiffness: stiffness of the drives [N m/rad].
        damping: damping of the drives [N m s/rad].
        armature: inertia added to the joints [kg m^2].
    """

    names: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    armature: np.ndarray

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class Finger:
    """One finger: its joints from the palm outwards, its links, and the contact point of its pad.

    `tip` is a fixed frame whose z axis points out of the fingertip; `pad` (3,) is a point in the frame of
    `distal` [m].
    """

    name: str
    joints: tuple[str, ...]
    proximal: str
    medial: str
    distal: str
    tip: str
    pad: np.ndarray

    @property
    def links(self) -> tuple[str, str, str]:
        """The links with collision shapes, from the palm outwards."""
        return self.proximal, self.medial, self.distal


@dataclass(frozen=True)
class Coupling:
    """A coupled joint: target of `follower` = `multiplier` [1] * target of `leader` + `offset` [rad].

    Joints are indices into the hand group.
    """

    follower: int
    leader: int
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class Posture:
    """Joint angles in the order of the joint groups: `arm` (n_arm,), `hand` (n_hand,) [rad]."""

    arm: np.ndarray
    hand: np.ndarray


@dataclass(frozen=True)
class Contact:
    """Contact settings of a link: friction and restitution [1], PhysX's contact and rest offset [m]."""

    friction: float
    restitution: float
    contact_offset: float
    rest_offset: float


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """A robot as data, shared by the simulator's robot, the grasp optimiser and the controllers.

    `shapes` and `contacts` are keyed by link; `ignored_pairs` are the link pairs that do not collide
    (alphabetical within a pair), all others do; `tip_radius` is that of the fingertips [m].
    """

    name: str
    folder: Path
    urdf: Path
    model: UrdfModel
    arm: JointGroup
    hand: JointGroup
    couplings: tuple[Coupling, ...]
    wrist_link: str
    palm_link: str
    tip_radius: float
    fingers: dict[str, Finger]
    postures: dict[str, Posture]
    shapes: dict[str, tuple[Shape, ...]]
    contacts: dict[str, Contact]
    ignored_pairs: frozenset[tuple[str, str]]

    @cached_property
    def hand_actuated(self) -> np.ndarray:
        """Indices (n_actuated,) of the hand joints with a drive of their own, ascending."""
        followers = {coupling.follower for coupling in self.couplings}
        return np.array([index for index in range(len(self.hand)) if index not in followers])

    @cached_property
    def _expansion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Per hand joint (n_hand,): index of its source among the actuated joints, multiplier [1], offset [rad]."""
        place = {int(joint): index for index, joint in enumerate(self.hand_actuated)}
        source = np.array([place.get(index, 0) for index in range(len(self.hand))])
        multiplier, offset = np.ones(len(self.hand)), np.zeros(len(self.hand))
        for coupling in self.couplings:
            source[coupling.follower] = place[coupling.leader]
            multiplier[coupling.follower], offset[coupling.follower] = coupling.multiplier, coupling.offset
        return source, multiplier, offset

    def expand_hand(self, actuated: Array) -> Array:
        """Targets of all hand joints (..., n_hand) from those of the actuated ones (..., n_actuated) [rad]."""
        source, multiplier, offset = self._expansion
        if isinstance(actuated, torch.Tensor):
            return actuated[..., source] * actuated.new_tensor(multiplier) + actuated.new_tensor(offset)
        return actuated[..., source] * multiplier + offset

    def reduce_hand(self, hand: Array) -> Array:
        """Targets of the actuated joints (..., n_actuated) from those of all hand joints (..., n_hand) [rad]."""
        return hand[..., self.hand_actuated]

    def posture(self, name: str) -> Posture:
        """The posture of this name.

        Raises:
            InputError: the robot has none.
        """
        if name not in self.postures:
            raise InputError(
                f"robot {self.name!r} has no posture {shown(name)}; add it to {self.folder / 'robot.toml'}, which has "
                f"{', '.join(self.postures) or 'none'}."
            )
        return self.postures[name]

    def collision_bits(self) -> dict[str, int]:
        """A bit mask per link such that two links collide exactly when their masks share no bit.

        This is the rule of word 2 of PhysX's filter data in SAPIEN. Each bit stands for one clique of a greedy
        clique cover of the graph of ignored pairs.

        Raises:
            InputError: more than 30 bits would be needed.
        """
        cliques = clique_cover(self.ignored_pairs)
        if len(cliques) > MAX_COLLISION_BITS:
            raise InputError(
                f"robot {self.name!r}: the ignored pairs need {len(cliques)} collision bits and PhysX has "
                f"{MAX_COLLISION_BITS}; ignore fewer pairs, or whole groups of links."
            )
        masks = dict.fromkeys(self.shapes, 0)
        for bit, clique in enumerate(cliques):
            for link in clique:
                masks[link] |= 1 << bit
        return masks


def clique_cover(pairs: frozenset[tuple[str, str]]) -> list[frozenset[str]]:
    """A clique cover of the graph with edges `pairs`: cliques that together contain exactly its edges.

    Greedy and deterministic: a clique starts from the first uncovered edge and grows by the vertex that covers the
    largest number of uncovered edges.
    """
    neighbours: dict[str, set[str]] = {}
    for a, b in pairs:
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    uncovered = set(pairs)
    cliques = []
    while uncovered:
        clique = set(min(uncovered))
        while candidates := sorted(set.intersection(*(neighbours[vertex] for vertex in clique))):
            gains = [sum((min(new, old), max(new, old)) in uncovered for old in clique) for new in candidates]
            if not max(gains):
                break
            clique.add(candidates[int(np.argmax(gains))])
        uncovered -= {(a, b) for a in clique for b in clique if a < b}
        cliques.append(frozenset(clique))
    return cliques
