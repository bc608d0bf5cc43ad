"""Guidance: what affordances and grasp candidates add to a task, part by part, and the reference that grasps.

The grasp reference follows the chosen candidate relative to the *live* object as it is observed: approach at a
standoff, descend, close the fingers, lift. The policy corrects it, see `dora.tasks.guidance.residual_action`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.errors import InputError
from dora.geometry.rotations import rotation_angle
from dora.tasks.guidance.candidate_choice import Choice
from dora.tasks.guidance.reference import Reference
from dora.tasks.guidance.residual_action import ResidualAction, Target
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage

STANDOFF = 0.10
"""Distance from the candidate's wrist position while approaching [m]."""
DESCENT = 0.0075
"""Shortening of the standoff per control step [m]."""
CLOSING_STEPS = 12
"""Control steps from the pre-grasp to the closed hand."""
ASCENT = 0.008
"""Rise of the wrist per control step while lifting [m]."""
RISE = 0.14
"""Total rise of the wrist [m]; more than any task asks the object to be lifted."""
ARRIVED = (0.02, 0.15)
"""Wrist error that ends the approach [m], [rad]."""
SETTLED = (0.008, 0.08)
"""Wrist error below which the hand may close [m], [rad]."""
PATIENCE = 10
"""Control steps after which the hand closes although it has not settled: something is in its way."""
GONE = 0.08
"""Distance of the wrist from the candidate's live goal at which a grasp has been lost [m]."""


@dataclass(frozen=True)
class Tracking:
    """What the phases look at: errors of the wrist against its last target, and the two ramps.

    `position` [m] and `angle` [rad] are (n,); `standoff` [m], `closing` in [0, 1]; `offset` is the distance of the
    wrist from the candidate's live goal [m]; `waited` counts control steps at zero standoff.
    """

    position: Float[Tensor, " n"]
    angle: Float[Tensor, " n"]
    standoff: Float[Tensor, " n"]
    closing: Float[Tensor, " n"]
    offset: Float[Tensor, " n"]
    waited: Float[Tensor, " n"]


def _none(t: Tracking) -> Tensor:
    return torch.zeros_like(t.position)


def _within(t: Tracking, tolerance: tuple[float, float]) -> Tensor:
    return (t.position < tolerance[0]) & (t.angle < tolerance[1])


PHASES: list[Stage[Tracking]] = [
    Stage("approach", _none, lambda t: _within(t, ARRIVED)),
    Stage("descend", _none, lambda t: (t.standoff <= 0) & (_within(t, SETTLED) | (t.waited >= PATIENCE))),
    Stage("close", _none, lambda t: t.closing >= 1, hold=4, lost=lambda t: t.offset > GONE, back_to="approach"),
    Stage("lift", _none, lambda t: t.offset < 0, lost=lambda t: t.offset > GONE, back_to="approach"),
]
APPROACH, DESCEND, CLOSE, LIFT = range(4)


