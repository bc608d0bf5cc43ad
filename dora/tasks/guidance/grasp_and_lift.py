"""The reference that grasps and lifts: it follows the chosen candidate relative to the object as it is observed.

Approach at a standoff, descend, close the fingers, lift. The residual action changes it, see
`dora.tasks.guidance.residual_action`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.geometry.rotations import rotation_angle
from dora.tasks.guidance.reference import Reference
from dora.tasks.guidance.residual_action import Target
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage


@dataclass(frozen=True, kw_only=True)
class GraspSettings:
    """Numbers of the reference."""

    standoff: float = 0.10
    """Distance from the candidate's wrist position while approaching [m]."""
    descent: float = 0.15
    """Speed at which the standoff shrinks [m/s]."""
    closing_time: float = 0.6
    """Time from the pre-grasp to the closed hand [s]."""
    closed_time: float = 0.2
    """Time for which the hand is closed before it lifts [s]."""
    ascent: float = 0.16
    """Speed of the wrist while lifting [m/s]."""
    rise: float = 0.14
    """Total rise of the wrist [m]; more than any task asks the object to be lifted."""
    arrived: tuple[float, float] = (0.02, 0.15)
    """Wrist error that ends the approach [m], [rad]."""
    settled: tuple[float, float] = (0.008, 0.08)
    """Wrist error below which the hand may close [m], [rad]."""
    patience: float = 0.5
    """Time after which the hand closes although it has not settled [s]: something is in its way."""
    lost: float = 0.08
    """Distance of the wrist from the candidate's live goal at which a grasp has been lost [m]."""
    hover: float = 0.0
    """Height above the beginning of the approach that the wrist keeps for each radian it still has to turn [m/rad], so
    that a tall object is not swept over by the turning hand."""


@dataclass(frozen=True)
class Tracking:
    """What the phases look at: errors of the wrist against its last target, and the two ramps.

    `position` [m] and `angle` [rad] are (n,); `standoff` [m], `closing` in [0, 1]; `offset` is the distance of the
    wrist from the candidate's live goal [m]; `impatient` says that the wait at zero standoff has been long enough.
    """

    position: Float[Tensor, " n"]
    angle: Float[Tensor, " n"]
    standoff: Float[Tensor, " n"]
    closing: Float[Tensor, " n"]
    offset: Float[Tensor, " n"]
    impatient: Bool[Tensor, " n"]


APPROACH, DESCEND, CLOSE, LIFT = range(4)
"""Indices of the phases."""


def phases(c: GraspSettings) -> list[Stage[Tracking]]:
    """The phases, in order."""

    def within(t: Tracking, limits: tuple[float, float]) -> Tensor:
        return (t.position < limits[0]) & (t.angle < limits[1])

    def lost(t: Tracking) -> Tensor:
        return t.offset > c.lost

    return [
        Stage("approach", lambda t: within(t, c.arrived)),
        Stage("descend", lambda t: (t.standoff <= 0) & (within(t, c.settled) | t.impatient)),
        Stage("close", lambda t: t.closing >= 1, hold=c.closed_time, lost=lost, back_to="approach"),
        Stage("lift", lambda t: t.offset < 0, lost=lost, back_to="approach"),
    ]


class GraspReference(Reference):
    """Grasps the chosen candidate and lifts: ramps, the pose at which the wrist was latched, its last target."""

    def __init__(self, num_envs: int, dt: float, device: torch.device | str, settings: GraspSettings | None = None):
        self.settings = settings or GraspSettings()
        self.descent, self.hover = self.settings.descent, self.settings.hover
        super().__init__(
            phases(self.settings), num_envs, dt, device,
            standoff=(), closing=(), raised=(), waited=(), latched_p=(3,), latched_q=(4,), target_p=(3,), target_q=(4,),
        )  # fmt: skip

    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts anew at full standoff, hand open, in the environments `rows`; world wrist poses [m], wxyz."""
        self.buffers.clear(rows)
        self.buffers.write(rows, standoff=self.settings.standoff, target_p=wrist_p, target_q=wrist_q, latched_q=wrist_q)
        self.phase.reset(rows)

    def target(self, s: Snapshot) -> Target:
        """The candidate's live goal less the standoff until the fingers close, then where it was as they began, raised.

        World wrist pose [m], wxyz, and hand joints [rad] between the candidate's pre-grasp and grasp.
        """
        b, goal, phase = self.buffers, s.goal, self.phase.index
        free = goal.p - goal.approach * b.standoff[:, None]
        if self.settings.hover:
            still_to_turn = self.settings.hover * rotation_angle(goal.q, s.hand.wrist_q)
            free[:, 2] += torch.where(phase == APPROACH, still_to_turn, 0.0)
        up = torch.zeros_like(free)
        up[:, 2] = b.raised
        latched = (phase >= CLOSE)[:, None]
        hand = goal.pregrasp + (goal.grasp - goal.pregrasp) * b.closing[:, None]
        return Target(
            torch.where(latched, b.latched_p + up, free),
            torch.where(latched, b.latched_q, goal.q),
            hand,
        )

    def aim(self, target: Target) -> None:
        """Notes where the wrist is being sent; the phases compare the wrist's pose with it."""
        self.buffers.update(target_p=target.wrist_p, target_q=target.wrist_q)

    def advance(self, s: Snapshot) -> None:
        """Compares the wrist with its last target, changes phase, and moves the ramps on by a control step."""
        b, c, dt, before = self.buffers, self.settings, self.dt, self.phase.index.clone()
        self.phase.advance(
            Tracking(
                (b.target_p - s.hand.wrist_p).norm(dim=-1),
                rotation_angle(b.target_q, s.hand.wrist_q),
                b.standoff,
                b.closing,
                (s.goal.p - s.hand.wrist_p).norm(dim=-1),
                b.waited > c.patience - dt / 2,
            )
        )
        now = self.phase.index
        b.update(
            standoff=torch.where(now == DESCEND, (b.standoff - c.descent * dt).clamp(min=0), b.standoff),
            closing=torch.where(now == CLOSE, (b.closing + dt / c.closing_time).clamp(max=1), b.closing),
            raised=torch.where(now == LIFT, (b.raised + c.ascent * dt).clamp(max=c.rise), b.raised),
        )
        b.update(waited=torch.where((now == DESCEND) & (b.standoff <= 0), b.waited + dt, 0.0))
        entered = ((now == CLOSE) & (before != CLOSE))[:, None]
        b.update(
            latched_p=torch.where(entered, s.goal.p, b.latched_p), latched_q=torch.where(entered, s.goal.q, b.latched_q)
        )
        again = (now == APPROACH) & (before != APPROACH)
        b.standoff.masked_fill_(again, c.standoff)
        b.closing.masked_fill_(again, 0.0)
        b.raised.masked_fill_(again, 0.0)
