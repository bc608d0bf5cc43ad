"""Grasp candidates as a prior of the action: a closed-loop reference that the policy corrects.

The reference follows the chosen candidate relative to the *live* object: approach at a standoff, descend, close the
fingers, lift. The policy's action is a bounded correction in the hand frame around it,

    x_target = x_reference * exp(bound * c),    c <- c + SMOOTHING (a - c),

so that a = 0 executes the candidate and the policy only has to learn what the candidate gets wrong. The first-order
low-pass keeps exploration noise from shaking the fingers; c is part of the observation.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.robot.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_inverse,
    quaternion_multiply,
    rotation_angle,
    rotation_vector_from_quaternion,
)
from dora.tasks.presets import Preset
from dora.tasks.snapshot import Snapshot
from dora.tasks.stages import Stage, StageMachine

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
SMOOTHING = 0.3
"""Share of the new action in the low-passed correction."""
POSITION_BOUND = 0.03
"""Largest correction of the wrist along each axis [m]."""
ROTATION_BOUND = 0.2
"""Largest correction of the wrist about each axis [rad]."""
JOINT_BOUND = 0.3
"""Largest correction of a hand joint [rad]."""
ARRIVED = (0.02, 0.15)
"""Wrist error that ends the approach [m], [rad]."""
SETTLED = (0.008, 0.08)
"""Wrist error below which the hand may close [m], [rad]."""
PATIENCE = 10
"""Control steps after which the hand closes although it has not settled: something is in its way."""
GONE = 0.08
"""Distance of the wrist from the candidate's live goal at which a grasp has been lost [m]."""
ROTATION_WEIGHT = 0.1
"""Metres that one radian counts when candidates are compared [m/rad]."""


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


@dataclass(frozen=True)
class Target:
    """Where the reference sends the wrist (world pose, n rows) and the hand joints [rad]."""

    wrist_p: Float[Tensor, "n 3"]
    wrist_q: Float[Tensor, "n 4"]
    hand: Float[Tensor, "n 20"]


