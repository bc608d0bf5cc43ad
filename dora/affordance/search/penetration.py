"""What a finished grasp is judged by: exact penetration of the object and of the hand itself."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.affordance.search.energies import GraspEnergy

DENSE = 1e-4
"""Sagitta [m] of the dense spheres: their union is at most this much thinner than the capsules."""
FIELD_ERROR = 2e-3
"""Bound [m] on the field's error near the surface; spheres farther away are not measured exactly."""


class Penetration:
    """Deepest overlap of the hand with the object, by exact distances at dense samples of the capsules' axes."""

    def __init__(self, hand: HandModel, field: SignedDistanceField) -> None:
        self.hand, self.field = hand, field
        self.spheres, self.radius = hand.sphere_set(sagitta=DENSE)

    def __call__(self, poses: Float[Tensor, "c b 4 4"]) -> Float[Tensor, " c"]:
        """Deepest overlap [m] of every row, at least 0; `poses` as of `HandModel.forward`."""
        centers = self.hand.place(poses, self.spheres)
        near = self.field.may_touch(centers, self.radius + FIELD_ERROR)
        points = centers.view(-1, 3)[near]
        close = self.field.sample(points, 1)[0][:, 0] < self.radius[near % len(self.radius)] + FIELD_ERROR
        near, points = near[close], points[close]
        exact = torch.as_tensor(self.field.exact(points.double().cpu().numpy())).to(points)
        depth = (self.radius[near % len(self.radius)] - exact).clamp_min(0)
        return depth.new_zeros(len(poses)).scatter_reduce_(0, near // len(self.radius), depth, "amax")


def self_penetration(energy: GraspEnergy, poses: Float[Tensor, "c b 4 4"]) -> Float[Tensor, " c"]:
    """Deepest overlap [m] of two capsules of the hand that may collide, at least 0."""
    row, _, _, _, gap = energy.close_pairs(poses)
    return gap.new_zeros(len(poses)).scatter_reduce_(0, row, (-gap).clamp_min(0), "amax")
