"""In-hand re-orientation: the hammer arrives turned about its handle, and the fingers turn it in the hand."""

from dataclasses import dataclass
from math import pi
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.candidates import GraspCandidates, concatenate
from dora.errors import InputError
from dora.geometry.poses import Pose, compose
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_inverse, quaternion_multiply

COPIES = 3
"""Copies of each candidate to either side, turned about the handle by angles between those of the release [1]."""


@dataclass(frozen=True, kw_only=True)
class TurnSettings:
    """Numbers of in-hand re-orientation."""

    arrives: tuple[float, float] = (pi / 4, pi / 2)
    """Smallest and largest angle by which it is turned about its handle at the release, to either side [rad]."""
    least: float = pi * 40 / 180
    """Angle by which the fingers must turn it about its handle, relative to the palm, towards the blow [rad]."""
    hold_time: float = 0.1
    """Time for which it must be turned so far [s]."""
    weight: float = 1.0
    """Weight of the reward for the share of that turn [1]."""

    def __post_init__(self) -> None:
        low, high = self.arrives
        if not (0 <= low <= high <= pi and high > 0):
            raise InputError(
                f"turn.arrives is {low:g}, {high:g}; it has to be two angles from 0 to pi, the larger last."
            )
        if not 0 < self.least <= pi:
            raise InputError(f"turn.least is {self.least:g}; it has to be an angle above 0 and up to pi.")


def turn_about_handle(before: Float[Tensor, "n 4"], now: Float[Tensor, "n 4"]) -> Float[Tensor, " n"]:
    """By how much the hammer has turned about its handle, its own z axis, between two orientations [rad].

    The twist of the rotation between them about z, in (-pi, pi]; both relative to the palm, or both in the world.
    """
    change = quaternion_multiply(quaternion_inverse(before), now)
    turn = 2 * torch.atan2(change[..., 3], change[..., 0])
    return (turn + pi) % (2 * pi) - pi


def roll_at_release(u: Float[Tensor, " b"], c: TurnSettings) -> Float[Tensor, " b"]:
    """Turn about the handle at the release [rad] for numbers in [-1, 1], whose sign is the side."""
    low, high = c.arrives
    return torch.where(u < 0, -1.0, 1.0) * (low + u.abs() * (high - low))


def number_of_roll(roll: float, c: TurnSettings) -> float:
    """Inverse of `roll_at_release`; the nearest number for turns that do not occur."""
    low, high = c.arrives
    size = (abs(roll) - low) / (high - low) if high > low else 0.0
    return min(max(size, 0.0), 1.0) * (-1 if roll < 0 else 1)


def turned_copies(candidates: GraspCandidates, axis: tuple[float, float], c: TurnSettings) -> GraspCandidates:
    """Candidates with which the hand takes the turned hammer as if it were not turned: copies of each, turned about the
    handle against the turns of the release.

    Args:
        candidates: of the hammer.
        axis: x and y of the handle's axis, hammer frame [m].
        c: numbers of the turn.
    """
    angles = torch.linspace(*c.arrives, COPIES).tolist()
    return concatenate([_turned(candidates, axis, -side * angle) for side in (-1, 1) for angle in angles])


def _turned(candidates: GraspCandidates, axis: tuple[float, float], angle: float) -> GraspCandidates:
    on_axis = candidates.position.new_tensor([*axis, 0.0])
    turn = quaternion_from_rotation_vector(candidates.position.new_tensor([0.0, 0.0, angle]))
    about: Pose = torch.zeros_like(candidates.position), turn.expand(len(candidates), 4)
    position, quaternion = compose(about, (candidates.position - on_axis, candidates.quaternion))
    approach, _ = compose(about, (candidates.approach, candidates.quaternion))
    changed: dict[str, Any] = {"position": position + on_axis, "quaternion": quaternion, "approach": approach}
    return candidates.with_tensors(candidates.tensors() | changed, candidates.grasp_class)
