"""Batched inverse kinematics of the arm: seeds from a table of postures, then damped least squares within limits.

Rotating the first joint rotates the wrist about that joint's axis and changes nothing else. The table therefore holds
postures with the first joint at zero, with their wrist poses. A target is rotated about the axis to azimuth zero, the
nearest wrist poses of the table are looked up, and the first joint is set to the azimuth. From such a seed a few steps

    dq = J^T (J J^T + lambda^2 I)^-1 e,   lambda^2 = DAMPING_FLOOR + DAMPING_GAIN |e|^2

reach the target (T. Sugihara, 2011: Levenberg-Marquardt with error-dependent damping), robustly from far away and with
nearly quadratic convergence close to it. A joint at a limit is excluded from steps that would exceed the limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.errors import InputError
from dora.geometry.rotations import matrix_from_quaternion
from dora.robot import RobotDescription, SerialChain
from dora.robot.kinematics import DAMPING, Frames

POSITION_TOLERANCE = 2e-4
"""Largest error of a solution's wrist position [m]."""
ANGLE_TOLERANCE = 2e-3
"""Largest error of a solution's wrist orientation [rad]."""
LIMIT_MARGIN = 0.01
"""Distance that solutions keep from the joint limits [rad]; the wrist controller keeps the same."""
DAMPING_FLOOR = 1e-5
"""lambda^2 at the target [m^2] or [rad^2]."""
DAMPING_GAIN = 0.02
"""Ratio of lambda^2 to the squared error, metres and radians added [1]."""
LARGEST_STEP = 0.6
"""Largest change of a joint in one iteration [rad]."""
NULLSPACE_ITERATIONS = 4
"""Number of first iterations with a nullspace motion towards the start posture."""
NULLSPACE_GAIN = 0.2
"""Share of the way to the start posture per such iteration [1]."""
METRES_PER_RADIAN = 0.3
"""Weight of orientation errors in the search for seeds [m/rad]."""
METRES_PER_JOINT_RADIAN = 0.03
"""Weight of the distance from the start posture in the search for seeds [m/rad]."""
TABLE_SIZE = 8192
"""Number of postures in the table of seeds."""
CHUNK = 512
"""Number of targets looked up at once; bounds the memory."""
MARGIN_SCALE = 0.1
"""Length scale of the cost of being near a joint limit [rad]."""
MARGIN_COST = 1.0
"""Cost of a joint at its limit, equivalent to a distance from the start posture [rad]."""
MANIPULABILITY_SCALE = 0.02
"""Scale of manipulability sqrt(det(J J^T)) in the cost of being near a singularity [m^3/rad^3]."""
MANIPULABILITY_COST = 1.0
"""Cost of a singular posture, equivalent to a distance from the start posture [rad]."""
UNSOLVED_COST = 1e3
"""Cost of a posture that is not solved; larger than any solution's, so that it is sorted last [rad]."""
NUMBERS = {
    "position_tolerance": POSITION_TOLERANCE,
    "angle_tolerance": ANGLE_TOLERANCE,
    "limit_margin": LIMIT_MARGIN,
    "damping": (DAMPING_FLOOR, DAMPING_GAIN),
    "largest_step": LARGEST_STEP,
    "pull": (NULLSPACE_ITERATIONS, NULLSPACE_GAIN),
    "metres_per_radian": (METRES_PER_RADIAN, METRES_PER_JOINT_RADIAN),
    "table_size": TABLE_SIZE,
    "margin": (MARGIN_SCALE, MARGIN_COST),
    "manipulability": (MANIPULABILITY_SCALE, MANIPULABILITY_COST),
    "step_damping": DAMPING,
}
"""Numbers on which solutions depend besides the robot, for the digests of stored tables."""


@dataclass(frozen=True, eq=False)
class Solutions:
    """s postures for each of n wrist poses: solved ones first, in ascending order of cost.

    Attributes:
        q: (n, s, dof) arm joints [rad], always finite and within the limits.
        position_error: (n, s) distance of the wrist from its target [m].
        angle_error: (n, s) angle between the wrist and its target [rad].
        solved: (n, s) whether both errors are within the tolerances.
        cost: (n, s) distance from the start posture plus penalties near limits and singularities [rad].
    """

    q: Float[Tensor, "n s dof"]
    position_error: Float[Tensor, "n s"]
    angle_error: Float[Tensor, "n s"]
    solved: Bool[Tensor, "n s"]
    cost: Float[Tensor, "n s"]


