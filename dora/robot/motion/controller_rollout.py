"""Arm motions under the tasks' wrist controller, without a simulator: many at once, kinematics only.

The wrist moves straight to the standoff of a candidate and then straight down to it. Each control step is a
displacement of bounded length that becomes joint steps by damped least squares within position and velocity limits,
so the branch of the inverse kinematics, stalls at joint limits and slow singular passages are those of the task.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.geometry.rotations import matrix_from_quaternion
from dora.robot import SerialChain
from dora.robot.motion.inverse_kinematics import LIMIT_MARGIN, pose_error


@dataclass(frozen=True)
class Controller:
    """Numbers of the wrist controller and of the reference that commands it, as far as a motion depends on them.

    Attributes:
        period: of the control [s].
        speed: fastest translation of the wrist [m/s].
        spin: fastest rotation of the wrist [rad/s].
        descent: speed at which the standoff shrinks [m/s].
        arrived: error at the standoff that begins the descent [m], [rad].
        settled: error that counts as having reached the candidate [m], [rad]; half of what lets the tasks' hand close.
        patience: control steps after which a motion has failed.
    """

    period: float = 0.05
    speed: float = 0.6
    spin: float = 2.0
    descent: float = 0.15
    arrived: tuple[float, float] = (0.02, 0.15)
    settled: tuple[float, float] = (0.004, 0.04)
    patience: int = 90


@dataclass(frozen=True, eq=False)
class Motions:
    """n motions of t control steps; a finished motion stays where it is.

    Attributes:
        q: (n, t, dof) commanded arm joints [rad].
        arrival: (n,) step at which the descent begins; t - 1 if it never does.
        finish: (n,) step at which the wrist came to the candidate; t - 1 if it never did.
        reached: (n,) whether it did.
    """

    q: Float[Tensor, "n t dof"]
    arrival: Int[Tensor, " n"]
    finish: Int[Tensor, " n"]
    reached: Bool[Tensor, " n"]


def roll_out(
    chain: SerialChain,
    start: Float[Tensor, " dof"],
    position: Float[Tensor, "n 3"],
    quaternion: Float[Tensor, "n 4"],
    approach: Float[Tensor, "n 3"],
    standoff: float,
    controller: Controller,
) -> Motions:
    """Motions from one posture to many wrist poses.

    Args:
        chain: from the robot's root to the wrist.
        start: arm joints [rad].
        position: of the wrist at the candidate, in the base frame [m].
        quaternion: of the wrist at the candidate, wxyz.
        approach: unit direction of the last part of the motion.
        standoff: length of that part [m].
        controller: numbers of the controller.
    """
    c = controller
    n, lower, upper = len(position), chain.lower + LIMIT_MARGIN, chain.upper - LIMIT_MARGIN
    rotation = matrix_from_quaternion(quaternion)
    left = torch.arange(n)
    q = start.expand(n, -1)
    back, descending = torch.full((n,), standoff), torch.zeros(n, dtype=torch.bool)
    arrival, finish = torch.full((2, n), c.patience)
    history = [q.clone()]
    for step in range(c.patience):
        frames = chain.forward(q)
        error = pose_error(frames, position - approach * back[:, None], rotation)
        shift, turn = error[:, :3], error[:, 3:]
        away, angle = shift.norm(dim=-1), turn.norm(dim=-1)
        begins = ~descending & (away < c.arrived[0]) & (angle < c.arrived[1])
        arrival[left[begins]] = step
        descending = descending | begins
        done = descending & (back <= 0) & (away < c.settled[0]) & (angle < c.settled[1])
        if done.any():
            finish[left[done]] = step
            keep = ~done
            q, error, away, angle, back, descending, left = (
                x[keep] for x in (q, error, away, angle, back, descending, left)
            )
            position, rotation, approach = position[keep], rotation[keep], approach[keep]
            shift, turn = error[:, :3], error[:, 3:]
            if not len(left):
                break
            frames = type(frames)(*(x[keep] for x in frames))
        limited = [
            v / (length / (speed * c.period)).clamp_min(1.0)[:, None]
            for v, length, speed in ((shift, away, c.speed), (turn, angle, c.spin))
        ]
        q = q + chain.damped_step(q, torch.cat(limited, -1), duration=c.period, frames=frames)
        q = torch.clamp(q, lower, upper)
        back = torch.where(descending, (back - c.descent * c.period).clamp_min(0.0), back)
        history.append(history[-1].index_copy(0, left, q))
    last = len(history) - 1
    return Motions(torch.stack(history, 1), arrival.clamp_max(last), finish.clamp_max(last), finish < c.patience)
