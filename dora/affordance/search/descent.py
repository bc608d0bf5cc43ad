"""Descent of many candidates on the grasp energy by Adam (D. Kingma and J. Ba, 2015)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.search.energies import RAMPED, GraspEnergy
from dora.geometry.rotations import matrix_from_rotation_vector

MEAN_DECAY, SQUARE_DECAY = 0.9, 0.98
"""Adam's decay rates of the first and the second moment [1]."""
ADAM_EPSILON = 1e-8
"""Adam's epsilon, added to the root of the second moment."""


@dataclass
class Rows:
    """A batch of c candidates under search.

    Attributes:
        wrist: (c, 4, 4) wrist poses in the object frame [m].
        joints: (c, a) actuated hand joints [rad].
        contacts: (c, k) indices of contact points.
        mean, square: (c, 6 + a) Adam's first and second moments.
        total: (c,) energy at the last evaluation.
        overlap: (c,) sum of the terms `RAMPED` at the last evaluation [m].
    """

    wrist: Tensor
    joints: Tensor
    contacts: Tensor
    mean: Tensor
    square: Tensor
    total: Tensor
    overlap: Tensor

    @classmethod
    def begin(cls, wrist: Tensor, joints: Tensor, contacts: Tensor, total: Tensor) -> Rows:
        """Rows before their first step: moments and overlap are zero."""
        mean = joints.new_zeros(len(joints), 6 + joints.shape[1])
        return cls(wrist, joints, contacts, mean, torch.zeros_like(mean), total, torch.zeros_like(total))

    def __len__(self) -> int:
        return len(self.joints)

    def select(self, index: Tensor) -> Rows:
        """The rows of an index or a mask."""
        return Rows(*(getattr(self, part.name)[index] for part in fields(self)))

    def move(self, step: Float[Tensor, "c m"]) -> None:
        """Move in place by translation [m], rotation vector in the object frame and change of the joints [rad]."""
        self.wrist[:, :3, 3] += step[:, :3]
        self.wrist[:, :3, :3] = matrix_from_rotation_vector(step[:, 3:6]) @ self.wrist[:, :3, :3]
        self.joints += step[:, 6:]

    @staticmethod
    def join(parts: list[Rows]) -> Rows:
        """Rows of several parts, in their order."""
        return Rows(*(torch.cat([getattr(rows, part.name) for rows in parts]) for part in fields(Rows)))


class Schedule(NamedTuple):
    """Steps to take: number taken `before`; per step the factor on `RAMPED` and the share of the largest step."""

    before: int
    ramp: list[float]
    size: list[float]


class Descent:
    """Takes steps of Adam; rotations move along their tangent.

    Args:
        energy: the energy to minimise.
        largest: (6 + a,) largest steps of translation [m], rotation [rad] and joints [rad].
    """

    def __init__(self, energy: GraspEnergy, largest: Float[Tensor, " m"]) -> None:
        self.energy, self.largest = energy, largest

    def __call__(self, rows: Rows, schedule: Schedule) -> None:
        """Move rows in place; `total` and `overlap` become the values before the last step."""
        for step, (ramp, size) in enumerate(zip(schedule.ramp, schedule.size, strict=True), schedule.before + 1):
            found = self.energy(rows.wrist, rows.joints, rows.contacts, ramp)
            rows.total, rows.overlap = found.total, overlap(found.terms)
            gradient = torch.cat((found.wrist, found.joints), 1)
            rows.mean.lerp_(gradient, 1 - MEAN_DECAY)
            rows.square.lerp_(gradient.square(), 1 - SQUARE_DECAY)
            mean = rows.mean / (1 - MEAN_DECAY**step)
            root = (rows.square / (1 - SQUARE_DECAY**step)).sqrt_().add_(ADAM_EPSILON)
            rows.move(-size * self.largest * mean / root)


def overlap(terms: dict[str, Tensor]) -> Float[Tensor, " c"]:
    """Sum of the unweighted terms `RAMPED`, which must vanish in the end [m]."""
    return torch.stack([terms[name] for name in RAMPED if name in terms]).sum(0)
