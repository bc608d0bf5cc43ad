"""Paths of the arm to candidates: along the approach, and what leads to its beginning."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.robot.motion.controller_rollout import Controller, roll_out
from dora.robot.motion.inverse_kinematics import InverseKinematics, Solutions
from dora.robot.motion.planning import PlanSettings

REASONS = (
    "ok",
    "hand hits table",
    "hand hits object",
    "out of reach",
    "no continuous approach",
    "arm collision",
    "no motion from the start",
)
"""Why a candidate is rejected; `Reachability.reason` holds indices. The order is that of the tests."""
OK, HAND_TABLE, HAND_OBJECT, OUT_OF_REACH, NOT_CONTINUOUS, ARM_COLLISION, NO_MOTION = range(len(REASONS))


@dataclass(frozen=True)
class ReachSettings:
    """Numbers of the filter.

    Attributes:
        motion: from the start posture to the standoff: "servo" rolls out the tasks' wrist controller; "plan" tries a
            straight line in joint space and then a planner; "none" asks only for the approach itself.
        standoff: length of the approach [m].
        spacing: distance of the postures that are checked along it [m].
        table_height: of the table's upper face in the world [m].
        table_clearance: smallest height of hand and arm above it [m].
        overlap: how deep the opened hand may be in the object on the approach [m]; candidates touch it on purpose.
        clearance: smallest distance from the object before the approach [m].
        speed: of the wrist on the approach [m/s]; with it no joint may exceed its velocity limit.
        seeds: starts of the inverse kinematics per candidate.
        stride: control steps between two postures that are checked with motion "servo".
        plan: effort of the planner.
        controller: numbers of the wrist controller that motion "servo" rolls out.
    """

    motion: Literal["servo", "plan", "none"] = "servo"
    standoff: float = 0.1
    spacing: float = 0.02
    table_height: float = 0.0
    table_clearance: float = 0.002
    overlap: float = 0.003
    clearance: float = 0.003
    speed: float = 0.15
    seeds: int = 8
    stride: int = 3
    plan: PlanSettings = field(default_factory=PlanSettings)
    controller: Controller = field(default_factory=Controller)


@dataclass(frozen=True, eq=False)
class Goals:
    """n wrist poses ([m], wxyz) in the base frame, each with the unit direction of its approach."""

    position: Float[Tensor, "n 3"]
    quaternion: Float[Tensor, "n 4"]
    approach: Float[Tensor, "n 3"]

    def __getitem__(self, rows: Int[Tensor, " m"]) -> Goals:
        return Goals(self.position[rows], self.quaternion[rows], self.approach[rows])


@dataclass(frozen=True, eq=False)
class ApproachPaths:
    """One way per goal.

    Attributes:
        descent: (n, k, dof) arm joints [rad] from the standoff to the candidate.
        transit: n times the postures (t, dof) before it [rad], or None where they are not known.
        failure: (n,) index into `REASONS` of what is wrong without looking for collisions.
    """

    descent: Float[Tensor, "n k dof"]
    transit: list[Tensor | None]
    failure: Int[Tensor, " n"]


def attempts(
    kinematics: InverseKinematics, goals: Goals, start: Float[Tensor, " dof"], settings: ReachSettings
) -> Iterator[Callable[[Int[Tensor, " m"]], ApproachPaths]]:
    """Functions from rows of `goals` to ways, best way first; ask the next one for the rows the last one failed."""
    if settings.motion == "servo":
        yield lambda rows: _servo(kinematics, goals[rows], start, settings)
        return
    solutions = kinematics.solve(goals.position, goals.quaternion, settings.seeds)
    for rank in range(settings.seeds):
        yield partial(_tracked, kinematics, goals, solutions, rank, settings)


def _count(settings: ReachSettings) -> int:
    """Postures along the approach, both ends included."""
    return 1 + max(1, round(settings.standoff / settings.spacing))


def _servo(kinematics: InverseKinematics, goals: Goals, start: Tensor, settings: ReachSettings) -> ApproachPaths:
    """Paths of the wrist controller; where it fails, the reason is out of reach if there is no solution at all."""
    path = goals.position, goals.quaternion, goals.approach, settings.standoff
    m = roll_out(kinematics.chain, start, *path, settings.controller)
    failure = torch.where(m.reached, OK, NO_MOTION)
    lost = (~m.reached).nonzero()[:, 0]
    solved = kinematics.solve(goals.position[lost], goals.quaternion[lost], settings.seeds).solved[:, 0]
    failure[lost[~solved]] = OUT_OF_REACH
    share = torch.linspace(0, 1, _count(settings))
    steps = (m.arrival[:, None] + share * (m.finish - m.arrival)[:, None]).round().long()
    descent = m.q.gather(1, steps[:, :, None].expand(-1, -1, m.q.shape[-1]))
    ends = m.arrival.tolist()
    return ApproachPaths(descent, [q[: end + 1 : settings.stride] for q, end in zip(m.q, ends, strict=True)], failure)


def _tracked(
    kinematics: InverseKinematics,
    goals: Goals,
    solutions: Solutions,
    rank: int,
    settings: ReachSettings,
    rows: Tensor,
) -> ApproachPaths:
    """Paths from the solutions of one rank back to the standoff, each posture from the one before."""
    goals, count = goals[rows], _count(settings)
    q = solutions.q[rows, rank]
    back = torch.linspace(0, settings.standoff, count)[1:]
    places = goals.position[:, None] - goals.approach[:, None] * back[:, None]
    path, tracked = kinematics.follow(q, places, goals.quaternion[:, None].expand(-1, count - 1, 4))
    path = torch.cat([q[:, None], path], 1).flip(1)
    time = settings.standoff / (count - 1) / settings.speed
    jumps = ((path[:, 1:] - path[:, :-1]).abs() > kinematics.chain.velocity * time).flatten(1).any(1)
    failure = torch.where(tracked.all(1) & ~jumps, OK, NOT_CONTINUOUS)
    failure = torch.where(solutions.solved[rows, rank], failure, OUT_OF_REACH)
    return ApproachPaths(path, [None] * len(rows), failure)
