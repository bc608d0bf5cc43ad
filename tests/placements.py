"""Places of objects and grasps around them, for the tests of reach."""

import functools
import math

import torch

from dora.affordance.candidates import GraspCandidates
from dora.affordance.reach.approach_paths import HAND_TABLE
from dora.affordance.reach.feasibility import Reach
from dora.geometry.rotations import quaternion_apply, quaternion_multiply

GRASPED = (0.06, 0.006, 0.12)
"""Middle of what a hand holds, in the wrist frame [m]."""


def yaws(angles):
    half = torch.as_tensor(angles, dtype=torch.float32) / 2
    return torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], -1)


def grasps(robot, obj, count, seed=0):
    """Wrists all around the part to hold, with a half open hand that moves in between palm and fingers."""
    generator = torch.Generator().manual_seed(seed)
    turn = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    grasped = torch.tensor(GRASPED) + 0.02 * torch.randn(count, 3, generator=generator)
    forward = torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    hand = torch.tensor(robot.postures["home"].hand, dtype=torch.float32).expand(count, -1)
    held = torch.tensor(obj.centroid(obj.target), dtype=torch.float32)
    return GraspCandidates(
        obj.name, held - quaternion_apply(turn, grasped), turn, quaternion_apply(turn, forward.expand(count, 3)),
        hand, hand + 0.2, ("BodyGrasp",) * count,
    )  # fmt: skip


@functools.cache
def clear_grasps(robot, obj, count):
    """Those that neither hit the table nor the object."""
    reach, every = Reach(robot, obj), grasps(robot, obj, 1200)
    here = reach.filter(every, torch.tensor([[0.45, 0.0, obj.support]]), torch.tensor([obj.rest]), exact=False)
    every = every.select(here.reason[0] != HAND_TABLE)
    return every.select(~reach.hits_object(every)).select(slice(0, count))


def standing(obj, places, angles):
    p = torch.tensor([[x, y, obj.support] for x, y in places])
    return p, quaternion_multiply(yaws(angles), torch.tensor(obj.rest).expand(len(p), 4))


def scattered(obj, count, seed=1, half=0.08):
    generator = torch.Generator().manual_seed(seed)
    xy = torch.tensor([0.45, 0.0]) + half * (2 * torch.rand(count, 2, generator=generator) - 1)
    return standing(obj, xy.tolist(), 2 * math.pi * torch.rand(count, generator=generator))