class GraspReference(Reference):
    """Grasps the chosen candidate and lifts: ramps, the pose at which the wrist was latched, its last target.

    Args:
        num_envs: number of environments.
        device: where the buffers are.
        hover: height above the beginning of the approach that the wrist keeps for each radian it still has to turn
            [m/rad], so that a tall object is not swept over by the turning hand.
    """

    PHASES = PHASES

    def __init__(self, num_envs: int, device: torch.device, hover: float = 0.0):
        super().__init__(num_envs, device)
        self.hover = hover

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(num_envs, *shape, device=device)

        self.buffers = {
            "standoff": zeros(), "closing": zeros(), "raised": zeros(), "waited": zeros(),
            "latched_p": zeros(3), "latched_q": zeros(4), "target_p": zeros(3), "target_q": zeros(4),
        }  # fmt: skip

    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts anew at full standoff, hand open, in the environments `rows`; world wrist poses [m], wxyz."""
        for buffer in self.buffers.values():
            buffer[rows] = 0.0
        self.buffers["standoff"][rows] = STANDOFF
        self.buffers["target_p"][rows] = wrist_p
        self.buffers["target_q"][rows] = wrist_q
        self.buffers["latched_q"][rows] = wrist_q
        self.phase.reset(rows)

    def target(self, s: Snapshot) -> Target:
        """The candidate's live goal less the standoff until the fingers close, then where the wrist was, raised.

        World wrist pose [m], wxyz, and hand joints [rad] between the candidate's pre-grasp and grasp.
        """
        b, phase = self.buffers, self.phase.index
        free = s.goal_p - s.goal_approach * b["standoff"][:, None]
        if self.hover:
            free[:, 2] += torch.where(phase == APPROACH, self.hover * rotation_angle(s.goal_q, s.wrist_q), 0.0)
        up = torch.zeros_like(free)
        up[:, 2] = b["raised"]
        latched = (phase >= CLOSE)[:, None]
        hand = s.goal_pregrasp + (s.goal_grasp - s.goal_pregrasp) * b["closing"][:, None]
        return Target(
            torch.where(latched, b["latched_p"] + up, free),
            torch.where(latched, b["latched_q"], s.goal_q),
            hand,
        )

    def aim(self, target: Target) -> None:
        """Notes where the wrist is being sent; the phases compare the wrist's pose with it."""
        self.buffers["target_p"].copy_(target.wrist_p)
        self.buffers["target_q"].copy_(target.wrist_q)

    def advance(self, s: Snapshot) -> None:
        """Compares the wrist with its last target, changes phase, and moves the ramps on by a control step."""
        b, before = self.buffers, self.phase.index.clone()
        offset = (s.goal_p - s.wrist_p).norm(dim=-1)
        tracking = Tracking(
            (b["target_p"] - s.wrist_p).norm(dim=-1),
            rotation_angle(b["target_q"], s.wrist_q),
            b["standoff"],
            b["closing"],
            offset,
            b["waited"],
        )
        self.phase.advance(tracking)
        now = self.phase.index
        b["standoff"].copy_(torch.where(now == DESCEND, (b["standoff"] - DESCENT).clamp(min=0), b["standoff"]))
        b["closing"].copy_(torch.where(now == CLOSE, (b["closing"] + 1 / CLOSING_STEPS).clamp(max=1), b["closing"]))
        b["raised"].copy_(torch.where(now == LIFT, (b["raised"] + ASCENT).clamp(max=RISE), b["raised"]))
        b["waited"].copy_(torch.where((now == DESCEND) & (b["standoff"] <= 0), b["waited"] + 1, 0.0))
        entered = ((now == CLOSE) & (before != CLOSE))[:, None]
        b["latched_p"].copy_(torch.where(entered, s.goal_p, b["latched_p"]))
        b["latched_q"].copy_(torch.where(entered, s.goal_q, b["latched_q"]))
        again = (now == APPROACH) & (before != APPROACH)
        b["standoff"].masked_fill_(again, STANDOFF)
        b["closing"].masked_fill_(again, 0.0)
        b["raised"].masked_fill_(again, 0.0)


class Guide:
    """The parts of guidance that a task has in force, and what they work with.

    Args:
        parts: which of `dora.tasks.mdp.guidance_parts.PARTS`.
        choice: the candidates in use.
        reference: leads the hand.
        correction: what the action does to the reference.
    """

    def __init__(self, parts: Iterable[str], choice: Choice, reference: Reference, correction: ResidualAction):
        self.parts = frozenset(parts)
        self.choice, self.reference, self.correction = choice, reference, correction

    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts reference and correction anew in the environments `rows`, whose candidates have been chosen."""
        self.reference.begin(rows, wrist_p, wrist_q)
        self.correction.begin(rows)

    def corrected(self, s: Snapshot, action: Float[Tensor, "n a"], expand: Callable[[Tensor], Tensor]) -> Target:
        """Where the hand goes in the next control step; `expand` maps the action's hand part to (n, 20)."""
        target = self.correction.apply(self.reference.target(s), action.clamp(-1, 1), expand)
        self.reference.aim(target)
        return target

    def anneal(self, bounds: float | None = None, error: float | None = None) -> None:
        """Sets the shares of the correction's bounds and of the candidates' error that are in force from now on.

        Raises:
            InputError: for a share outside [0, 1].
        """
        if bounds is not None:
            self.correction.set_scale(bounds)
        if error is not None:
            if not 0 <= error <= 1:
                raise InputError(f"the share of the candidates' error is {error}; it has to be between 0 and 1")
            self.choice.error_scale = error

    def get_state(self) -> dict[str, Tensor]:
        """Everything that changes during an episode, each (n, ...), for state dicts."""
        return self.choice.get_state() | self.reference.get_state() | self.correction.get_state()

    def set_state(self, state: dict[str, Tensor], rows: Tensor | slice) -> None:
        """Inverse of `get_state` for the given rows."""
        for part in (self.choice, self.reference, self.correction):
            part.set_state(state, rows)
