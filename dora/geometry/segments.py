"""Line segments as batched tensors."""

import torch
from jaxtyping import Float
from torch import Tensor


def distance_to_segment(
    points: Float[Tensor, "*#batch 3"], start: Float[Tensor, "*#batch 3"], end: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*out"]:
    """Distance of points from the line segments between two ends, all in one frame [m].

    Args:
        points: positions [m].
        start, end: of the segments [m]; where both are one point, the distance is that from it.
    """
    along, away = end - start, points - start
    square = along.square().sum(-1, keepdim=True).clamp_min(torch.finfo(along.dtype).tiny)
    share = ((away * along).sum(-1, keepdim=True) / square).clamp(0, 1)
    return (away - share * along).norm(dim=-1)
