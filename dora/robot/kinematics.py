"""Batched kinematics of a serial chain of revolute joints: forward kinematics, Jacobian, damped least squares.

The transform of joint i is O_i Rot(a_i, q_i) = A_i + B_i cos q_i + C_i sin q_i with constant 4 x 4 matrices
(Rodrigues' formula), so all joints are evaluated at once and only their products are sequential.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.errors import InputError
from dora.robot.description import RobotDescription
from dora.robot.urdf import UrdfJoint

DAMPING = 0.03
"""Default lambda of damped least squares; motion along singular directions well below it is suppressed."""


class Frames(NamedTuple):
    """Poses in the base frame [m]: of every joint frame after its rotation, and of the chain's tip."""

    joints: Float[Tensor, "n dof 4 4"]
    tip: Float[Tensor, "n 4 4"]


class SerialChain:
    """Kinematics from a root link to a tip link; tensors share `dtype` and `device`.

    Args:
        joints: the joints from root to tip, revolute or fixed, as in `UrdfModel.chain`.
        dtype: floating type of every tensor.
        device: torch device of every tensor.

    Raises:
        InputError: the chain has no moving joint or one that is not revolute.
    """

    def __init__(
        self,
        joints: Sequence[UrdfJoint],
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        moving = [joint for joint in joints if joint.moves]
        if not moving or any(joint.kind != "revolute" for joint in moving):
            raise InputError("a serial chain needs revolute joints only, and at least one of them.")
        constant, cosine, sine = [], [], []
        fixed = np.eye(4)
        for joint in joints:
            fixed = fixed @ joint.origin
            if joint.moves:
                terms = rodrigues(joint.axis)
                for matrices, term in zip((constant, cosine, sine), terms, strict=True):
                    matrices.append(fixed @ term)
                fixed = np.eye(4)

        def tensor(values: object) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=dtype, device=device)

        self.names = tuple(joint.name for joint in moving)
        self.lower = tensor([joint.lower for joint in moving])
        self.upper = tensor([joint.upper for joint in moving])
        self.velocity = tensor([joint.velocity for joint in moving])
        self._constant, self._cosine, self._sine = map(tensor, (constant, cosine, sine))
        self._tip = tensor(fixed)
        self._axes = tensor([joint.axis / np.linalg.norm(joint.axis) for joint in moving]).unsqueeze(-2)
        self._identity = torch.eye(6, dtype=dtype, device=device)

    @classmethod
    def of(
        cls,
        description: RobotDescription,
        tip: str | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> SerialChain:
        """The chain from the robot's root to its wrist, or to the link `tip`.

        Raises:
            InputError: the chain has no moving joint or one that is not revolute.
        """
        return cls(description.model.chain(tip or description.wrist_link), dtype, device)

    def forward(self, q: Float[Tensor, "n dof"]) -> Frames:
        """Forward kinematics at joint angles `q` [rad]."""
        angle = q[..., None, None]
        local = torch.addcmul(self._constant, self._cosine, angle.cos()).addcmul(self._sine, angle.sin())
        pose, *rest = local.unbind(1)
        frames = [pose]
        for step in rest:
            pose = pose @ step
            frames.append(pose)
        return Frames(torch.stack(frames, 1), pose @ self._tip)

    def tip_pose(self, q: Float[Tensor, "n dof"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
        """Position [m] and rotation matrix of the tip in the base frame."""
        tip = self.forward(q).tip
        return tip[:, :3, 3], tip[:, :3, :3]

    def jacobian(self, q: Float[Tensor, "n dof"]) -> Float[Tensor, "n 6 dof"]:
        """Geometric Jacobian at the tip's origin in the base frame; rows: linear [m/rad], then angular [1]."""
        return self.jacobian_of(self.forward(q))

    def jacobian_of(self, frames: Frames) -> Float[Tensor, "n 6 dof"]:
        """The geometric Jacobian from known frames: columns (a_i x (p - p_i); a_i)."""
        axes = (frames.joints[..., :3, :3] * self._axes).sum(-1)
        arms = frames.tip[:, None, :3, 3] - frames.joints[..., :3, 3]
        return torch.cat((torch.linalg.cross(axes, arms), axes), -1).transpose(1, 2)

    def damped_step(
        self,
        q: Float[Tensor, "n dof"],
        twist: Float[Tensor, "n 6"],
        damping: float = DAMPING,
        duration: float | None = None,
        rest: Float[Tensor, "#n dof"] | None = None,
        rest_gain: float = 0.1,
        frames: Frames | None = None,
    ) -> Float[Tensor, "n dof"]:
        """One step of damped least squares: the change of joint angles that displaces the tip.

        dq = r + J^T (J J^T + lambda^2 I)^-1 (twist - J r) with the nullspace motion r = rest_gain (rest - q).
        Defined at every pose, singular ones included.

        Args:
            q: joint angles [rad].
            twist: displacement of the tip in the base frame: linear [m], then a rotation vector [rad].
            damping: lambda.
            duration: duration of the step [s]; if given, the step is scaled down until no joint exceeds its
                velocity limit.
            rest: preferred joint angles [rad]; none by default.
            rest_gain: share of the way to `rest` per step [1].
            frames: `forward(q)`, if it is known already.

        Returns:
            dq [rad], clamped so that q + dq is within the joint limits.
        """
        jacobian = self.jacobian_of(self.forward(q) if frames is None else frames)
        goal = twist.unsqueeze(-1)
        pull = None if rest is None else (rest_gain * (rest - q)).unsqueeze(-1)
        if pull is not None:
            goal = goal - jacobian @ pull
        transposed = jacobian.transpose(1, 2)
        factor, _ = torch.linalg.cholesky_ex(jacobian @ transposed + damping**2 * self._identity)
        step = transposed @ torch.cholesky_solve(goal, factor)
        step = (step if pull is None else step + pull).squeeze(-1)
        if duration is not None:
            excess = (step.abs() / (self.velocity * duration)).amax(-1, keepdim=True)
            step = step / excess.clamp_min(1.0)
        return torch.clamp(q + step, self.lower, self.upper) - q


def rodrigues(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrices (4, 4) of Rodrigues' formula Rot(axis, q) = constant + cosine cos q + sine sin q."""
    x, y, z = axis / np.linalg.norm(axis)
    constant, cosine, sine = np.zeros((3, 4, 4))
    constant[:3, :3] = np.outer((x, y, z), (x, y, z))
    constant[3, 3] = 1.0
    cosine[:3, :3] = np.eye(3) - constant[:3, :3]
    sine[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return constant, cosine, sine