class GraspReference:
    """Per-environment state of the prior: chosen candidate with its error, ramps, phase, correction."""

    def __init__(self, candidates: GraspCandidates, num_envs: int, action_size: int, device: torch.device):
        self.candidates = candidates.to(device)
        self.phase = StageMachine(PHASES, num_envs, device)

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(num_envs, *shape, device=device)

        identity = torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(num_envs, 1)
        self.buffers = {
            "position": zeros(3), "quaternion": identity, "approach": zeros(3),
            "pregrasp": zeros(20), "grasp": zeros(20),
            "standoff": zeros(), "closing": zeros(), "raised": zeros(), "waited": zeros(),
            "latched_p": zeros(3), "latched_q": identity.clone(),
            "target_p": zeros(3), "target_q": identity.clone(), "correction": zeros(action_size),
        }  # fmt: skip

    def choose(
        self,
        env_idx: Int[Tensor, " b"],
        object_p: Float[Tensor, "b 3"],
        object_q: Float[Tensor, "b 4"],
        wrist_p: Float[Tensor, "b 3"],
        wrist_q: Float[Tensor, "b 4"],
        error: Float[Tensor, "b 26"],
        preset: Preset,
    ) -> None:
        """Gives each environment of `env_idx` the candidate nearest to its wrist, with the preset's error.

        `error` are independent uniform numbers in [-1, 1]: 3 for position, 3 for rotation, 20 for the joints.
        """
        c, b, k = self.candidates, len(env_idx), len(self.candidates)
        each = object_q[:, None].expand(b, k, 4)
        goal_p = object_p[:, None] + quaternion_apply(each, c.position.expand(b, k, 3))
        goal_q = quaternion_multiply(each, c.quaternion.expand(b, k, 4))
        away = (goal_p - wrist_p[:, None]).norm(dim=-1)
        turn = rotation_angle(goal_q, wrist_q[:, None].expand(b, k, 4))
        best = (away + ROTATION_WEIGHT * turn).argmin(-1)
        shift = preset.candidate_position * error[:, :3]
        tilt = quaternion_from_rotation_vector(preset.candidate_rotation * error[:, 3:6])
        bend = preset.candidate_joint * error[:, 6:]
        values = {
            "position": c.position[best] + shift,
            "quaternion": quaternion_multiply(c.quaternion[best], tilt),
            "approach": c.approach[best],
            "pregrasp": (c.pregrasp[best] + bend).clamp(min=0),
            "grasp": c.grasp[best] + bend,
            "standoff": torch.full_like(away[:, 0], STANDOFF),
            "target_p": wrist_p,
            "target_q": wrist_q,
        }
        for name, buffer in self.buffers.items():
            buffer[env_idx] = values.get(name, torch.zeros_like(buffer[env_idx]))
        self.buffers["latched_q"][env_idx] = wrist_q
        self.phase.reset(env_idx)

    def goal(self, object_p: Float[Tensor, "n 3"], object_q: Float[Tensor, "n 4"]) -> tuple[Tensor, Tensor]:
        """Wrist pose (n, 3), (n, 4) that the candidates ask for at the object's present pose."""
        b = self.buffers
        position = object_p + quaternion_apply(object_q, b["position"])
        return position, quaternion_multiply(object_q, b["quaternion"])

    def target(self, s: Snapshot) -> Target:
        """The uncorrected reference for the next control step; pure, moves nothing."""
        b, phase = self.buffers, self.phase.index
        approach = quaternion_apply(s.object_q, b["approach"])
        free = s.goal_p - approach * b["standoff"][:, None]
        up = torch.zeros_like(free)
        up[:, 2] = b["raised"]
        latched = (phase >= CLOSE)[:, None]
        hand = b["pregrasp"] + (b["grasp"] - b["pregrasp"]) * b["closing"][:, None]
        return Target(
            torch.where(latched, b["latched_p"] + up, free),
            torch.where(latched, b["latched_q"], s.goal_q),
            hand,
        )

    def corrected(self, target: Target, action: Float[Tensor, "n a"], expand: Callable[[Tensor], Tensor]) -> Target:
        """The reference plus the low-passed, bounded correction; stores both for the next step.

        `expand` maps the action's hand part to (n, 20).
        """
        b = self.buffers
        c = b["correction"] + SMOOTHING * (action - b["correction"])
        turn = quaternion_from_rotation_vector(ROTATION_BOUND * c[:, 3:6])
        out = Target(
            target.wrist_p + quaternion_apply(target.wrist_q, POSITION_BOUND * c[:, :3]),
            quaternion_multiply(target.wrist_q, turn),
            target.hand + JOINT_BOUND * expand(c[:, 6:]),
        )
        b["correction"].copy_(c)
        self.aim(out)
        return out

    def aim(self, target: Target) -> None:
        """Notes where the wrist is being sent; the phases compare the wrist's pose with it."""
        self.buffers["target_p"].copy_(target.wrist_p)
        self.buffers["target_q"].copy_(target.wrist_q)

    def advance(self, s: Snapshot) -> None:
        """Moves phases and ramps on, once per control step."""
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

    def get_state(self) -> dict[str, Tensor]:
        """Everything that changes during an episode, each (n, ...), for state dicts."""
        return {k: v.clone() for k, v in self.buffers.items()} | self.phase.get_state()

    def set_state(self, state: dict[str, Tensor], env_idx: Tensor | slice) -> None:
        """Inverse of `get_state` for the rows `env_idx`."""
        for name, buffer in self.buffers.items():
            buffer[env_idx] = state[name].reshape(buffer[env_idx].shape)
        self.phase.set_state(state, env_idx)


def wrist_step(
    target_p: Float[Tensor, "n 3"],
    target_q: Float[Tensor, "n 4"],
    from_p: Float[Tensor, "n 3"],
    from_q: Float[Tensor, "n 4"],
    limits: tuple[float, float],
) -> Float[Tensor, "n 6"]:
    """World-frame wrist step towards a target, as a normalised action in [-1, 1]^6.

    Translation and rotation are each shortened to `limits` ([m], [rad] per control step), direction kept.
    """
    shift = (target_p - from_p) / limits[0]
    turn = quaternion_multiply(target_q, quaternion_inverse(from_q))
    spin = rotation_vector_from_quaternion(turn) / limits[1]
    return torch.cat([v / v.norm(dim=-1, keepdim=True).clamp(min=1) for v in (shift, spin)], -1)
