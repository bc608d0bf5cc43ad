"""From which side the opened hand gets to a grasp: the direction nearest to the palm's that is free."""

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
    """Turn the approach of candidates whose opened hand would run into the object.

    Tried are the 26 directions from the middle of a cube of 3 x 3 x 3 cells to the others, along the axes of the
    wrist, those first that are nearest to the candidate's own approach; none that points backwards.

    Args:
        candidates: c of them.
        reach: of the same robot and object; judges by `hits_object`.

    Returns:
        The candidates with other approaches, and which are free (c,); those that are not keep their own.

    Raises:
        InputError: Pinocchio or Coal is not installed.
    """
    steps = [step for step in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(step)]
    directions = torch.nn.functional.normalize(torch.tensor(steps), dim=1)
    own = quaternion_apply(quaternion_inverse(candidates.quaternion), candidates.approach)
    likeness, order = (own @ directions.T).sort(dim=1, descending=True)
    approach, free = candidates.approach.clone(), ~reach.hits_object(candidates)
    for rank in range(len(directions)):
        rows = (~free & (likeness[:, rank] > 0)).nonzero().squeeze(1)
        if len(rows) == 0:
            break
        turned = quaternion_apply(candidates.quaternion[rows], directions[order[rows, rank]])
        clear = ~reach.hits_object(replace(candidates.select(rows), approach=turned))
        approach[rows[clear]] = turned[clear]
        free[rows[clear]] = True
    return replace(candidates, approach=approach), free
