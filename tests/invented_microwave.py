"""Snapshots of DoraMicrowave-v1 that no simulator has made."""

from typing import Any

import torch
from invented import GOAL_SHAPES, HAND_SHAPES, OBJECT_SHAPES, SHARED_SHAPES, TIP_RADIUS, record
from torch import Tensor

from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
)
from dora.tasks.mdp.snapshot import GoalState, HandState, ObjectState
from dora.tasks.microwave.snapshot import LEFT, RIGHT, MicrowaveSnapshot
from dora.tasks.microwave.task import oven_mount

OVEN = (0.7, 0.05, 0.1)
"""Where the invented microwave stands [m]."""
YAW = 0.15
"""How it is turned [rad]."""


def turned(angle: float, n: int = 2) -> Tensor:
    """Orientation (n, 4) after a turn about the vertical [rad]."""
    return quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, angle]]).repeat(n, 1))


def in_world(*local: float, n: int = 2) -> Tensor:
    """A point of the microwave's frame in the world (n, 3) [m]."""
    return torch.tensor(OVEN) + quaternion_apply(turned(YAW, n), torch.tensor([local]).repeat(n, 1))


def invented(
    left: dict[str, Any] | None = None,
    right: dict[str, Any] | None = None,
    handle: dict[str, Any] | None = None,
    cube: dict[str, Any] | None = None,
    goals: dict[str, dict[str, Any]] | None = None,
    n: int = 2,
    **given: Any,
) -> MicrowaveSnapshot:
    """A snapshot of zeros and unit quaternions with a shut microwave, and what is given of each record."""
    tips = {"tip_radius": TIP_RADIUS}
    half = {"half": torch.full((n, 3), 0.03)}
    hands = {
        LEFT: record(HandState, HAND_SHAPES, n, tips | (left or {})),
        RIGHT: record(HandState, HAND_SHAPES, n, tips | (right or {})),
    }
    shut = torch.tensor(oven_mount().object_link.quaternion)
    objects = {
        "microwave": record(ObjectState, OBJECT_SHAPES, n, half | (handle or {})),
        "cube": record(ObjectState, OBJECT_SHAPES, n, half | (cube or {})),
    }
    own = {
        "oven_p": torch.tensor(OVEN).repeat(n, 1), "oven_q": turned(YAW, n), "door": torch.zeros(n),
        "door_speed": torch.zeros(n), "wrists": torch.stack([hand.wrist_p for hand in hands.values()], 1),
        "tips_of_placer": hands[RIGHT].tip_p, "cube_p": objects["cube"].p,
        "bar": torch.tensor([[0.03, 0.0, -0.09], [0.03, 0.0, 0.09]]), "bar_radius": 0.008, "shut_q": shut,
    }  # fmt: skip
    records = {
        "hands": hands,
        "objects": objects,
        "goals": {arm: record(GoalState, GOAL_SHAPES, n, (goals or {}).get(arm, {})) for arm in hands},
        "handles": {LEFT: "microwave", RIGHT: "cube"},
        "stages": {LEFT: torch.zeros(n, dtype=torch.long), RIGHT: torch.zeros(n, dtype=torch.long)},
    }
    return record(MicrowaveSnapshot, SHARED_SHAPES, n, records | own | given)


def out(n: int = 2) -> dict[str, Tensor]:
    """A right hand in front of the microwave."""
    return {"wrist_p": in_world(-0.2, 0.0, 0.1, n=n), "tip_p": in_world(-0.05, 0.0, 0.1, n=n)[:, None].repeat(1, 5, 1)}
