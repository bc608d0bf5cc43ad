"""The observation as a table: name, function of the snapshot, size, unit and meaning of every entry."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dora.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_apply,
    quaternion_inverse,
    quaternion_multiply,
)
from dora.tasks.mdp.guidance_parts import OBSERVATION, PRIOR
from dora.tasks.mdp.snapshot import Snapshot, goal_error, in_wrist, lifted, near_errors, turned_in_wrist

FASTEST_SPIN = 30.0
"""Spin of an object that is still told apart, about each axis [rad/s]; a slender one that is hit spins faster."""


@dataclass(frozen=True)
class Entry:
    """One part of the observation.

    Attributes:
        value: snapshot -> (n, k) tensor.
        unit: unit of the values, "1" if dimensionless.
        doc: what it is, for the documentation table.
        guided: True if it exists only with guidance.
        prior: True if it is about the reference that the action corrects, and exists only with that part of guidance;
            all other guided entries belong to the part "observation".
    """

    value: Callable[[Any], Tensor]
    unit: str
    doc: str
    guided: bool = False
    prior: bool = False

    def exists(self, parts: frozenset[str]) -> bool:
        """Whether the entry exists with these parts of guidance."""
        return not self.guided or (PRIOR if self.prior else OBSERVATION) in parts


def _object_spin(s: Snapshot) -> Tensor:
    return turned_in_wrist(s, s.object_w).clamp(-FASTEST_SPIN, FASTEST_SPIN)


def _axes(q: Tensor) -> Tensor:
    """(n, 6): first two columns of the rotation matrix, a continuous encoding of orientation."""
    return matrix_from_quaternion(q)[..., :2].flatten(-2)


def _tips(s: Snapshot) -> Tensor:
    n = len(s.tip_p)
    wrist = [s.wrist_p, s.wrist_q]
    p, q = (x[:, None].expand(n, 5, x.shape[-1]).reshape(n * 5, -1) for x in wrist)
    return quaternion_apply(quaternion_inverse(q), s.tip_p.reshape(n * 5, 3) - p).reshape(n, 15)


def _tip_directions(s: Snapshot) -> Tensor:
    return matrix_from_quaternion(s.tip_q)[..., 2].flatten(-2)


def _object_turn(s: Snapshot) -> Tensor:
    return _axes(quaternion_multiply(quaternion_inverse(s.wrist_q), s.object_q))


OBSERVATIONS: dict[str, Entry] = {
    "hand_q": Entry(lambda s: s.hand_q, "rad", "hand joint angles, thumb to pinky"),
    "hand_v": Entry(lambda s: s.hand_v, "rad/s", "hand joint velocities"),
    "hand_lead": Entry(lambda s: s.hand_target - s.hand_q, "rad", "commanded minus measured hand joints"),
    "arm_q": Entry(lambda s: s.arm_q, "rad", "arm joint angles"),
    "tips": Entry(_tips, "m", "fingertip positions in the hand frame"),
    "tip_axes": Entry(_tip_directions, "1", "fingertip directions (tip z axes), world frame"),
    "wrist_p": Entry(lambda s: s.wrist_p, "m", "wrist position, world frame"),
    "wrist_R": Entry(lambda s: _axes(s.wrist_q), "1", "wrist orientation, two columns of its matrix"),
    "wrist_v": Entry(lambda s: s.wrist_v, "m/s", "wrist linear velocity, world frame"),
    "wrist_w": Entry(lambda s: s.wrist_w, "rad/s", "wrist angular velocity, world frame"),
    "object_p": Entry(lambda s: in_wrist(s, s.object_p), "m", "object position in the hand frame"),
    "object_R": Entry(_object_turn, "1", "object orientation in the hand frame, two columns of its matrix"),
    "object_v": Entry(lambda s: turned_in_wrist(s, s.object_v), "m/s", "object velocity in the hand's axes"),
    "object_w": Entry(_object_spin, "rad/s", f"object spin in the hand's axes, clipped at {FASTEST_SPIN:g}"),
    "object_rise": Entry(lambda s: lifted(s)[:, None], "m", "height of the object above its start"),
    "touch": Entry(lambda s: s.touch.float(), "1", "contact of thumb, index, middle, ring, pinky, palm"),
    "max_penetration": Entry(
        lambda s: s.max_penetration[:, None] * 1000, "mm", "deepest penetration of the episode so far"
    ),
    "stage": Entry(lambda s: s.stage[:, None].float(), "1", "index of the active stage"),
    "time": Entry(lambda s: s.time[:, None], "1", "share of the episode that is over"),
    "goal": Entry(
        lambda s: torch.cat(goal_error(s), -1),
        "m, rad",
        "wrist to candidate: position and rotation vector",
        True,
    ),
    "goal_hand": Entry(lambda s: s.goal_grasp - s.hand_q, "rad", "candidate's closed hand minus measured joints", True),
    "near": Entry(
        lambda s: near_errors(s)[:, 1:].flatten(1),
        "m, rad",
        "wrist to the next nearest candidates: position and rotation vector of each",
        True,
    ),
    "phase": Entry(lambda s: s.phase, "1", "phase of the reference", True, True),
    "correction": Entry(lambda s: s.correction, "1", "low-passed correction, in units of the bounds", True, True),
}
