"""The residual action: a bounded, low-passed change of a reference in the hand frame, the same for every reference.

    x_target = x_reference * exp(bound * c),    c <- c + SMOOTHING (a - c)

so that a = 0 executes the reference and the policy only has to learn what the reference gets wrong. The first-order
low-pass keeps exploration noise from shaking the fingers; c is part of the observation.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.errors import InputError
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_inverse,
    quaternion_multiply,
    rotation_vector_from_quaternion,
)
from dora.tasks.mdp.buffers import Buffers
from dora.tasks.mdp.config import ResidualBounds

SMOOTHING = 0.3
"""Share of the new action in the low-passed residual [1]."""


@dataclass(frozen=True)
class Target:
    """Where a reference sends the wrist (world pose [m], wxyz) and the hand joints [rad]."""

    wrist_p: Float[Tensor, "n 3"]
    wrist_q: Float[Tensor, "n 4"]
    hand: Float[Tensor, "n hand"]


class ResidualAction:
    """The low-passed residual of each environment, in units of the bounds.

    Attributes:
        bounds: largest residuals at scale 1.
        scale: share of the bounds in force, for curricula.
        buffers: `residual` (n, a) in [-1, 1]: 3 translation, 3 rotation vector, then the hand's part.
    """

    def __init__(self, num_envs: int, action_size: int, bounds: ResidualBounds, device: torch.device):
        self.bounds, self.scale = bounds, 1.0
        self.buffers = Buffers(num_envs, device, residual=(action_size,))

    def set_scale(self, scale: float) -> None:
        """Puts a share of the bounds in force; raises InputError unless it is in [0, 1]."""
        if not 0 <= scale <= 1:
            raise InputError(f"the share of the residual's bounds is {scale}; it has to be between 0 and 1")
        self.scale = scale

    def begin(self, rows: Int[Tensor, " b"]) -> None:
        """No residual in the environments that start anew."""
        self.buffers.clear(rows)

    def apply(
        self,
        target: Target,
        action: Float[Tensor, "n a"],
        expand: Callable[[Tensor], Tensor],
        freedom: Float[Tensor, " n"] | float = 1.0,
    ) -> Target:
        """Takes in an action in [-1, 1] and adds the residual to the target; call once per control step.

        Args:
            target: of the reference.
            action: a: 3 translation, 3 rotation vector, then the hand's part.
            expand: maps the action's hand part to all hand joints.
            freedom: share of the bounds that the reference leaves to the residual now.
        """
        residual = self.buffers.residual
        residual += SMOOTHING * (action - residual)
        share = self.scale * torch.as_tensor(freedom, device=residual.device).reshape(-1, 1)
        c, bounds = share * residual, self.bounds
        turn = quaternion_from_rotation_vector(bounds.rotation * c[:, 3:6])
        return Target(
            target.wrist_p + quaternion_apply(target.wrist_q, bounds.position * c[:, :3]),
            quaternion_multiply(target.wrist_q, turn),
            target.hand + bounds.joint * expand(c[:, 6:]),
        )


def wrist_step(
    target_p: Float[Tensor, "n 3"],
    target_q: Float[Tensor, "n 4"],
    from_p: Float[Tensor, "n 3"],
    from_q: Float[Tensor, "n 4"],
    limits: tuple[float, float],
) -> Float[Tensor, "n 6"]:
    """World-frame wrist step towards a target, as a normalised action in [-1, 1]^6.

    Translation and rotation are each shortened to `limits` ([m], [rad] per control step), direction kept.
    """
    shift = (target_p - from_p) / limits[0]
    turn = quaternion_multiply(target_q, quaternion_inverse(from_q))
    spin = rotation_vector_from_quaternion(turn) / limits[1]
    return torch.cat([v / v.norm(dim=-1, keepdim=True).clamp(min=1) for v in (shift, spin)], -1)
