"""Contacts between the parts of a hand and one body in one physics step."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sapien


@dataclass(frozen=True)
class HandContacts:
    """Contact points between hand and object.

    Attributes:
        part: (k,) index of the hand part of each point.
        force: (k,) magnitude of the impulse divided by the duration of the step [N].
        point: (k, 3) position in the world frame, or in that of `in_frame` [m].
        depth: largest penetration depth over all points [m]; 0 if there is none.
    """

    part: np.ndarray
    force: np.ndarray
    point: np.ndarray
    depth: float

    @property
    def in_contact(self) -> bool:
        """Whether any point carries a force."""
        return bool((self.force > 0).any())

    def by_part(self, parts: int) -> np.ndarray:
        """Sum (parts,) of the force magnitudes by hand part [N]."""
        return np.bincount(self.part, self.force, parts)

    def in_frame(self, frame: sapien.Pose) -> "HandContacts":
        """The same contacts with points in a frame of the given pose in the world."""
        matrix = frame.inv().to_transformation_matrix()
        return replace(self, point=self.point @ matrix[:3, :3].T + matrix[:3, 3])


class HandContactReader:
    """Reads the contacts between one body and a hand.

    Args:
        contacts: function that returns PhysX's contacts of the last step.
        body: the body.
        part_of: index of the hand part by `id` of a link's body.
        timestep: duration of a physics step [s].
    """

    def __init__(self, contacts: Callable[[], list], body: Any, part_of: Mapping[int, int], timestep: float):
        self._contacts, self._body, self._part_of, self._timestep = contacts, body, part_of, timestep

    def read(self) -> HandContacts:
        """Contacts of the last step, including points within the contact offset, which carry no force."""
        part, impulse, point, depth = [], [], [], 0.0
        for contact in self._contacts():
            first, second = contact.bodies
            if first is self._body:
                link = self._part_of.get(id(second))
            elif second is self._body:
                link = self._part_of.get(id(first))
            else:
                continue
            if link is None:
                continue
            for p in contact.points:
                depth = min(depth, p.separation)
                part.append(link)
                impulse.append(p.impulse)
                point.append(p.position)
        force = np.linalg.norm(np.reshape(impulse, (-1, 3)), axis=1) / self._timestep
        return HandContacts(np.array(part, np.int64), force, np.reshape(point, (-1, 3)), -depth)