class InverseKinematics:
    """Arm postures for wrist poses given in the robot's base frame.

    Args:
        robot: the robot whose chain from root to wrist is solved.
        start: (dof,) posture near which solutions are preferred [rad]; the posture "home" by default.
        seed: seed of the table of postures; the same seed gives the same solutions.

    Raises:
        InputError: `start` has another number of joints than the arm.
    """

    def __init__(self, robot: RobotDescription, start: np.ndarray | None = None, seed: int = 0):
        self.chain = SerialChain.of(robot)
        home = robot.posture("home").arm if start is None else start
        if len(home) != len(robot.arm):
            raise InputError(
                f"the start posture has {len(home)} joints; the arm of {robot.name!r} has {len(robot.arm)}"
            )
        self.start = torch.tensor(np.asarray(home), dtype=torch.float32)
        self.lower, self.upper = self.chain.lower + LIMIT_MARGIN, self.chain.upper - LIMIT_MARGIN
        frame = np.eye(4)
        for joint in robot.model.chain(robot.wrist_link):
            frame = frame @ joint.origin
            if joint.moves:
                frame = frame @ _frame_about(joint.axis)
                break
        self._axis = torch.tensor(frame, dtype=torch.float32)
        generator = torch.Generator().manual_seed(seed)
        share = torch.rand(TABLE_SIZE, len(home), generator=generator)
        self._table = self.lower + share * (self.upper - self.lower)
        self._table[:, 0] = 0.0
        position, rotation = self.chain.tip_pose(self._table)
        features, self._azimuth = self._features(position, rotation)
        self._keys = torch.cat([features, METRES_PER_JOINT_RADIAN * self._table[:, 1:]], -1)
        self._identity = torch.eye(6)

    def solve(
        self,
        position: Float[Tensor, "n 3"],
        quaternion: Float[Tensor, "n 4"],
        seeds: int = 4,
        iterations: int = 24,
    ) -> Solutions:
        """Postures for wrist poses in the base frame.

        Args:
            position: wrist positions [m].
            quaternion: wrist orientations, wxyz.
            seeds: s, number of seeds per pose.
            iterations: largest number of damped steps.

        Returns:
            Solutions; for a pose out of reach those are the postures after the last iteration, not solved.
        """
        rotation = matrix_from_quaternion(quaternion)
        q = self._seeds(position, rotation, seeds)
        n, dof = len(position), q.shape[-1]
        rows = [x.repeat_interleave(seeds, 0) for x in (position, rotation)]
        q, error, manipulability = self._iterate(q.reshape(-1, dof), rows[0], rows[1], iterations)
        away, turn = error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)
        solved = (away < POSITION_TOLERANCE) & (turn < ANGLE_TOLERANCE)
        cost = self._cost(q, manipulability)
        order = torch.where(solved, cost, UNSOLVED_COST + away + turn).reshape(n, seeds).argsort(dim=-1, stable=True)
        flat = (order + seeds * torch.arange(n)[:, None]).reshape(-1)
        return Solutions(
            q[flat].reshape(n, seeds, dof),
            *(x[flat].reshape(n, seeds) for x in (away, turn, solved, cost)),
        )

    def follow(
        self,
        q: Float[Tensor, "n dof"],
        position: Float[Tensor, "n k 3"],
        quaternion: Float[Tensor, "n k 4"],
        iterations: int = 4,
    ) -> tuple[Float[Tensor, "n k dof"], Bool[Tensor, "n k"]]:
        """Tracks k wrist poses one after the other, each from the posture of the one before.

        Args:
            q: arm joints before the first pose [rad].
            position: wrist positions in the base frame [m].
            quaternion: wrist orientations in the base frame, wxyz.
            iterations: largest number of damped steps per pose.

        Returns:
            Arm joints [rad], and whether each posture is within the tolerances.
        """
        rotation = matrix_from_quaternion(quaternion)
        postures, solved = [], []
        for place, turn in zip(position.unbind(1), rotation.unbind(1), strict=True):
            q, error, _ = self._iterate(q, place, turn, iterations, nullspace_iterations=0)
            postures.append(q)
            solved.append(
                (error[:, :3].norm(dim=-1) < POSITION_TOLERANCE) & (error[:, 3:].norm(dim=-1) < ANGLE_TOLERANCE)
            )
        return torch.stack(postures, 1), torch.stack(solved, 1)

    def _features(self, position: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, 11) of poses rotated about the first joint's axis to azimuth zero; their azimuths (n,) [rad]."""
        turn, origin = self._axis[:3, :3], self._axis[:3, 3]
        local = (position - origin) @ turn
        azimuth = torch.atan2(local[:, 1], local[:, 0])
        c, s, zero = azimuth.cos(), azimuth.sin(), torch.zeros_like(azimuth)
        back = torch.stack([c, s, zero, -s, c, zero, zero, zero, zero + 1], -1).unflatten(-1, (3, 3))
        turned = back @ (turn.T @ rotation)
        radius = local[:, :2].norm(dim=-1, keepdim=True)
        # |R - R'|^2 = 2 angle^2 for small angles
        return torch.cat([radius, local[:, 2:], METRES_PER_RADIAN * 0.5**0.5 * turned.flatten(1)], -1), azimuth

    def _seeds(self, position: Tensor, rotation: Tensor, count: int) -> Tensor:
        """(n, count, dof) seeds: the nearest posture in each of `count` parts of the table [rad]."""
        features, azimuth = self._features(position, rotation)
        rest = METRES_PER_JOINT_RADIAN * self.start[1:].expand(len(features), -1)
        queries = torch.cat([features, rest], -1)
        parts = self._keys[: TABLE_SIZE // count * count].unflatten(0, (count, -1))
        half = 0.5 * parts.square().sum(-1)[:, None]
        found = []
        for query in queries.split(CHUNK):
            found.append(torch.baddbmm(half, query.expand(count, -1, -1), parts.transpose(1, 2), alpha=-1).argmin(-1))
        index = torch.cat(found, 1).T + parts.shape[1] * torch.arange(count)
        q = self._table[index]
        turn = azimuth[:, None] - self._azimuth[index]
        q[..., 0] = torch.remainder(turn + torch.pi, 2 * torch.pi) - torch.pi
        return q.clamp(self.lower, self.upper)

    def _iterate(
        self,
        q: Tensor,
        position: Tensor,
        rotation: Tensor,
        iterations: int,
        nullspace_iterations: int = NULLSPACE_ITERATIONS,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Damped steps until all rows are within half the tolerances.

        Returns:
            Joints (n, dof) [rad], errors (n, 6) [m], [rad], and manipulabilities (n,) [m^3/rad^3].
        """
        out, left = q.clone(), torch.arange(len(q))
        final, manipulability = q.new_empty(len(q), 6), q.new_empty(len(q))
        for i in range(iterations + 1):
            frames = self.chain.forward(q)
            error = pose_error(frames, position, rotation)
            done = (error[:, :3].norm(dim=-1) < POSITION_TOLERANCE / 2) & (
                error[:, 3:].norm(dim=-1) < ANGLE_TOLERANCE / 2
            )
            done |= i == iterations
            jacobian = self.chain.jacobian_of(frames)
            if done.any():
                rows = left[done]
                out[rows], final[rows] = q[done], error[done]
                product = jacobian[done] @ jacobian[done].transpose(1, 2)
                manipulability[rows] = torch.linalg.det(product).clamp_min(0).sqrt()
                keep = ~done
                if not keep.any():
                    break
                q, error, jacobian, left = q[keep], error[keep], jacobian[keep], left[keep]
                position, rotation = position[keep], rotation[keep]
            q = self._step(q, error, jacobian, NULLSPACE_GAIN if i < nullspace_iterations else 0.0)
        return out, final, manipulability

    def _step(self, q: Tensor, error: Tensor, jacobian: Tensor, nullspace_gain: float) -> Tensor:
        gradient = (error.unsqueeze(-2) @ jacobian).squeeze(-2)
        stuck = ((q >= self.upper) & (gradient > 0)) | ((q <= self.lower) & (gradient < 0))
        jacobian = jacobian * ~stuck[:, None]
        damping = DAMPING_FLOOR + DAMPING_GAIN * error.square().sum(-1)
        goal = error.unsqueeze(-1)
        rest = nullspace_gain * (self.start - q)
        rest[:, 0] = 0.0  # the first joint is determined by the azimuth
        if nullspace_gain:
            goal = goal - jacobian @ rest.unsqueeze(-1)
        transposed = jacobian.transpose(1, 2)
        product = torch.baddbmm(damping[:, None, None] * self._identity, jacobian, transposed)
        factor, _ = torch.linalg.cholesky_ex(product)
        step = (transposed @ torch.cholesky_solve(goal, factor)).squeeze(-1) + rest
        step = step / (step.abs().amax(-1, keepdim=True) / LARGEST_STEP).clamp_min(1.0)
        return torch.clamp(q + step, self.lower, self.upper)

    def _cost(self, q: Tensor, manipulability: Tensor) -> Tensor:
        margin = torch.minimum(q - self.lower, self.upper - q).amin(-1)
        return (
            (q - self.start).norm(dim=-1)
            + MARGIN_COST * torch.exp(-margin / MARGIN_SCALE)
            + MANIPULABILITY_COST * torch.exp(-manipulability / MANIPULABILITY_SCALE)
        )


def pose_error(
    frames: Frames, position: Float[Tensor, "n 3"], rotation: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n 6"]:
    """Displacement [m] and rotation vector [rad] from the tip to the target pose, in the base frame."""
    tip = frames.tip
    turn = rotation @ tip[:, :3, :3].transpose(1, 2)
    skew = 0.5 * torch.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1
    )
    cosine = 0.5 * (turn.diagonal(dim1=1, dim2=2).sum(-1, keepdim=True) - 1)
    sine = skew.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return torch.cat([position - tip[:, :3, 3], skew * (torch.atan2(sine, cosine) / sine)], -1)


def _frame_about(axis: np.ndarray) -> np.ndarray:
    """A pose (4, 4) at the origin whose z axis is `axis`."""
    z = axis / np.linalg.norm(axis)
    x = np.eye(3)[np.abs(z).argmin()]
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    return out
