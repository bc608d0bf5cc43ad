"""What DoraHammer-v1 observes beyond the common entries."""

import torch
from torch import Tensor

from dora.tasks.hammer.snapshot import (
    HammerSnapshot,
    face_to_nail,
    handle_axis,
    nail_in_hand,
    striking_axis,
    tip_distance,
)
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.quantities import turned_in_wrist


def _nail_axis(s: HammerSnapshot) -> Tensor:
    down = torch.tensor([0.0, 0.0, -1.0], device=s.hand.wrist_p.device)
    return turned_in_wrist(s, down.expand_as(s.hand.wrist_p))


def _axes(s: HammerSnapshot) -> Tensor:
    return torch.cat([striking_axis(s), handle_axis(s)], -1)


def _nail_depths(s: HammerSnapshot) -> Tensor:
    return torch.stack([s.nail_depth, s.nail_driven], -1) * 100


def _drifts(s: HammerSnapshot) -> Tensor:
    return torch.stack([s.drift_p.clamp(max=0.1) * 10, s.drift_r.clamp(max=1)], -1)


OBSERVATIONS: dict[str, Entry] = {
    "length": Entry(lambda s: s.object.half[:, 2:], "m", "half length of the hammer"),
    "nail": Entry(nail_in_hand, "m", "the nail's head in the hand frame"),
    "nail_depth": Entry(_nail_depths, "cm", "depth of the nail, and how much of it blows have driven"),
    "drift": Entry(_drifts, "dm, rad", "motion of the hammer in the hand within the window of the task (`window`)"),
    "handle": Entry(tip_distance, "m", "distance of each fingertip's surface from the handle's", True, region=True),
    "face": Entry(face_to_nail, "m", "striking face to the nail's head, world frame", True, region=True),
    "axes": Entry(_axes, "1", "striking and handle axis, world frame", True, region=True),
    "nail_axis": Entry(_nail_axis, "1", "nail axis in the hand frame", True, region=True, sensed=True),
}
"""What the task observes beyond the common entries; the guided ones are the affordance frame."""
TURN_OBSERVATIONS: dict[str, Entry] = {
    "turned": Entry(
        lambda s: torch.stack([s.turned, s.way], -1), "rad, 1", "turn in the hand so far, and which way it has to go"
    )
}
"""What it observes besides where the fingers re-orient the hammer."""
