"""Reward terms that several tasks share: pure functions of a snapshot, or makers of such functions."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.tasks.mdp.rewards import Term, closeness
from dora.tasks.mdp.snapshot import Snapshot, goal_error, lifted, opposed

ALPHA = 4.0
"""Spatial sensitivity of the affordance reward [1/m]."""
AT_CANDIDATE, NEAR_CANDIDATE = 0.01, 0.2
"""Distance of the wrist from a candidate that counts as none, and over which closeness falls to 0.1 [m]."""
TURN_WEIGHT = 0.1
"""Metres that one radian counts in that distance [m/rad]."""
OFF_TABLE = 0.02
"""Rise from which an object has left the table [m]."""

Value = Callable[[Any], Tensor]
"""What a `Term` evaluates: snapshot -> (n,)."""


def near_region(distance: Float[Tensor, "n 5"]) -> Float[Tensor, " n"]:
    """R_affordance = exp(-alpha sum_i d_i) with the distance d_i of each fingertip from the region [m], 0 inside."""
    return torch.exp(-ALPHA * distance.clamp(min=0).sum(-1))


def near_point(s: Snapshot, point: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """R_affordance as printed: exp(-alpha sum_i ||x_tip,i - p_afford||), for one point in the world frame [m]."""
    return torch.exp(-ALPHA * (s.tip_p - point[:, None]).norm(dim=-1).sum(-1))


def at_candidate(s: Snapshot, reached: Bool[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Closeness of the wrist to the pose that the candidate asks for; 1 where the candidate has done its work."""
    shift, turn = goal_error(s)
    near = closeness(shift.norm(dim=-1) + TURN_WEIGHT * turn.norm(dim=-1), AT_CANDIDATE, NEAR_CANDIDATE)
    return torch.where(reached, torch.ones_like(near), near)


def off_table(s: Snapshot) -> Bool[Tensor, " n"]:
    """The object has left the table."""
    return lifted(s) > OFF_TABLE


def grip(s: Snapshot) -> Float[Tensor, " n"]:
    """0.6 for the thumb against a finger, and 0.1 for each finger that touches."""
    return 0.6 * opposed(s).float() + 0.1 * s.touch[:, 1:5].sum(-1)


def thumb_and_finger(distance: Float[Tensor, "n 5"]) -> Float[Tensor, " n"]:
    """The larger of the thumb's distance and that of the nearest finger [m], 0 inside."""
    near = distance.clamp(min=0)
    return torch.maximum(near[:, 0], near[:, 1:].amin(-1))


def rise(s: Snapshot, height: float) -> Float[Tensor, " n"]:
    """Share of a height [m] by which the object has risen, saturating."""
    return (lifted(s) / height).clamp(0, 1)


def effort(s: Snapshot) -> Float[Tensor, " n"]:
    """Mean square of the action."""
    return s.action.square().mean(-1).clamp(max=1)


def change(s: Snapshot) -> Float[Tensor, " n"]:
    """Mean square of the action's change, over that of a change from -1 to 1."""
    return ((s.action - s.previous_action).square().mean(-1) / 4).clamp(max=1)


def overlap(free: float, limit: float) -> Value:
    """Term for overlap beyond `free`, in shares of `limit` [m]."""
    return lambda s: ((s.penetration - free) / limit).clamp(0, 1)


def penalties(free: float, limit: float) -> dict[str, Term[Any]]:
    """Penalty terms of every task; overlap up to `free` costs nothing, `limit` is that of an episode [m]."""
    return {
        "effort": Term(effort, -0.05, "penalty", doc="mean square of the action"),
        "change": Term(change, -0.4, "penalty", doc="mean square of the action's change"),
        "penetration": Term(overlap(free, limit), -1.0, "penalty", doc=f"overlap beyond {1000 * free:g} mm"),
    }


def paper_affordance(point: Callable[[Any], Float[Tensor, "n 3"]]) -> dict[str, Term[Any]]:
    """The printed R_affordance, to one point of the region [m]."""
    doc = "exp(-alpha sum ||p_tip - p_afford||)"
    return {"affordance": Term(lambda s: near_point(s, point(s)), 1.0, "affordance", True, doc)}


def paper_grasp(stages: int) -> dict[str, Term[Any]]:
    """The printed R_grasp during the first `stages` stages."""

    def value(s: Snapshot) -> Tensor:
        return torch.exp((s.wrist_p - s.goal_p)[:, 2].clamp(max=0)) * (s.stage < stages)

    return {"grasp": Term(value, 1.0, guided=True, doc="exp(z_current - z_candidate), z clipped at the candidate")}


def paper_lift(stages: int, height: float) -> dict[str, Term[Any]]:
    """The printed R_lift after the first `stages` stages, saturating at a height [m]."""

    def value(s: Snapshot) -> Tensor:
        return torch.exp(lifted(s).clamp(0, height) - height) * (s.stage >= stages)

    return {"lift": Term(value, 1.0, doc="exp(z - z_0), saturating")}


def paper_penalty() -> dict[str, Term[Any]]:
    """The printed R_penalty."""
    return {"penalty": Term(effort, -0.1, "penalty", doc="sum of action^2")}
