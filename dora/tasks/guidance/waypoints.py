"""A reference made of waypoints: the wrist goes from one to the next at its speed, while the hand opens or closes.

A point runs ahead of the wrist, at the speed of the waypoint, towards a goal that is computed from the observed state
in every control step. A waypoint is reached when that point is at most a step away from its goal, the hand has done
its part, and the wrist is near enough or has been waited for long enough; a waypoint may wait for something before the
point sets out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.geometry.poses import Pose, slew
from dora.geometry.rotations import rotation_angle
from dora.tasks.guidance.reference import Reference
from dora.tasks.guidance.residual_action import Target
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage


@dataclass(frozen=True)
class Waypoint:
    """One part of the way.

    Attributes:
        name: of the phase.
        goal: observed snapshot, poses kept (`WaypointReference.kept`) -> world pose of the wrist.
        speed, spin: of the point that runs ahead [m/s], [rad/s].
        closed: share of the way from the candidate's pre-grasp to its closed hand, 0 to 1.
        arrived: error of the wrist below which the waypoint is reached [m], [rad].
        patience: time after which it counts as reached although the wrist is not there [s].
        ready: snapshot -> (n,) bool, without which the point does not set out; None: always.
        done: snapshot -> (n,) bool, without which the waypoint is not reached; None: always.
        lost: snapshot -> (n,) bool, which sends the hand back to the first waypoint; None: never.
        keep: whether the poses of wrist and object are kept when it begins.
    """

    name: str
    goal: Callable[[Any, "Kept"], Pose]
    speed: float = 0.4
    spin: float = 1.5
    closed: float = 0.0
    arrived: tuple[float, float] = (0.02, 0.15)
    patience: float = 0.5
    ready: Callable[[Any], Bool[Tensor, " n"]] | None = None
    done: Callable[[Any], Bool[Tensor, " n"]] | None = None
    lost: Callable[[Any], Bool[Tensor, " n"]] | None = None
    keep: bool = False


@dataclass(frozen=True)
class Kept:
    """What was noted when a waypoint with `keep` began, world frame.

    Attributes:
        goal: wrist pose that the candidate asked for, [m], wxyz.
        object: pose of the object.
        ahead: pose of the point that runs ahead, now.
    """

    goal: Pose
    object: Pose
    ahead: Pose


@dataclass(frozen=True)
class _Progress:
    """What the phases look at: whether each waypoint's own tests are passed."""

    arrived: Bool[Tensor, "n k"]
    lost: Bool[Tensor, "n k"]


def _phase(waypoints: Sequence[Waypoint], k: int) -> Stage[_Progress]:
    """Waypoint k as a phase; the last one never ends."""

    def arrived(t: _Progress) -> Tensor:
        return t.arrived[:, k] & (k < len(waypoints) - 1)

    def lost(t: _Progress) -> Tensor:
        return t.lost[:, k]

    if k == 0 or waypoints[k].lost is None:
        return Stage(waypoints[k].name, arrived)
    return Stage(waypoints[k].name, arrived, lost=lost, back_to=waypoints[0].name)


