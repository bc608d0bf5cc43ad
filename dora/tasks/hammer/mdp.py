"""DoraHammer-v1's stages and reward terms: pure functions of a `HammerSnapshot`."""

from math import pi
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.tasks.hammer.snapshot import (
    HammerSnapshot,
    face_to_nail,
    fingers_on,
    misalignment,
    off_centre,
    relative_speed,
    tip_distance,
)
from dora.tasks.mdp.memory import EpisodeMemory
from dora.tasks.mdp.rewards import Term, Terms, tolerance
from dora.tasks.mdp.snapshot import Snapshot, derived
from dora.tasks.mdp.stages import Stage
from dora.tasks.mdp.terms import (
    at_candidate,
    beyond_the_limit,
    near_region,
    paper_affordance,
    paper_grasp,
    paper_penalty,
    penalties,
    without_overlap,
)

if TYPE_CHECKING:
    from dora.tasks.hammer.task import HammerConfig

CATCH, STABILISE, HELD = range(3)
"""Indices of the first stages, and of the one in which the hammer is held."""
DONE = "; 1 once all stages are done"
"""End of the meaning of terms that pay until the end of the episode."""


def strike_stage(c: "HammerConfig") -> int:
    """Index of the last stage."""
    return HELD + 1 + c.in_hand_turn


def stages(c: "HammerConfig") -> list[Stage[HammerSnapshot]]:
    """The sub-tasks, in order."""

    def caught(s: HammerSnapshot) -> Tensor:
        return in_hand(s, c) & (relative_speed(s) < c.caught_speed)

    def still(s: HammerSnapshot) -> Tensor:
        return in_hand(s, c) & (s.drift_p < c.still[0]) & (s.drift_r < c.still[1])

    def turned(s: HammerSnapshot) -> Tensor:
        return in_hand(s, c) & (s.turned >= c.turn.least)

    def oriented(s: HammerSnapshot) -> Tensor:
        enough = s.turned >= c.turn.least if c.in_hand_turn else torch.ones_like(s.turned, dtype=torch.bool)
        return in_hand(s, c) & (misalignment(s) < c.aligned) & above_nail(s, c) & enough

    def lost(s: HammerSnapshot) -> Tensor:
        return off_centre(s) > c.lost

    def driven(s: HammerSnapshot) -> Tensor:
        return s.nail_driven >= c.nail.driven

    return [
        Stage("catch", caught, hold=c.caught_time),
        Stage("stabilise", still, lost=lost, back_to="catch"),
        *([Stage("turn", turned, hold=c.turn.hold_time, lost=lost, back_to="catch")] if c.in_hand_turn else []),
        Stage("orient", oriented, hold=c.hold_time, lost=lost, back_to="catch"),
        Stage("strike", driven, lost=lost, back_to="catch"),
    ]


