"""How well a vote agrees with what was measured: confusion table and balanced accuracy."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

FEWEST = 10
"""Grasps that a region must hold to count in the balanced accuracy."""
CLEAR = 2 / 3
"""Share of the contact force from which on one region clearly is what a hand holds."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Votes of g grasps against the regions that they were measured to hold.

    Attributes:
        names: of the l regions.
        confusion: (l, l + 1) grasps by held region (row) and voted region (column); last column: no contact.
    """

    names: tuple[str, ...]
    confusion: Int[Tensor, "l columns"]

    @classmethod
    def of(cls, names: tuple[str, ...], voted: Int[Tensor, " g"], held: Int[Tensor, " g"]) -> Agreement:
        """Counts votes, indices into `names` or -1 for no contact, against what is held, indices into `names`."""
        columns = len(names) + 1
        cells = held * columns + torch.where(voted < 0, len(names), voted)
        return cls(names, torch.bincount(cells, minlength=len(names) * columns).view(len(names), columns))

    @property
    def grasps(self) -> Int[Tensor, " l"]:
        """Grasps that hold each region."""
        return self.confusion.sum(1)

    @property
    def recall(self) -> dict[str, float]:
        """Share of the grasps of each region for which the vote names it; regions that no grasp holds are left out."""
        right, grasps = self.confusion.diagonal().tolist(), self.grasps.tolist()
        return {name: r / n for name, r, n in zip(self.names, right, grasps, strict=True) if n}

    @property
    def balanced_accuracy(self) -> float | None:
        """Mean recall over the regions that at least `FEWEST` grasps hold; None if fewer than two are."""
        counted = [self.recall[name] for name, n in zip(self.names, self.grasps.tolist(), strict=True) if n >= FEWEST]
        return sum(counted) / len(counted) if len(counted) > 1 else None


def clearly_held(force: Float[Tensor, "c l"]) -> Bool[Tensor, " c"]:
    """Whether one region carries at least `CLEAR` of a grasp's force, from the force [N] on every region."""
    total = force.sum(1)
    return (total > 0) & (force.amax(1) >= CLEAR * total)
