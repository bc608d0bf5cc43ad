"""Paths of the arm to candidates: a transit from the start posture to the standoff, then the approach."""

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
"""Reasons for which a candidate is rejected, in the order of the tests; `Reachability.reason` has indices into it."""
OK, HAND_TABLE, HAND_OBJECT, OUT_OF_REACH, NOT_CONTINUOUS, ARM_COLLISION, NO_MOTION = range(len(REASONS))
"""Indices into `REASONS`."""


@dataclass(frozen=True)
class ReachSettings:
    """Numbers of the motion-feasibility filter.

    Attributes:
        motion: the transit from the start posture to the standoff: "controller" rolls out the tasks' wrist controller;
            "plan" tries a straight line in joint space and then a planner; "none" requires no transit.
        standoff: length of the approach [m].
        spacing: distance of the postures that are checked along the approach [m].
        table_height: height of the table's upper face in the world [m].
        table_clearance: smallest height of hand and arm above the table [m].
        overlap: largest penetration depth of the opened hand in the object on the approach [m]; at the end of the
            approach the hand is meant to touch it.
        clearance: smallest distance of the arm from the object [m].
        brush: how deep the hand would be in the object if that stood still in the controller's transit [m]; up to
            this it pushes the object a little, and the grasp succeeds as often as without (docs/reachability.md).
        graze: the same of two links of the arm, which slide along each other; on the approach they must not touch.
        speed: speed of the wrist on the approach [m/s], at which no joint may exceed its velocity limit.
        seeds: number of seeds of the inverse kinematics per candidate.
        stride: control steps between two postures that are checked with motion "controller".
        plan: effort of the planner.
        controller: numbers of the wrist controller that motion "controller" rolls out.
    """

    motion: Literal["controller", "plan", "none"] = "controller"
    standoff: float = 0.1
    spacing: float = 0.02
    table_height: float = 0.0
    table_clearance: float = 0.002
    overlap: float = 0.003
    clearance: float = 0.003
    brush: float = 0.02
    graze: float = 0.01
    speed: float = 0.15
    seeds: int = 8
    stride: int = 3
    plan: PlanSettings = field(default_factory=PlanSettings)
    controller: Controller = field(default_factory=Controller)


@dataclass(frozen=True, eq=False)
class Goals:
    """n wrist poses ([m], wxyz) in the robot's base frame, each with the unit direction of its approach."""

    position: Float[Tensor, "n 3"]
    quaternion: Float[Tensor, "n 4"]
    approach: Float[Tensor, "n 3"]

    def __getitem__(self, rows: Int[Tensor, " m"]) -> Goals:
        return Goals(self.position[rows], self.quaternion[rows], self.approach[rows])


@dataclass(frozen=True, eq=False)
class ApproachPaths:
    """One path per goal.

    Attributes:
        descent: (n, k, dof) arm joints on the approach, from the standoff to the candidate [rad].
        transit: n arrays (t, dof) of arm joints from the start posture to the standoff [rad]; None where not known.
        failure: (n,) index into `REASONS`, before collisions are tested.
    """

    descent: Float[Tensor, "n k dof"]
    transit: list[Tensor | None]
    failure: Int[Tensor, " n"]


def attempts(
    kinematics: InverseKinematics,
    goals: Goals,
    start: Float[Tensor, " dof"],
    settings: ReachSettings,
    up: Float[Tensor, " 3"],
) -> Iterator[Callable[[Int[Tensor, " m"]], ApproachPaths]]:
    """Functions from rows of `goals` to paths, the best paths first; call the next one for rows that failed.

    Args:
        kinematics: inverse kinematics of the arm.
        goals: n wrist poses with approaches.
        start: (dof,) arm joints from which motions start [rad].
        settings: numbers of the filter.
        up: upward direction in the base frame.
    """
    if settings.motion == "controller":
        yield lambda rows: _controller_paths(kinematics, goals[rows], start, settings, up)
        return
    solutions = kinematics.solve(goals.position, goals.quaternion, settings.seeds)
    for index in range(settings.seeds):
        yield partial(_tracked, kinematics, goals, solutions, index, settings)


def _count(settings: ReachSettings) -> int:
    """Number of postures along the approach, both ends included."""
    return 1 + max(1, round(settings.standoff / settings.spacing))


def _controller_paths(
    kinematics: InverseKinematics, goals: Goals, start: Tensor, settings: ReachSettings, up: Tensor
) -> ApproachPaths:
    """Paths of the wrist controller; the failure is "out of reach" where the inverse kinematics finds no solution."""
    path = goals.position, goals.quaternion, goals.approach, settings.standoff
    m = roll_out(kinematics.chain, start, *path, settings.controller, up)
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
    index: int,
    settings: ReachSettings,
    rows: Tensor,
) -> ApproachPaths:
    """Approaches tracked backwards from solution `index` of each goal to the standoff, posture by posture."""
    goals, count = goals[rows], _count(settings)
    q = solutions.q[rows, index]
    back = torch.linspace(0, settings.standoff, count)[1:]
    places = goals.position[:, None] - goals.approach[:, None] * back[:, None]
    path, tracked = kinematics.follow(q, places, goals.quaternion[:, None].expand(-1, count - 1, 4))
    path = torch.cat([q[:, None], path], 1).flip(1)
    time = settings.standoff / (count - 1) / settings.speed
    jumps = ((path[:, 1:] - path[:, :-1]).abs() > kinematics.chain.velocity * time).flatten(1).any(1)
    failure = torch.where(tracked.all(1) & ~jumps, OK, NOT_CONTINUOUS)
    failure = torch.where(solutions.solved[rows, index], failure, OUT_OF_REACH)
    return ApproachPaths(path, [None] * len(rows), failure)