def terms(c: "HammerConfig") -> Terms[HammerSnapshot]:
    """The reward."""
    w, limit = c.weights, f"{1000 * c.penetration_limit:g} mm{beyond_the_limit(c)}"
    strikes = strike_stage(c)

    def catch(s: HammerSnapshot) -> Tensor:
        return tolerance(off_centre(s), (0.0, 0.02), 0.3) * (0.5 + 0.1 * fingers_on(s))

    def still(s: HammerSnapshot) -> Tensor:
        return torch.where(s.stage > strikes, 1.0, steadiness(s, c))

    def turn(s: HammerSnapshot) -> Tensor:
        share = (s.turned / c.turn.least).clamp(0, 1)
        return torch.where(s.stage > strikes, 1.0, (in_hand(s, c) & (s.stage >= HELD)) * share)

    def orient(s: HammerSnapshot) -> Tensor:
        held = in_hand(s, c) & (s.stage >= strikes - 1)
        return torch.where(s.stage > strikes, 1.0, held * poise(s))

    def strike(s: HammerSnapshot) -> Tensor:
        return driven_share(s, c) * without_overlap(s, c, c.after_overlap)

    def driven(s: HammerSnapshot) -> Tensor:
        return ((s.nail_driven >= c.nail.driven) & (s.stage > strikes)) * without_overlap(s, c)

    return Terms(
        {
            "affordance": Term(
                lambda s: near_region(tip_distance(s)), w.affordance, "affordance", True,
                "exp(-alpha * sum of fingertip distances to the handle)", region=True,
            ),
            "candidate": Term(
                lambda s: at_candidate(s, s.stage >= HELD), w.candidate, "task", True,
                "closeness of the wrist to the candidate until the hammer is held",
            ),
            "catch": Term(catch, w.catch, doc="handle near the middle of the hand, and fingers on it"),
            "still": Term(still, w.still, doc=f"the hammer does not move in the hand{DONE}"),
            **({"turn": Term(turn, c.turn.weight, doc=f"share of the turn{DONE}")} if c.in_hand_turn else {}),
            "orient": Term(
                orient, w.orient,
                doc="from the stage orient on, closeness of theta, the angle from striking axis to nail axis, and of "
                f"the face to the nail{DONE}",
            ),
            "strike": Term(
                strike, w.strike,
                doc=f"depth driven by blows, saturating; {c.after_overlap:g} of it after an overlap above {limit}",
            ),
            "driven": Term(
                driven, w.driven, doc=f"all stages done, and no overlap above {limit} so far"
            ),
            **penalties(w, c.free_overlap, c.penetration_limit, c.overlap_range),
        }
    )  # fmt: skip


def paper_terms(c: "HammerConfig") -> Terms[HammerSnapshot]:
    """The printed reward."""
    return Terms(
        {
            **paper_affordance(lambda s: s.object.p + (s.butt + s.neck) / 2),
            **paper_grasp(HELD),
            "orient": Term(
                lambda s: (1 - misalignment(s) / pi) * (s.stage >= strike_stage(c) - 1),
                1.0,
                doc="1 - theta / pi, theta: angle from striking axis to nail axis",
            ),
            "strike": Term(lambda s: driven_share(s, c), 1.0, doc="depth driven by blows"),
            **paper_penalty(),
        }
    )


def failed(s: Snapshot, memory: EpisodeMemory, c: "HammerConfig") -> Bool[Tensor, " n"]:
    """The hammer has fallen."""
    return s.object.p[:, 2] < c.fallen


@derived
def in_hand(s: HammerSnapshot, c: "HammerConfig") -> Bool[Tensor, " n"]:
    """The handle is in the hand, touched by two fingers."""
    return (off_centre(s) < c.in_hand) & (fingers_on(s) >= 2)


def above_nail(s: HammerSnapshot, c: "HammerConfig") -> Bool[Tensor, " n"]:
    """The striking face is over the nail's head."""
    away = face_to_nail(s)
    height = -away[:, 2]
    return (away[:, :2].norm(dim=-1) < c.beside) & (height > c.height[0]) & (height < c.height[1])


def driven_share(s: HammerSnapshot, c: "HammerConfig") -> Float[Tensor, " n"]:
    """Share of the depth to which blows must drive the nail, saturating."""
    return (s.nail_driven / c.nail.driven).clamp(0, 1)


@derived
def steadiness(s: HammerSnapshot, c: "HammerConfig") -> Float[Tensor, " n"]:
    """How little the held hammer moves in the hand, 0 to 1."""
    shift = tolerance(s.drift_p, (0.0, c.still[0]), 0.05)
    return in_hand(s, c) * shift * tolerance(s.drift_r, (0.0, c.still[1]), 0.5)


@derived
def poise(s: HammerSnapshot) -> Float[Tensor, " n"]:
    """How near the hammer is to a blow: striking axis to nail axis, face to nail, 0 to 1."""
    turn = tolerance(misalignment(s), margin=pi)
    return turn * tolerance(face_to_nail(s).norm(dim=-1), (0.0, 0.05), 0.6)
