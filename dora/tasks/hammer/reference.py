"""The hammer's reference: catch it out of its fall, settle, bring it over the nail, strike, and strike again.

Closed loop throughout. While the hammer falls, the hand waits where the chosen candidate will be when it comes down to
the hand's height, turned as the hammer will be turned, and the fingers close a moment before it arrives. From then on
nothing depends on where the candidate wanted the hammer: its pose in the hand is measured all the time, and every wrist
pose is the pose that the *hammer* shall have, times the inverse of that.
"""

import functools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.geometry.poses import Pose, blend, compose, inverse, relative, slew
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_inverse,
    quaternion_multiply,
    rotation_angle,
    rotation_vector_from_quaternion,
)
from dora.tasks.guidance.reference import Reference
from dora.tasks.guidance.residual_action import Target
from dora.tasks.hammer.ballistics import Strike, after_fall, arrival, slid
from dora.tasks.hammer.finger_motion import FingerMotion
from dora.tasks.hammer.reach import REACH, TURN
from dora.tasks.hammer.snapshot import HammerSnapshot
from dora.tasks.mdp.stages import Stage


@dataclass(frozen=True, kw_only=True)
class CatchSettings:
    """Numbers of the reference."""

    lead: float = 0.125
    """Time from the beginning of the catch until the fingers hold the handle [s]."""
    sink: float = 0.10
    """How far the hand sinks in that time [m]."""
    follow_speed: float = 1.2
    """Speed up to which the closing hand sinks with the hammer [m/s]."""
    follow_time: float = 0.155
    """How long it does so before it slows down [s]."""
    follow_up: float = 30.0
    """Acceleration of that [m/s^2]."""
    follow_down: float = 10.0
    """Deceleration of that [m/s^2]."""
    finger_lag: float = 0.028
    """Time from the beginning of the sinking to the command to close [s]."""
    track_time: float = 0.07
    """How long the closing hand goes on following the handle sideways [s]."""
    ahead: float = 0.04
    """How far ahead of time the hand is where the handle will be [s]."""
    close_time: float = 0.35
    """From the command to close until the hand counts as closed [s]."""
    settle_time: float = 0.35
    """How long the closed hand keeps still, while the hammer's pose in it is measured [s]."""
    memory: float = 0.3
    """Share of a new measurement of the hammer's pose in the hand [1]."""
    gap: float = 0.05
    """Height of the face above the nail when the hammer is brought over it [m]."""
    align_time: float = 0.4
    """How long the hammer is brought over the nail at least [s]."""
    aligned_time: float = 0.3
    """How long it must then be in place [s]."""
    raised_time: float = 0.05
    """How long it must be raised before a blow [s]."""
    raised: float = 0.7
    """Angle by which the hammer is raised before a blow [rad]."""
    through: float = -0.002
    """How far below the head of the nail a blow is aimed [m]; the wrist runs on by about a centimetre."""
    swing_spin: float = 4.5
    """Angular speed of the hammer at impact [rad/s]."""
    dwell: float = 0.075
    """From impact to the next raising [s]."""
    carry_speed: float = 0.5
    """Speed of the wrist between catch and blow [m/s]."""
    carry_spin: float = 3.0
    """Spin of the wrist between catch and blow [rad/s]."""
    arrived: tuple[float, float] = (0.01, 0.06)
    """Wrist error below which a place has been reached [m], [rad]."""
    held_freedom: float = 0.2
    """Share of the residual action's bounds that is in force once the hammer is held, for what follows is led by the
    hammer's measured pose [1]."""
    patience: float = 1.5
    """Time after which a phase that waits for the wrist goes on all the same [s]."""

    @property
    def swing_time(self) -> float:
        """Duration of the accelerated swing [s]."""
        return 2 * self.raised / self.swing_spin


@dataclass(frozen=True)
class Timing:
    """What the phases look at, each (n,): time to arrival and in the phase [s], the wrist's errors [m], [rad], and
    whether the nail has been driven in."""

    arrival: Float[Tensor, " n"]
    spent: Float[Tensor, " n"]
    position: Float[Tensor, " n"]
    angle: Float[Tensor, " n"]
    driven: Bool[Tensor, " n"]


TURNED_TIME = 0.15
"""How long the hand keeps still after the fingers have turned the hammer in it [s]."""
WAIT, CLOSE, SETTLE = range(3)
"""Indices of the first phases."""


