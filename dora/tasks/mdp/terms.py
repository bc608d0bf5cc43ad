"""Reward terms that several tasks share: pure functions of a snapshot, or makers of such functions."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.tasks.mdp.config import TaskConfig
from dora.tasks.mdp.quantities import goal_error, lifted, opposed
from dora.tasks.mdp.rewards import Term, tolerance
from dora.tasks.mdp.snapshot import Snapshot

ALPHA = 4.0
"""Spatial sensitivity of the affordance reward [1/m]."""
AT_CANDIDATE, BESIDE_CANDIDATE = 0.01, 0.2
"""Distance of the wrist from a candidate that counts as none, and over which closeness falls to 0.1 [m]."""
TURN_WEIGHT = 0.1
"""Metres that one radian counts in that distance [m/rad]."""

Value = Callable[[Any], Tensor]
"""What a `Term` evaluates: snapshot -> (n,)."""


def near_region(distance: Float[Tensor, "n fingers"]) -> Float[Tensor, " n"]:
    """R_affordance = exp(-alpha sum_i d_i) with the distance d_i of each fingertip from the region [m], 0 inside."""
    return torch.exp(-ALPHA * distance.clamp(min=0).sum(-1))


def near_point(s: Snapshot, point: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """R_affordance as printed: exp(-alpha sum_i ||x_tip,i - p_afford||), for one point in the world frame [m]."""
    return torch.exp(-ALPHA * (s.hand.tip_p - point[:, None]).norm(dim=-1).sum(-1))


def at_candidate(s: Snapshot, reached: Bool[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Closeness of the wrist to the pose that the candidate asks for; 1 where the candidate has done its work."""
    shift, turn = goal_error(s)
    distance = shift.norm(dim=-1) + TURN_WEIGHT * turn.norm(dim=-1)
    near = tolerance(distance, (0.0, AT_CANDIDATE), BESIDE_CANDIDATE)
    return torch.where(reached, torch.ones_like(near), near)


def finger_contacts(s: Snapshot) -> Float[Tensor, " n"]:
    """0.6 for the thumb against a finger, and 0.1 for each finger that touches."""
    return 0.6 * opposed(s).float() + 0.1 * s.hand.touch[:, 1:-1].sum(-1)


def while_active(stage: int, value: Value) -> Value:
    """A term of one sub-task: 0 before its stage, `value` while it is active, 1 after it; the reward follows the
    active sub-task (paper, "Task-Specific Rewards") and no stage that is done takes anything away."""

    def term(s: Snapshot) -> Tensor:
        now = torch.where(s.stage == stage, value(s), 0.0)
        return torch.where(s.stage > stage, 1.0, now)

    return term


def effort(s: Snapshot) -> Float[Tensor, " n"]:
    """R_penalty as printed, sum_i action_i^2, over its largest value, the number of components."""
    return s.action.square().mean(-1).clamp(max=1)


def change(s: Snapshot) -> Float[Tensor, " n"]:
    """Mean square of the action's change, over that of a change from -1 to 1."""
    return ((s.action - s.previous_action).square().mean(-1) / 4).clamp(max=1)


def overlap(free: float, limit: float) -> Value:
    """Term for overlap beyond `free`, in shares of `limit` [m]; 0 where the simulator does not report overlap (NaN)."""
    return lambda s: ((s.penetration - free) / limit).clamp(0, 1).nan_to_num(0.0)


def without_overlap(s: Any, c: TaskConfig, left: float = 0.0) -> Float[Tensor, " n"]:
    """1 while no overlap of the episode was above `c.penetration_limit`; beyond it falls linearly over
    `c.overlap_grace` limits, or at once if that is 0, to `left`, which NaN gives, too."""
    limit, deepest = c.penetration_limit, s.max_penetration
    share = torch.zeros_like(deepest)
    if c.overlap_grace > 0:
        share = (1 - (deepest - limit) / (c.overlap_grace * limit)).clamp(min=0).nan_to_num(0.0)
    return torch.where(deepest <= limit, 1.0, left + (1 - left) * share)


def beyond_the_limit(c: TaskConfig) -> str:
    """What `without_overlap` does above the limit, for the end of a sentence about a term; nothing if all at once."""
    most = 1000 * c.penetration_limit * (1 + c.overlap_grace)
    return f", falling up to {most:g} mm" if c.overlap_grace > 0 else ""


def penalties(weights: Any, free: float, limit: float, most: float = 1.0) -> dict[str, Term[Any]]:
    """Penalty terms of every task.

    Args:
        weights: has `effort`, `change` and `penetration`.
        free: overlap that costs nothing [m].
        limit: largest overlap of an episode that counts as a success [m]; each costs `weights.penetration`.
        most: how many of these overlap costs at most.
    """
    return {
        "effort": Term(effort, weights.effort, "penalty", doc="sum of action^2, over the number of its components"),
        "change": Term(change, weights.change, "penalty", doc="a quarter of the mean square of the action's change"),
        "penetration": Term(
            overlap(free, most * limit), most * weights.penetration, "penalty",
            doc=f"overlap beyond {1000 * free:g} mm",
        ),
    }  # fmt: skip


def paper_affordance(point: Callable[[Any], Float[Tensor, "n 3"]]) -> dict[str, Term[Any]]:
    """The printed R_affordance, to one point of the region [m]."""
    doc = "exp(-alpha sum ||p_tip - p_afford||)"
    return {"affordance": Term(lambda s: near_point(s, point(s)), 1.0, "affordance", True, doc, region=True)}


def paper_grasp(stages: int) -> dict[str, Term[Any]]:
    """The printed R_grasp during the first `stages` stages."""

    def value(s: Snapshot) -> Tensor:
        return torch.exp((s.hand.wrist_p - s.goal.p)[:, 2].clamp(max=0)) * (s.stage < stages)

    return {"grasp": Term(value, 1.0, guided=True, doc="exp(z_current - z_candidate), z clipped at the candidate")}


def paper_lift(stages: int, height: float) -> dict[str, Term[Any]]:
    """The printed R_lift after the first `stages` stages, saturating at a height [m]."""

    def value(s: Snapshot) -> Tensor:
        return torch.exp(lifted(s).clamp(0, height) - height) * (s.stage >= stages)

    return {"lift": Term(value, 1.0, doc=f"exp(z - z_0 - h), z - z_0 between 0 and h = {height:g} m")}


def paper_penalty() -> dict[str, Term[Any]]:
    """The printed R_penalty."""
    return {"penalty": Term(effort, -0.1, "penalty", doc="sum of action^2")}
