"""DoraHammer-v1's stages and reward terms: pure functions of a `HammerSnapshot`."""

from math import pi

import torch
from torch import Tensor

from dora.tasks.hammer.nail import DRIVEN
from dora.tasks.hammer.snapshot import (
    IN_HAND,
    HammerSnapshot,
    face_to_nail,
    fingers_on,
    grip_distance,
    misalignment,
    relative_speed,
    tip_distance,
)
from dora.tasks.mdp.reward_terms import (
    at_candidate,
    near_region,
    paper_affordance,
    paper_grasp,
    paper_penalty,
    penalties,
)
from dora.tasks.mdp.rewards import Term, Terms, closeness
from dora.tasks.mdp.stages import Stage

CAUGHT_SPEED = 0.5
"""Speed of the hammer in the hand below which it has been caught [m/s]."""
STILL = (0.008, 0.15)
"""Motion within the window up to which the hammer is held still [m], [rad]."""
ALIGNED = pi / 12
"""Angle between striking axis and nail axis up to which the hammer is oriented [rad]."""
ABOVE = 0.015
"""Horizontal distance of the striking face from the nail up to which it is above the nail [m]."""
HEIGHT = (-0.005, 0.15)
"""Height of the face above the nail between which it counts as above [m]."""
HOLD = 10
"""Control steps the hammer must be held over the nail."""
DROPPED = 0.12
"""Distance of the handle from the middle of the grip at which the hammer is lost [m]."""
PENETRATION_LIMIT = 0.005
"""Penetration above which an episode does not count as a success [m]."""
AFTER_OVERLAP = 0.3
"""Share of what blows earn that is left once an overlap was deeper than that."""


def _in_hand(s: HammerSnapshot) -> Tensor:
    return (grip_distance(s) < IN_HAND) & (fingers_on(s) >= 2)


def _caught(s: HammerSnapshot) -> Tensor:
    return _in_hand(s) & (relative_speed(s) < CAUGHT_SPEED)


def _still(s: HammerSnapshot) -> Tensor:
    return _in_hand(s) & (s.drift_p < STILL[0]) & (s.drift_r < STILL[1])


def _above(s: HammerSnapshot) -> Tensor:
    away = face_to_nail(s)
    return (away[:, :2].norm(dim=-1) < ABOVE) & (-away[:, 2] > HEIGHT[0]) & (-away[:, 2] < HEIGHT[1])


def _oriented(s: HammerSnapshot) -> Tensor:
    return _in_hand(s) & (misalignment(s) < ALIGNED) & _above(s)


def _lost(s: HammerSnapshot) -> Tensor:
    return grip_distance(s) > DROPPED


def _depth(s: HammerSnapshot) -> Tensor:
    return (s.nail_driven / DRIVEN).clamp(0, 1)


def _steadiness(s: HammerSnapshot) -> Tensor:
    return _in_hand(s) * closeness(s.drift_p, STILL[0], 0.05) * closeness(s.drift_r, STILL[1], 0.5)


def _poise(s: HammerSnapshot) -> Tensor:
    turn = closeness(misalignment(s), 0.0, pi)
    return turn * closeness(face_to_nail(s).norm(dim=-1), 0.05, 0.6)


STAGES: list[Stage[HammerSnapshot]] = [
    Stage("catch", lambda s: closeness(grip_distance(s), 0.02, 0.3), _caught, hold=3),
    Stage("stabilise", _steadiness, _still, lost=_lost, back_to="catch"),
    Stage("orient", _poise, _oriented, hold=HOLD, lost=_lost, back_to="catch"),
    Stage("strike", _depth, lambda s: s.nail_driven >= DRIVEN, lost=_lost, back_to="catch"),
]
ORIENT, STRIKE = 2, 3


def _catch(s: HammerSnapshot) -> Tensor:
    return closeness(grip_distance(s), 0.02, 0.3) * (0.5 + 0.1 * fingers_on(s))


def _orient(s: HammerSnapshot) -> Tensor:
    held = _in_hand(s) & (s.stage >= ORIENT)
    return torch.where(s.stage > STRIKE, 1.0, held * _poise(s))


def _kept(s: HammerSnapshot) -> Tensor:
    return torch.where(s.stage > STRIKE, 1.0, _steadiness(s))


def _clean(s: HammerSnapshot) -> Tensor:
    return (s.max_penetration <= PENETRATION_LIMIT).float()


def _strike(s: HammerSnapshot) -> Tensor:
    return _depth(s) * (AFTER_OVERLAP + (1 - AFTER_OVERLAP) * _clean(s))


def _driven(s: HammerSnapshot) -> Tensor:
    return ((s.nail_driven >= DRIVEN) & (s.stage > STRIKE)).float() * _clean(s)


TERMS: Terms[HammerSnapshot] = Terms(
    {
        "affordance": Term(
            lambda s: near_region(tip_distance(s)),
            0.2,
            "affordance",
            True,
            "exp(-alpha * sum of fingertip distances to the handle)",
        ),
        "candidate": Term(
            lambda s: at_candidate(s, s.stage >= ORIENT),
            0.3,
            "task",
            True,
            "closeness of the wrist to the candidate until the hammer is held",
        ),
        "catch": Term(_catch, 0.4, doc="handle near the middle of the grip, and fingers on it"),
        "still": Term(_kept, 0.4, doc="the hammer does not move in the hand"),
        "orient": Term(
            _orient,
            1.0,
            doc="closeness of theta, the angle from striking axis to nail axis, and of the face to the nail",
        ),
        "strike": Term(
            _strike,
            2.0,
            doc=f"depth driven by blows, saturating at the target; {AFTER_OVERLAP:g} of it after an overlap above 5 mm",
        ),
        "driven": Term(_driven, 1.5, doc="all stages done, and no overlap above 5 mm so far"),
        **penalties(0.001, PENETRATION_LIMIT),
    }
)


PAPER_TERMS: Terms[HammerSnapshot] = Terms(
    {
        **paper_affordance(lambda s: s.object_p + (s.butt + s.neck) / 2),
        **paper_grasp(ORIENT),
        "orient": Term(
            lambda s: (1 - misalignment(s) / pi) * (s.stage >= ORIENT),
            1.0,
            doc="-theta with theta = arccos(2 <r, r*>^2 - 1), the rotation left, over pi and plus one",
        ),
        "strike": Term(_depth, 1.0, doc="depth driven by blows"),
        **paper_penalty(),
    }
)
