"""Random hands around an object's centre, some of them deep inside it."""

import torch
from torch import Tensor

from dora.affordance.hand.hand_model import HandModel
from dora.geometry.rotations import matrix_from_rotation_vector

DOUBLE = torch.float64


def draw(hand: HandModel, seed: int = 0, count: int = 24, contacts: int = 8) -> tuple[Tensor, Tensor, Tensor]:
    """Wrists with the palm near the object's centre, joints up to a little beyond their limits, contacts."""
    generator = torch.Generator().manual_seed(seed)
    wrist = torch.eye(4, dtype=DOUBLE).repeat(count, 1, 1)
    turn = matrix_from_rotation_vector(2 * torch.randn(count, 3, generator=generator, dtype=DOUBLE))
    center = torch.tensor(hand.palm_frame.center + 0.04 * hand.palm_frame.normal)
    wrist[:, :3, :3] = turn
    wrist[:, :3, 3] = 0.03 * torch.randn(count, 3, generator=generator, dtype=DOUBLE) - turn @ center
    share = 1.1 * torch.rand(count, len(hand.lower), generator=generator, dtype=DOUBLE) - 0.05
    chosen = torch.randint(len(hand.contacts.body), (count, contacts), generator=generator)
    return wrist, hand.lower + (hand.upper - hand.lower) * share, chosen
