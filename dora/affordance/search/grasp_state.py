"""What a differentiable energy may depend on: poses, points, distances and normals of candidates as torch tensors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.signed_distance import CHANNELS, SignedDistanceField
from dora.affordance.search.energies import SMALLEST_LENGTH, GraspEnergy, Table


@dataclass(frozen=True, eq=False)
class GraspState:
    """c candidates with k contact points each, in the object frame [m]; what is asked for is computed, once.

    All floating tensors are differentiable with respect to `wrist` and `joints`.

    Attributes:
        energy: the energy; its hand, object and table are those of the candidates.
        wrist: (c, 4, 4) pose of the wrist [m].
        joints: (c, a) actuated joints [rad].
        contacts: (c, k) indices into `hand.contacts` of the points that should touch.
    """

    energy: GraspEnergy
    wrist: Float[Tensor, "c 4 4"]
    joints: Float[Tensor, "c a"]
    contacts: Int[Tensor, "c k"]

    @property
    def hand(self) -> HandModel:
        """The hand."""
        return self.energy.hand

    @property
    def field(self) -> SignedDistanceField:
        """The object's distance field, not differentiable by itself; see `signed_distance`."""
        return self.energy.field

    @property
    def table(self) -> Table | None:
        """The table on which the object rests; None if it is free."""
        return self.energy.table

    @cached_property
    def angles(self) -> Float[Tensor, "c j"]:
        """Angles of all joints, coupled ones included, as `HandModel.all_joints` [rad]."""
        return self.hand.all_joints(self.joints)

    @cached_property
    def _both(self) -> Tensor:
        joints = torch.cat((self.joints, self.joints + self.energy.close))
        return self.hand.forward(torch.cat((self.wrist, self.wrist)), joints)

    @property
    def poses(self) -> Float[Tensor, "c b 4 4"]:
        """Poses of the bodies `hand.links` [m]."""
        return self._both[: len(self.joints)]

    @property
    def closed_poses(self) -> Float[Tensor, "c b 4 4"]:
        """Poses of the bodies with the hand closed by a share of the grasp test's squeeze [m]."""
        return self._both[len(self.joints) :]

    @cached_property
    def on_palm(self) -> Bool[Tensor, "c k"]:
        """Whether a contact point is on the palm."""
        return self.hand.contacts.body[self.contacts] == 0

    @cached_property
    def points(self) -> Float[Tensor, "c k 3"]:
        """Contact points psi on the hand [m]."""
        return self._points(self.poses)

    @cached_property
    def closed_points(self) -> Float[Tensor, "c k 3"]:
        """Contact points of the closed hand [m]."""
        return self._points(self.closed_poses)

    @cached_property
    def distance(self) -> Float[Tensor, "c k"]:
        """Signed distance of the contact points to the object, positive outside [m]."""
        return self._sampled[..., 0]

    @cached_property
    def normals(self) -> Float[Tensor, "c k 3"]:
        """Inward unit normals c of the object at the contact points."""
        raw = self._sampled[..., 1:CHANNELS]
        return -raw / raw.norm(dim=-1, keepdim=True).clamp_min(SMALLEST_LENGTH)

    @cached_property
    def region_distance(self) -> Float[Tensor, "c k"]:
        """Distance of the contact points to the region to be held [m]; only where there is one."""
        return self._sampled[..., CHANNELS]

    @cached_property
    def centers(self) -> Float[Tensor, "c s 3"]:
        """Centres of the hand's spheres, whose radii are `hand.sphere_radius` [m]."""
        return self.hand.place(self.poses, self.hand.spheres)

    def signed_distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distance of any points in the object frame [m], differentiable with respect to them."""
        return sample(self.field, points, 1)[..., 0]

    @cached_property
    def _sampled(self) -> Tensor:
        return sample(self.field, self.points)

    def _points(self, poses: Tensor) -> Tensor:
        return self.energy.contact_points(poses, self.contacts)[2].view(*self.contacts.shape, 3)


def sample(
    field: SignedDistanceField, points: Float[Tensor, "*batch 3"], channels: int | None = None
) -> Float[Tensor, "*batch n"]:
    """`SignedDistanceField.sample` for automatic differentiation, whose derivatives are those that it returns.

    Args:
        field: the distance field.
        points: (*batch, 3) positions in the object frame [m].
        channels: number n of channels, from the first; all if None.
    """
    found = _Sample.apply(points.reshape(-1, 3), field, channels)
    assert isinstance(found, Tensor)
    return found.view(*points.shape[:-1], -1)


class _Sample(torch.autograd.Function):
    """Interpolated channels (n, k) at points (n, 3), with the exact derivatives of the interpolant."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, field: SignedDistanceField, channels: int | None) -> Tensor:
        value, slope = field.sample(points, channels)
        ctx.save_for_backward(slope)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_value: Tensor) -> tuple[Tensor, None, None]:
        (slope,) = ctx.saved_tensors
        return (by_value.unsqueeze(1) @ slope).squeeze(1), None, None