def phases(c: CatchSettings, turning: float | None = None) -> list[Stage[Timing]]:
    """The phases, in order.

    Args:
        c: numbers of the reference.
        turning: how long the fingers turn the hammer in the hand [s]; None if they do not.
    """

    def there(t: Timing) -> Tensor:
        return ((t.position < c.arrived[0]) & (t.angle < c.arrived[1])) | (t.spent > c.patience)

    def struck(t: Timing) -> Tensor:
        return t.spent >= c.swing_time + c.dwell

    return [
        Stage("wait", lambda t: t.arrival <= c.lead),
        Stage("close", lambda t: t.spent >= c.close_time),
        Stage("settle", lambda t: t.spent >= c.settle_time),
        *([] if turning is None else [Stage("turn", lambda t: t.spent >= turning + TURNED_TIME)]),
        Stage("align", lambda t: there(t) & (t.spent >= c.align_time), hold=c.aligned_time),
        Stage("raise", there, hold=c.raised_time),
        Stage("swing", lambda t: struck(t) & t.driven, lost=lambda t: struck(t) & ~t.driven, back_to="raise"),
        Stage("rest", lambda t: t.spent < 0),
    ]


class CatchReference(Reference):
    """Leads wrist and hand through catch and blows.

    Args:
        num_envs: n.
        strike: geometry of the blows.
        driven: depth at which the nail has been driven in [m].
        dt: duration of a control step [s].
        device: of all tensors.
        settings: numbers of the reference.
        motion: with which the fingers turn the caught hammer; None if they do not.
    """

    def __init__(
        self,
        num_envs: int,
        strike: Strike,
        driven: float,
        dt: float,
        device: torch.device | str,
        settings: CatchSettings | None = None,
        motion: FingerMotion | None = None,
    ):
        self.settings, self.motion = settings or CatchSettings(), motion
        turning: dict[str, tuple[int, ...]] = {} if motion is None else {"offset": motion.positive.shape[1:]}
        super().__init__(
            phases(self.settings, None if motion is None else motion.seconds), num_envs, dt, device, **turning,
            home_p=(3,), home_q=(4,), lead_p=(3,), lead_q=(4,), grasped_p=(3,), grasped_q=(4,),
            spent=(), sinking=(), depth=(),
        )  # fmt: skip
        self.strike, self._driven = strike, driven
        self._index = {phase.name: k for k, phase in enumerate(self.phase.stages)}
        self._reach = torch.tensor([*REACH, 0.0], device=device)
        for name in ("home_q", "lead_q", "grasped_q"):
            getattr(self.buffers, name)[:, 0] = 1.0

    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts with the wrist where it is: it will wait at this height."""
        self.buffers.write(
            rows, home_p=wrist_p, home_q=wrist_q, lead_p=wrist_p, lead_q=wrist_q,
            grasped_p=0.0, spent=0.0, sinking=0.0, depth=0.0,
        )  # fmt: skip
        if self.motion is not None:
            self.buffers.write(rows, offset=0.0)
        self.phase.reset(rows)

    def freedom(self) -> Float[Tensor, " n"]:
        """All of the residual until the hammer is held as it shall be, less from then on."""
        return torch.where(self.phase.index < self._index["align"], 1.0, self.settings.held_freedom)

    def _in(self, *names: str) -> Bool[Tensor, " n"]:
        """Which environments are in one of these phases."""
        first, *others = (self.phase.index == self._index[name] for name in names)
        return functools.reduce(torch.logical_or, others, first)

    def _arrival(self, s: HammerSnapshot) -> Tensor:
        """Time (n,) until the candidate comes down to the height at which the fingers are to hold it [s]."""
        body = s.object.p, s.object.q
        carried, _ = relative(body, (s.goal.p, s.goal.q))
        return arrival(body, s.object.v, s.object.w, carried, self.buffers.home_p[:, 2] - self.settings.sink)

    def _meeting(self, s: HammerSnapshot, height: Tensor) -> Pose:
        """Wrist pose at a height that has the handle where the candidate has it, a moment from now.

        The candidate is moved along the handle: a tilted handle that falls straight down shifts sideways.
        """
        b = self.buffers
        soon = after_fall(
            (s.object.p, s.object.q), s.object.v, s.object.w, self._arrival(s).clamp(max=self.settings.ahead)
        )
        goal = compose(soon, relative((s.object.p, s.object.q), (s.goal.p, s.goal.q)))
        axis = quaternion_apply(soon[1], torch.tensor([0.0, 0.0, 1.0], device=height.device).expand_as(s.object.p))
        position, quaternion = slid(goal, axis, height)
        home_p, home_q = b.home_p.clone(), b.home_q
        home_p[:, 2] = height
        position = home_p + torch.clamp(position - home_p, -self._reach, self._reach)
        turn = rotation_vector_from_quaternion(quaternion_multiply(quaternion, quaternion_inverse(home_q)))
        turn = turn * (TURN / turn.norm(dim=-1, keepdim=True).clamp(min=TURN))
        return position, quaternion_multiply(quaternion_from_rotation_vector(turn), home_q)

    def target(self, s: HammerSnapshot) -> Target:
        """Where the candidate will be, until the fingers close; then where the reference has been led."""
        b, phase = self.buffers, self.phase.index
        waits = (phase == WAIT)[:, None]
        opened = waits | ((phase == CLOSE) & (b.spent < self.settings.finger_lag))[:, None]
        position, quaternion = self._meeting(s, b.home_p[:, 2])
        closed = s.goal.grasp if self.motion is None else s.goal.grasp + b.offset
        return Target(
            torch.where(waits, position, b.lead_p),
            torch.where(waits, quaternion, b.lead_q),
            torch.where(opened, s.goal.pregrasp, closed),
        )

    def advance(self, s: HammerSnapshot) -> None:
        """Moves phase, measurement and lead on, once per control step."""
        b, c, before = self.buffers, self.settings, self.phase.index.clone()
        self._measure(s)
        b.update(spent=b.spent + self.dt)
        goal = self._carried_to()
        error = (goal[0] - s.hand.wrist_p).norm(dim=-1), rotation_angle(goal[1], s.hand.wrist_q)
        self.phase.advance(Timing(self._arrival(s), b.spent, *error, s.nail_driven >= self._driven))
        now = self.phase.index
        b.spent.masked_fill_(now != before, 0.0)
        lead = b.lead_p, b.lead_q
        self._bend(s)
        carried = slew(lead, self._carried_to(), c.carry_speed * self.dt, c.carry_spin * self.dt)
        for phases, (position, quaternion) in (
            (("wait",), self._meeting(s, b.home_p[:, 2])),
            (("close",), self._sinking(s, lead)),
            (("align", "raise", "rest"), carried),
            (("swing",), self._wrist(self._swung(), -c.through)),
        ):
            here = self._in(*phases)[:, None]
            b.lead_p.copy_(torch.where(here, position, b.lead_p))
            b.lead_q.copy_(torch.where(here, quaternion, b.lead_q))

    def _bend(self, s: HammerSnapshot) -> None:
        """Moves the fingers that turn the hammer in the hand on."""
        if self.motion is not None:
            moved = self.motion.offsets(self.buffers.spent, s.way)
            self.buffers.update(offset=torch.where(self._in("turn")[:, None], moved, self.buffers.offset))

    def _carried_to(self) -> Pose:
        """Wrist pose to which the hammer is carried now: low over the nail, raised for a blow, or at rest."""
        c, raising = self.settings, self._in("raise")
        gap = torch.where(raising, -c.through, torch.where(self._in("rest"), 2 * c.gap, c.gap))
        return self._wrist(c.raised * raising, gap)

    def _measure(self, s: HammerSnapshot) -> None:
        """Follows the hammer's pose in the hand: at once while it is caught, smoothly after, not while it strikes;
        and the nail's depth, not while it is struck, or the blow would become a push."""
        b, swings = self.buffers, self._in("swing")
        b.depth.copy_(torch.where(swings, b.depth, s.nail_depth))
        share = torch.where(self._in("wait", "close"), 1.0, torch.where(swings, 0.0, self.settings.memory))
        seen = relative((s.hand.wrist_p, s.hand.wrist_q), (s.object.p, s.object.q))
        grasped_p, grasped_q = blend((b.grasped_p, b.grasped_q), seen, share)
        b.grasped_p.copy_(grasped_p)
        b.grasped_q.copy_(grasped_q)

    def _sinking(self, s: HammerSnapshot, lead: Pose) -> Pose:
        """The lead, sinking with the hammer for a moment, so that the fingers have time to close around it."""
        b, c = self.buffers, self.settings
        faster, slower = b.sinking + c.follow_up * self.dt, b.sinking - c.follow_down * self.dt
        speed = torch.where(b.spent < c.follow_time, faster.clamp(max=c.follow_speed), slower.clamp(min=0))
        b.sinking.copy_(torch.where(self.phase.index == CLOSE, speed, 0.0))
        down = torch.zeros_like(lead[0])
        down[:, 2] = b.sinking * self.dt
        position = lead[0] - down
        met_p, met_q = self._meeting(s, position[:, 2])
        free = (b.spent < c.track_time)[:, None]
        return torch.where(free, met_p, position), torch.where(free, met_q, lead[1])

    def _swung(self) -> Tensor:
        """Angle (n,) of the hammer in the next step of a swing: constant acceleration down to 0 [rad]."""
        c = self.settings
        share = ((self.buffers.spent + self.dt) / c.swing_time).clamp(max=1)
        return c.raised * (1 - share.square())

    def _wrist(self, raised: Tensor, gap: Tensor | float) -> Pose:
        """Wrist pose that brings the held hammer there."""
        b = self.buffers
        return compose(self.strike.hammer(b.depth, raised, gap), inverse((b.grasped_p, b.grasped_q)))
