"""Where objects start: standing on the table within a grid of places, at any yaw, where a candidate can be reached."""

from collections.abc import Callable
from math import pi

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.affordance.reach.feasibility_table import Grid
from dora.geometry.poses import Pose
from dora.geometry.rotations import quaternion_from_rotation_vector

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
    turn = torch.zeros_like(position)
    turn[..., 2] = 2 * pi * u[..., 2]
    quaternion = quaternion_from_rotation_vector(turn)
    able = reachable(position.flatten(0, 1), quaternion.flatten(0, 1)).any(-1).reshape(len(u), TRIES)
    chosen = torch.arange(len(u), device=u.device), able.float().argmax(-1)
    return position[chosen], quaternion[chosen]
