"""Approach directions on which the opened hand does not hit the object, as near as possible to the candidate's own."""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.reach.feasibility import Reach
from dora.geometry.rotations import quaternion_apply, quaternion_inverse


def free_approaches(candidates: GraspCandidates, reach: Reach) -> tuple[GraspCandidates, Bool[Tensor, " c"]]:
    """Change the approach of candidates whose opened hand would hit the object.

    The 26 directions to the neighbours in a 3 x 3 x 3 grid along the axes of the wrist are tried, in ascending order
    of their angle to the candidate's own approach, up to a right angle.

    Args:
        candidates: c candidates.
        reach: filter of the same robot and object, whose `hits_object` decides.

    Returns:
        The candidates with new approaches, and a mask (c,) of those with a free one; the others keep their own.

    Raises:
        InputError: Pinocchio or Coal is not installed.
    """
    steps = [step for step in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(step)]
    directions = torch.nn.functional.normalize(torch.tensor(steps), dim=1)
    own = quaternion_apply(quaternion_inverse(candidates.quaternion), candidates.approach)
    likeness, order = (own @ directions.T).sort(dim=1, descending=True)
    approach, free = candidates.approach.clone(), ~reach.hits_object(candidates)
    for column in range(len(directions)):
        rows = (~free & (likeness[:, column] > 0)).nonzero().squeeze(1)
        if len(rows) == 0:
            break
        turned = quaternion_apply(candidates.quaternion[rows], directions[order[rows, column]])
        clear = ~reach.hits_object(replace(candidates.select(rows), approach=turned))
        approach[rows[clear]] = turned[clear]
        free[rows[clear]] = True
    return replace(candidates, approach=approach), free
