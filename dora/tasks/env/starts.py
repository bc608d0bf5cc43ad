"""Where objects start: standing on the table within a grid of places, and starts that a person chooses."""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.affordance.reach.feasibility_table import Grid
from dora.geometry.poses import Pose
from dora.geometry.rotations import quaternion_from_yaw, yaw_of

TRIES = 8
"""Starting poses that are drawn for an object that stands."""
STANDING_DRAWS = 3 * TRIES
"""Random numbers of one such start: x, y and yaw of each pose."""

Reachable = Callable[[Float[Tensor, "b 3"], Float[Tensor, "b 4"]], Bool[Tensor, "b c"]]
"""f_reach: which candidates can be carried out with objects at these world poses."""


def standing(u: Float[Tensor, "b d"], height: Float[Tensor, " b"], grid: Grid, reachable: Reachable) -> Pose:
    """World poses of objects that stand upright, where a candidate can be reached.

    Args:
        u: uniform random numbers in [0, 1), x, y and yaw of each of `TRIES` poses; the first that leaves a reachable
            candidate is taken, or the very first if none does.
        height: of the objects' origins [m].
        grid: area in which they stand.
        reachable: f_reach.
    """
    u = u.reshape(len(u), TRIES, 3)
    x, y = (c + w * (2 * u[..., k] - 1) for k, (c, w) in enumerate(zip(grid.centre, grid.spread, strict=True)))
    position = torch.stack([x, y, height[:, None].expand_as(x)], -1)
    quaternion = quaternion_from_yaw(2 * pi * u[..., 2])
    able = reachable(position.flatten(0, 1), quaternion.flatten(0, 1)).any(-1).reshape(len(u), TRIES)
    chosen = torch.arange(len(u), device=u.device), able.float().argmax(-1)
    return position[chosen], quaternion[chosen]


@dataclass(frozen=True)
class StartNumber:
    """A number of a start that a person can choose.

    Attributes:
        name, unit: what it is.
        low, high: its range, in `unit`.
    """

    name: str
    unit: str
    low: float
    high: float

    @property
    def free(self) -> bool:
        """Whether it can be chosen: not where its range is one value."""
        return self.high > self.low

    def share_of(self, value: float) -> float:
        """Share of the way from the lowest to the highest value; 0 where these are the same."""
        return (value - self.low) / (self.high - self.low) if self.free else 0.0


@dataclass(frozen=True)
class ChosenStarts:
    """How the numbers that a person chooses become the random numbers of a start, and the other way round.

    Attributes:
        numbers: k of them; each is given as its share of the way from the lowest to the highest value, 0 to 1.
        draws: shares (k,) -> the random numbers (d,) of a start as `Task.place` takes them.
        shares: random numbers (d,) of a start, and the pose of the object then (position [m], quaternion) -> (k,).
    """

    numbers: tuple[StartNumber, ...]
    draws: Callable[[Float[Tensor, " k"]], Float[Tensor, " d"]]
    shares: Callable[[Float[Tensor, " d"], Pose], Float[Tensor, " k"]]


def standing_starts(grid: Grid) -> ChosenStarts:
    """Place and yaw of an object that `standing` puts down."""
    names = [StartNumber(name, "m", c - w, c + w) for name, c, w in zip("xy", grid.centre, grid.spread, strict=True)]
    numbers = (*names, StartNumber("yaw", "rad", 0.0, 2 * pi))

    def shares(u: Tensor, pose: Pose) -> Tensor:
        place = [n.share_of(float(x)) for x, n in zip(pose[0], names, strict=False)]
        return torch.tensor([*place, float(yaw_of(pose[1]) / (2 * pi) % 1)]).clamp(0, 1)

    return ChosenStarts(numbers, lambda chosen: chosen.repeat(TRIES), shares)
