"""The hammer's reference: catch it out of its fall, settle, bring it over the nail, strike, and strike again.

Closed loop throughout. While the hammer falls, the hand waits where the chosen candidate will be when it comes down to
the hand's height, turned as the hammer will be turned, and the fingers close `LEAD` before that moment. From then on
nothing depends on where the candidate wanted the hammer: its pose in the hand is measured all the time, and every wrist
pose is the pose that the *hammer* shall have, times the inverse of that.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

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
from dora.tasks.hammer.ballistics import Pose, Strike, arrival, blend, compose, fallen, inverse, relative, slew, slid
from dora.tasks.hammer.nail import DRIVEN
from dora.tasks.hammer.reach import REACH, TURN
from dora.tasks.hammer.snapshot import HammerSnapshot
from dora.tasks.mdp.stages import Stage

LEAD = 0.125
"""Time from the beginning of the catch until the fingers hold the handle [s]."""
SINK = 0.10
"""How far the hand sinks in that time [m]."""
FOLLOW_SPEED = 1.2
"""Speed up to which the closing hand sinks with the hammer [m/s]."""
FOLLOW_TIME = 0.155
"""How long it does so before it slows down [s]."""
FOLLOW_UP, FOLLOW_DOWN = 30.0, 10.0
"""Acceleration and deceleration of that [m/s^2]."""
FINGER_LAG = 0.028
"""Time from the beginning of the sinking to the command to close [s]."""
TRACK_TIME = 0.07
"""How long the closing hand goes on following the handle sideways [s]."""
AHEAD = 0.04
"""How far ahead of time the hand is where the handle will be [s]."""
CLOSE_TIME = 0.35
"""From the command to close until the hand counts as closed [s]."""
SETTLE_TIME = 0.35
"""How long the closed hand keeps still, while the hammer's pose in it is measured [s]."""
MEMORY = 0.3
"""Share of a new measurement of the hammer's pose in the hand."""
GAP = 0.05
"""Height of the face above the nail when the hammer is brought over it [m]."""
ALIGN_TIME = 0.4
"""How long the hammer is held there, in place [s]."""
RAISE = 0.7
"""Angle by which the hammer is raised before a blow [rad]."""
THROUGH = -0.002
"""How far below the head of the nail a blow is aimed [m]; the wrist runs on by about a centimetre."""
SWING_SPIN = 4.5
"""Angular speed of the hammer at impact [rad/s]."""
DWELL = 0.075
"""From impact to the next raising [s]."""
CARRY_SPEED, CARRY_SPIN = 0.5, 2.0
"""Speed [m/s] and spin [rad/s] of the wrist between catch and blow."""
NEAR = (0.01, 0.06)
"""Wrist error below which a place has been reached [m], [rad]."""
PATIENCE = 1.5
"""Time after which a phase that waits for the wrist goes on all the same [s]."""


@dataclass(frozen=True)
class Timing:
    """What the phases look at, each (n,): time to arrival and in the phase [s], the wrist's errors [m], [rad], and
    whether the nail has been driven in."""

    arrival: Float[Tensor, " n"]
    spent: Float[Tensor, " n"]
    position: Float[Tensor, " n"]
    angle: Float[Tensor, " n"]
    driven: Bool[Tensor, " n"]


def _none(t: Timing) -> Tensor:
    return torch.zeros_like(t.spent)


def _there(t: Timing) -> Tensor:
    return ((t.position < NEAR[0]) & (t.angle < NEAR[1])) | (t.spent > PATIENCE)


def _struck(t: Timing) -> Tensor:
    return t.spent >= SWING_TIME + DWELL


SWING_TIME = 2 * RAISE / SWING_SPIN
"""Duration of the accelerated swing [s]."""

