"""Agreement of votes with measured regions: confusion matrix, recall and balanced accuracy."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

FEWEST_GRASPS = 10
"""Smallest number of grasps of a region that counts in the balanced accuracy."""
DOMINANT_SHARE = 2 / 3
"""Smallest share of the contact force on one region that makes it the dominant one [1]."""


@dataclass(frozen=True, eq=False)
class Confusion:
    """Confusion matrix of the votes of g grasps against the measured regions.

    Attributes:
        names: names of the l regions.
        counts: (l, l + 1) number of grasps by measured region (row) and voted region (column); last column: no contact.
    """

    names: tuple[str, ...]
    counts: Int[Tensor, "l columns"]

    @classmethod
    def of(cls, names: tuple[str, ...], voted: Int[Tensor, " g"], measured: Int[Tensor, " g"]) -> Confusion:
        """Count votes against measured regions.

        Args:
            names: names of the l regions.
            voted: (g,) indices into `names`, -1 for no contact.
            measured: (g,) indices into `names`.
        """
        columns = len(names) + 1
        cells = measured * columns + torch.where(voted < 0, len(names), voted)
        return cls(names, torch.bincount(cells, minlength=len(names) * columns).view(len(names), columns))

    @property
    def grasps(self) -> Int[Tensor, " l"]:
        """(l,) number of grasps by measured region."""
        return self.counts.sum(1)

    @property
    def recall(self) -> dict[str, float]:
        """Share of the grasps of each region whose vote names it; regions without grasps are left out."""
        right, grasps = self.counts.diagonal().tolist(), self.grasps.tolist()
        return {name: r / n for name, r, n in zip(self.names, right, grasps, strict=True) if n}

    @property
    def balanced_accuracy(self) -> float | None:
        """Mean recall over the regions with at least `FEWEST_GRASPS` grasps; None if fewer than two have as many."""
        counted = [
            self.recall[name] for name, n in zip(self.names, self.grasps.tolist(), strict=True) if n >= FEWEST_GRASPS
        ]
        return sum(counted) / len(counted) if len(counted) > 1 else None


def clearly_dominant(force: Float[Tensor, "c l"]) -> Bool[Tensor, " c"]:
    """Whether one region carries at least `DOMINANT_SHARE` of a grasp's contact force; `force` per region [N]."""
    total = force.sum(1)
    return (total > 0) & (force.amax(1) >= DOMINANT_SHARE * total)
