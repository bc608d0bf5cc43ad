"""The hammer's reference: catch it out of its fall, settle, bring it over the nail, strike, and strike again.

Closed loop throughout. While the hammer falls, the hand waits where the chosen candidate will be when it comes down to
the hand's height, turned as the hammer will be turned, and the fingers close `LEAD` before that moment. From then on
nothing depends on where the candidate wanted the hammer: its pose in the hand is measured all the time, and every wrist
pose is the pose that the *hammer* shall have, times the inverse of that.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.robot.rotations import quaternion_from_rotation_vector, quaternion_inverse, quaternion_multiply
from dora.robot.rotations import rotation_angle, rotation_vector_from_quaternion
from dora.tasks.correction import Target
from dora.tasks.hammering import Pose, Strike, blend, compose, inverse, predict_goal, relative, slew
from dora.tasks.reference import Reference
from dora.tasks.hammer_snapshot import HammerSnapshot
from dora.tasks.stages import Stage

LEAD = 0.087
"""Time before the predicted arrival at which the fingers start to close [s]."""
FOLLOW_SPEED = 1.2
"""Speed up to which the closing hand sinks with the hammer [m/s]."""
FOLLOW_TIME = 0.15
"""How long it does so before it slows down [s]."""
FOLLOW_UP, FOLLOW_DOWN = 30.0, 10.0
"""Acceleration and deceleration of that [m/s^2]."""
FINGER_LAG = 0.025
"""Time from the beginning of the sinking to the command to close [s]."""
CLOSE_TIME = 0.35
"""From the command to close until the hand counts as closed [s]."""
SETTLE_TIME = 0.35
"""How long the closed hand keeps still, while the hammer's pose in it is measured [s]."""
REACH = (0.16, 0.16, 0.0)
"""Half extents of the box around the start in which the wrist waits for the hammer [m]."""
TURN = 0.6
"""Largest turn from the start's orientation while waiting [rad]."""
MEMORY = 0.3
"""Share of a new measurement of the hammer's pose in the hand."""
GAP = 0.05
"""Height of the face above the nail when the hammer is brought over it [m]."""
ALIGN_TIME = 0.4
"""How long the hammer is held there, in place [s]."""
RAISE = 0.7
"""Angle by which the hammer is raised before a blow [rad]."""
THROUGH = 0.008
"""How far below the nail's head a blow is aimed [m]."""
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
    """What the phases look at, each (n,): time to arrival and in the phase [s], the wrist's errors [m], [rad]."""

    arrival: Float[Tensor, " n"]
    spent: Float[Tensor, " n"]
    position: Float[Tensor, " n"]
    angle: Float[Tensor, " n"]


def _none(t: Timing) -> Tensor:
    return torch.zeros_like(t.spent)


def _there(t: Timing) -> Tensor:
    return ((t.position < NEAR[0]) & (t.angle < NEAR[1])) | (t.spent > PATIENCE)


SWING_TIME = 2 * RAISE / SWING_SPIN
"""Duration of the accelerated swing [s]."""