class WaypointReference(Reference):
    """Follows a list of waypoints.

    Args:
        waypoints: in order; the last one is held.
        num_envs: n.
        dt: duration of a control step [s].
        device: where the buffers are.
        closing_time: from the open to the closed hand [s].
    """

    def __init__(
        self,
        waypoints: Sequence[Waypoint],
        num_envs: int,
        dt: float,
        device: torch.device | str,
        closing_time: float = 0.6,
    ):
        self.waypoints, self.closing_time = tuple(waypoints), closing_time
        phases = [_phase(waypoints, k) for k in range(len(waypoints))]
        super().__init__(
            phases, num_envs, dt, device,
            ahead_p=(3,), ahead_q=(4,), target_p=(3,), target_q=(4,), closing=(), waited=(),
            goal_p=(3,), goal_q=(4,), object_p=(3,), object_q=(4,),
        )  # fmt: skip
        settings = [(w.speed * dt, w.spin * dt, w.closed, *w.arrived, w.patience) for w in waypoints]
        self._settings = torch.tensor(settings, device=device)

    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts anew at the wrist, hand open."""
        self.buffers.clear(rows)
        self.buffers.write(
            rows, ahead_p=wrist_p, ahead_q=wrist_q, target_p=wrist_p, target_q=wrist_q, goal_q=wrist_q, object_q=wrist_q
        )
        self.phase.reset(rows)

    @property
    def kept(self) -> Kept:
        """What was noted when the last waypoint with `keep` began."""
        b = self.buffers
        return Kept((b.goal_p, b.goal_q), (b.object_p, b.object_q), (b.ahead_p, b.ahead_q))

    def target(self, s: Snapshot) -> Target:
        """The point that runs ahead, and the hand between the candidate's pre-grasp and grasp."""
        b = self.buffers
        hand = s.goal.pregrasp + (s.goal.grasp - s.goal.pregrasp) * b.closing[:, None]
        return Target(b.ahead_p.clone(), b.ahead_q.clone(), hand)

    def aim(self, target: Target) -> None:
        """Notes where the wrist is being sent, which is compared with where it is."""
        self.buffers.update(target_p=target.wrist_p, target_q=target.wrist_q)

    def advance(self, s: Snapshot) -> None:
        """Changes phases, then moves the point and the fingers on by a control step."""
        b, before = self.buffers, self.phase.index.clone()
        step, turn, closed, near, turned, patience = self._now()
        goal_p, goal_q = self._goal(s)
        there = ((goal_p - b.ahead_p).norm(dim=-1) <= step) & (rotation_angle(goal_q, b.ahead_q) <= turn)
        there &= (b.closing - closed).abs() < 1e-6
        error = (b.target_p - s.hand.wrist_p).norm(dim=-1), rotation_angle(b.target_q, s.hand.wrist_q)
        settled = (error[0] < near) & (error[1] < turned) | (b.waited > patience - self.dt / 2)
        b.update(waited=torch.where(there, b.waited + self.dt, 0.0))
        arrived = (there & settled)[:, None] & self._tests(s, "done", True)
        self.phase.advance(_Progress(arrived, self._tests(s, "lost", False)))
        self._enter(s, self.phase.index != before)
        self._move(s)

    def _now(self) -> list[Tensor]:
        """Settings of the present waypoints, each (n,): step, turn, closed, errors of the wrist, patience."""
        return list(self._settings[self.phase.index.clamp(max=len(self.waypoints) - 1)].unbind(-1))

    def _tests(self, s: Snapshot, name: str, default: bool) -> Bool[Tensor, "n k"]:
        """A test of every waypoint."""
        plain = torch.full_like(s.time, default, dtype=torch.bool)
        tests = [getattr(w, name) for w in self.waypoints]
        return torch.stack([plain if test is None else test(s) for test in tests], -1)

    def _enter(self, s: Snapshot, entered: Bool[Tensor, " n"]) -> None:
        """What a new phase begins with."""
        b = self.buffers
        keeps = torch.tensor([w.keep for w in self.waypoints], device=entered.device)
        keep = (entered & keeps[self.phase.index])[:, None]
        b.update(
            goal_p=torch.where(keep, s.goal.p, b.goal_p), goal_q=torch.where(keep, s.goal.q, b.goal_q),
            object_p=torch.where(keep, s.object.p, b.object_p), object_q=torch.where(keep, s.object.q, b.object_q),
        )  # fmt: skip
        again = (entered & (self.phase.index == 0))[:, None]  # from where the wrist is
        b.update(
            waited=torch.where(entered, 0.0, b.waited),
            ahead_p=torch.where(again, s.hand.wrist_p, b.ahead_p),
            ahead_q=torch.where(again, s.hand.wrist_q, b.ahead_q),
        )

    def _move(self, s: Snapshot) -> None:
        """Moves the point towards its goal and the fingers towards theirs, where they may set out."""
        b = self.buffers
        step, turn, closed, *_ = self._now()
        ready = self._tests(s, "ready", True).gather(1, self.phase.index[:, None])
        ahead = (b.ahead_p, b.ahead_q)
        p, q = slew(ahead, self._goal(s), step, turn)
        rate = self.dt / self.closing_time
        closing = b.closing + (closed - b.closing).clamp(-rate, rate)
        b.update(
            ahead_p=torch.where(ready, p, ahead[0]), ahead_q=torch.where(ready, q, ahead[1]),
            closing=torch.where(ready[:, 0], closing, b.closing),
        )  # fmt: skip

    def _goal(self, s: Snapshot) -> Pose:
        """Goal of each environment's waypoint."""
        kept = self.kept
        goals = [w.goal(s, kept) for w in self.waypoints]
        index = self.phase.index
        rows = torch.arange(len(index), device=index.device)
        p, q = (torch.stack([goal[k] for goal in goals], 1)[rows, index] for k in (0, 1))
        return p, q
