"""Exact penetration depths of a finished grasp: of the hand with the object, and of the hand with itself."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.affordance.search.energies import GraspEnergy

DENSE_SAGITTA = 1e-4
"""Sagitta of the dense spheres: their union is at most this much thinner than the capsules [m]."""
FIELD_ERROR = 2e-3
"""Bound on the field's error near the surface; spheres farther away are not measured exactly [m]."""


class Penetration:
    """Penetration depth of the hand in the object, by exact distances of dense spheres on the capsules' axes."""

    def __init__(self, hand: HandModel, field: SignedDistanceField) -> None:
        self.hand, self.field = hand, field
        self.spheres, self.radius = hand.sphere_set(sagitta=DENSE_SAGITTA)

    def __call__(self, poses: Float[Tensor, "c b 4 4"]) -> Float[Tensor, " c"]:
        """Largest penetration depth of every row, at least 0 [m]; `poses` as from `HandModel.forward`, object frame."""
        centers = self.hand.place(poses, self.spheres)
        near = self.field.may_touch(centers, self.radius + FIELD_ERROR)
        points = centers.view(-1, 3)[near]
        close = self.field.sample(points, 1)[0][:, 0] < self.radius[near % len(self.radius)] + FIELD_ERROR
        near, points = near[close], points[close]
        exact = torch.as_tensor(self.field.exact(points.double().cpu().numpy())).to(points)
        depth = (self.radius[near % len(self.radius)] - exact).clamp_min(0)
        return depth.new_zeros(len(poses)).scatter_reduce_(0, near // len(self.radius), depth, "amax")


def self_penetration(energy: GraspEnergy, poses: Float[Tensor, "c b 4 4"]) -> Float[Tensor, " c"]:
    """Largest penetration depth (c,) of two capsules of the hand that may collide, at least 0 [m]."""
    row, _, _, _, gap = energy.close_pairs(poses)
    return gap.new_zeros(len(poses)).scatter_reduce_(0, row, (-gap).clamp_min(0), "amax")