PHASES: list[Stage[Timing]] = [
    Stage("wait", _none, lambda t: t.arrival <= LEAD),
    Stage("close", _none, lambda t: t.spent >= CLOSE_TIME),
    Stage("settle", _none, lambda t: t.spent >= SETTLE_TIME),
    Stage("align", _none, lambda t: _there(t) & (t.spent >= ALIGN_TIME), hold=12),
    Stage("raise", _none, _there, hold=2),
    Stage("swing", _none, lambda t: t.spent < 0, lost=lambda t: t.spent >= SWING_TIME + DWELL, back_to="raise"),
]
WAIT, CLOSE, SETTLE, ALIGN, RAISING, SWING = range(6)


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
        self._reach = torch.tensor(REACH, device=device)

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(num_envs, *shape, device=device)

        identity = torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(num_envs, 1)
        self.buffers = {
            "home_p": zeros(3), "home_q": identity.clone(), "lead_p": zeros(3), "lead_q": identity.clone(),
            "held_p": zeros(3), "held_q": identity.clone(), "spent": zeros(), "sinking": zeros(),
        }  # fmt: skip

    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts with the wrist where it is: it will wait at this height."""
        b = self.buffers
        for name in ("home", "lead"):
            b[f"{name}_p"][rows], b[f"{name}_q"][rows] = wrist_p, wrist_q
        for name in ("held_p", "spent", "sinking"):
            b[name][rows] = 0.0
        self.phase.reset(rows)

    def _arrival(self, s: HammerSnapshot) -> tuple[Tensor, Tensor, Tensor]:
        """Time (n,) until the candidate comes down to the hand's height [s], and the wrist pose to wait in."""
        b = self.buffers
        home_p, home_q = b["home_p"], b["home_q"]
        body, goal = (s.object_p, s.object_q), (s.goal_p, s.goal_q)
        time, position, quaternion = predict_goal(body, s.object_v, s.object_w, goal, home_p[:, 2])
        position = home_p + torch.clamp(position - home_p, -self._reach, self._reach)
        turn = rotation_vector_from_quaternion(quaternion_multiply(quaternion, quaternion_inverse(home_q)))
        turn = turn * (TURN / turn.norm(dim=-1, keepdim=True).clamp(min=TURN))
        return time, position, quaternion_multiply(quaternion_from_rotation_vector(turn), home_q)

    def target(self, s: HammerSnapshot) -> Target:
        """Where the candidate will be, until the fingers close; then where the reference has been led."""
        b, phase = self.buffers, self.phase.index
        waits = (phase == WAIT)[:, None]
        opened = waits | ((phase == CLOSE) & (b["spent"] < FINGER_LAG))[:, None]
        _, position, quaternion = self._arrival(s)
        return Target(
            torch.where(waits, position, b["lead_p"]),
            torch.where(waits, quaternion, b["lead_q"]),
            torch.where(opened, s.goal_pregrasp, s.goal_grasp),
        )

    def advance(self, s: HammerSnapshot) -> None:
        """Moves phase, measurement and lead on, once per control step."""
        b, before = self.buffers, self.phase.index.clone()
        arrival, wait_p, wait_q = self._arrival(s)
        b["spent"] += self.dt
        error = (b["lead_p"] - s.wrist_p).norm(dim=-1), rotation_angle(b["lead_q"], s.wrist_q)
        self.phase.advance(Timing(arrival, b["spent"], *error))
        now = self.phase.index
        b["spent"].masked_fill_(now != before, 0.0)
        self._measure(s, now)
        held: Pose = (b["held_p"], b["held_q"])
        lead = b["lead_p"], b["lead_q"]
        for phase, (position, quaternion) in {
            WAIT: (wait_p, wait_q),
            CLOSE: self._giving_way(lead),
            ALIGN: self._carried(lead, self._wrist(s, 0.0, GAP, held)),
            RAISING: self._carried(lead, self._wrist(s, RAISE, -THROUGH, held)),
            SWING: self._wrist(s, self._swung(), -THROUGH, held),
        }.items():
            here = (now == phase)[:, None]
            b["lead_p"].copy_(torch.where(here, position, b["lead_p"]))
            b["lead_q"].copy_(torch.where(here, quaternion, b["lead_q"]))

    def _measure(self, s: HammerSnapshot, now: Tensor) -> None:
        """Follows the hammer's pose in the hand: at once while it is caught, smoothly after, not while it strikes."""
        b = self.buffers
        share = torch.where(now <= CLOSE, 1.0, torch.where(now == SWING, 0.0, MEMORY))
        seen = relative((s.wrist_p, s.wrist_q), (s.object_p, s.object_q))
        held_p, held_q = blend((b["held_p"], b["held_q"]), seen, share)
        b["held_p"].copy_(held_p)
        b["held_q"].copy_(held_q)

    def _giving_way(self, lead: Pose) -> Pose:
        """The lead, sinking with the hammer for a moment, so that the fingers have time to close around it."""
        b = self.buffers
        faster, slower = b["sinking"] + FOLLOW_UP * self.dt, b["sinking"] - FOLLOW_DOWN * self.dt
        speed = torch.where(b["spent"] < FOLLOW_TIME, faster.clamp(max=FOLLOW_SPEED), slower.clamp(min=0))
        b["sinking"].copy_(torch.where(self.phase.index == CLOSE, speed, 0.0))
        down = torch.zeros_like(lead[0])
        down[:, 2] = b["sinking"] * self.dt
        return lead[0] - down, lead[1]

    def _carried(self, lead: Pose, goal: Pose) -> Pose:
        return slew(lead, goal, CARRY_SPEED * self.dt, CARRY_SPIN * self.dt)

    def _swung(self) -> Tensor:
        """Angle (n,) of the hammer in the next step of a swing: constant acceleration from RAISE to 0 [rad]."""
        share = ((self.buffers["spent"] + self.dt) / SWING_TIME).clamp(max=1)
        return RAISE * (1 - share.square())

    def _wrist(self, s: HammerSnapshot, raised: Tensor | float, gap: float, held: Pose) -> Pose:
        """Wrist pose that brings the held hammer there."""
        depth = s.nail_depth
        angle = torch.as_tensor(raised, device=depth.device).expand_as(depth)
        return compose(self.strike.hammer(depth, angle, gap), inverse(held))