PHASES: list[Stage[Timing]] = [
    Stage("wait", _none, lambda t: t.arrival <= LEAD),
    Stage("close", _none, lambda t: t.spent >= CLOSE_TIME),
    Stage("settle", _none, lambda t: t.spent >= SETTLE_TIME),
    Stage("align", _none, lambda t: _there(t) & (t.spent >= ALIGN_TIME), hold=12),
    Stage("raise", _none, _there, hold=2),
    Stage("swing", _none, lambda t: _struck(t) & t.driven, lost=lambda t: _struck(t) & ~t.driven, back_to="raise"),
    Stage("rest", _none, lambda t: t.spent < 0),
]
WAIT, CLOSE, SETTLE, ALIGN, RAISING, SWING, REST = range(7)


class CatchReference(Reference):
    """Leads wrist and hand through catch and blows.

    Args:
        num_envs: n.
        strike: geometry of the blows.
        dt: duration of a control step [s].
        device: of all tensors.
    """

    PHASES = PHASES

    def __init__(self, num_envs: int, strike: Strike, dt: float, device: torch.device):
        super().__init__(num_envs, device)
        self.strike, self.dt = strike, dt
        self._reach = torch.tensor([*REACH, 0.0], device=device)

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(num_envs, *shape, device=device)

        identity = torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(num_envs, 1)
        self.buffers = {
            "home_p": zeros(3), "home_q": identity.clone(), "lead_p": zeros(3), "lead_q": identity.clone(),
            "held_p": zeros(3), "held_q": identity.clone(), "spent": zeros(), "sinking": zeros(), "depth": zeros(),
        }  # fmt: skip

    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts with the wrist where it is: it will wait at this height."""
        b = self.buffers
        for name in ("home", "lead"):
            b[f"{name}_p"][rows], b[f"{name}_q"][rows] = wrist_p, wrist_q
        for name in ("held_p", "spent", "sinking", "depth"):
            b[name][rows] = 0.0
        self.phase.reset(rows)

    def _arrival(self, s: HammerSnapshot) -> Tensor:
        """Time (n,) until the candidate comes down to the height at which the fingers are to hold it [s]."""
        body = s.object_p, s.object_q
        carried, _ = relative(body, (s.goal_p, s.goal_q))
        return arrival(body, s.object_v, s.object_w, carried, self.buffers["home_p"][:, 2] - SINK)

    def _meeting(self, s: HammerSnapshot, height: Tensor) -> Pose:
        """Wrist pose at a height that has the handle where the candidate has it, a moment from now.

        The candidate is moved along the handle: a tilted handle that falls straight down shifts sideways.
        """
        b = self.buffers
        soon = fallen((s.object_p, s.object_q), s.object_v, s.object_w, self._arrival(s).clamp(max=AHEAD))
        goal = compose(soon, relative((s.object_p, s.object_q), (s.goal_p, s.goal_q)))
        axis = quaternion_apply(soon[1], torch.tensor([0.0, 0.0, 1.0], device=height.device).expand_as(s.object_p))
        position, quaternion = slid(goal, axis, height)
        home_p, home_q = b["home_p"].clone(), b["home_q"]
        home_p[:, 2] = height
        position = home_p + torch.clamp(position - home_p, -self._reach, self._reach)
        turn = rotation_vector_from_quaternion(quaternion_multiply(quaternion, quaternion_inverse(home_q)))
        turn = turn * (TURN / turn.norm(dim=-1, keepdim=True).clamp(min=TURN))
        return position, quaternion_multiply(quaternion_from_rotation_vector(turn), home_q)

    def target(self, s: HammerSnapshot) -> Target:
        """Where the candidate will be, until the fingers close; then where the reference has been led."""
        b, phase = self.buffers, self.phase.index
        waits = (phase == WAIT)[:, None]
        opened = waits | ((phase == CLOSE) & (b["spent"] < FINGER_LAG))[:, None]
        position, quaternion = self._meeting(s, b["home_p"][:, 2])
        return Target(
            torch.where(waits, position, b["lead_p"]),
            torch.where(waits, quaternion, b["lead_q"]),
            torch.where(opened, s.goal_pregrasp, s.goal_grasp),
        )

    def advance(self, s: HammerSnapshot) -> None:
        """Moves phase, measurement and lead on, once per control step."""
        b, before = self.buffers, self.phase.index.clone()
        self._measure(s, before)
        b["spent"] += self.dt
        goal = self._carried_to(before)
        error = (goal[0] - s.wrist_p).norm(dim=-1), rotation_angle(goal[1], s.wrist_q)
        self.phase.advance(Timing(self._arrival(s), b["spent"], *error, s.nail_driven >= DRIVEN))
        now = self.phase.index
        b["spent"].masked_fill_(now != before, 0.0)
        lead = b["lead_p"], b["lead_q"]
        carried = slew(lead, self._carried_to(now), CARRY_SPEED * self.dt, CARRY_SPIN * self.dt)
        for phases, (position, quaternion) in (
            ((WAIT,), self._meeting(s, b["home_p"][:, 2])),
            ((CLOSE,), self._sinking(s, lead)),
            ((ALIGN, RAISING, REST), carried),
            ((SWING,), self._wrist(self._swung(), -THROUGH)),
        ):
            here = torch.isin(now, torch.tensor(phases, device=now.device))[:, None]
            b["lead_p"].copy_(torch.where(here, position, b["lead_p"]))
            b["lead_q"].copy_(torch.where(here, quaternion, b["lead_q"]))

    def _carried_to(self, phase: Tensor) -> Pose:
        """Wrist pose to which the hammer is carried in a phase: low over the nail, raised for a blow, or at rest."""
        raised = RAISE * (phase == RAISING)
        gap = torch.where(phase == RAISING, -THROUGH, torch.where(phase == REST, 2 * GAP, GAP))
        return self._wrist(raised, gap)

    def _measure(self, s: HammerSnapshot, phase: Tensor) -> None:
        """Follows the hammer's pose in the hand: at once while it is caught, smoothly after, not while it strikes;
        and the nail's depth, not while it is struck, or the blow would become a push."""
        b = self.buffers
        b["depth"].copy_(torch.where(phase == SWING, b["depth"], s.nail_depth))
        share = torch.where(phase <= CLOSE, 1.0, torch.where(phase == SWING, 0.0, MEMORY))
        seen = relative((s.wrist_p, s.wrist_q), (s.object_p, s.object_q))
        held_p, held_q = blend((b["held_p"], b["held_q"]), seen, share)
        b["held_p"].copy_(held_p)
        b["held_q"].copy_(held_q)

    def _sinking(self, s: HammerSnapshot, lead: Pose) -> Pose:
        """The lead, sinking with the hammer for a moment, so that the fingers have time to close around it."""
        b = self.buffers
        faster, slower = b["sinking"] + FOLLOW_UP * self.dt, b["sinking"] - FOLLOW_DOWN * self.dt
        speed = torch.where(b["spent"] < FOLLOW_TIME, faster.clamp(max=FOLLOW_SPEED), slower.clamp(min=0))
        b["sinking"].copy_(torch.where(self.phase.index == CLOSE, speed, 0.0))
        down = torch.zeros_like(lead[0])
        down[:, 2] = b["sinking"] * self.dt
        position = lead[0] - down
        met_p, met_q = self._meeting(s, position[:, 2])
        free = (b["spent"] < TRACK_TIME)[:, None]
        return torch.where(free, met_p, position), torch.where(free, met_q, lead[1])

    def _swung(self) -> Tensor:
        """Angle (n,) of the hammer in the next step of a swing: constant acceleration from RAISE to 0 [rad]."""
        share = ((self.buffers["spent"] + self.dt) / SWING_TIME).clamp(max=1)
        return RAISE * (1 - share.square())

    def _wrist(self, raised: Tensor, gap: Tensor | float) -> Pose:
        """Wrist pose that brings the held hammer there."""
        b = self.buffers
        return compose(self.strike.hammer(b["depth"], raised, gap), inverse((b["held_p"], b["held_q"])))
