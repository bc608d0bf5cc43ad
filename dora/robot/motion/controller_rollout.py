"""Rollouts of the tasks' wrist controller without a simulator: batched and purely kinematic.

The wrist moves to the standoff of a candidate, above it while it still has to turn, and then straight along the approach. Each control step is a
displacement of bounded length, turned into joint steps by damped least squares within position and velocity limits.
The branch of the inverse kinematics, stalls at joint limits and slow motion near singularities are those of the task.
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
    """Numbers of the wrist controller and of its reference on which a motion depends.

    Attributes:
        period: control period [s].
        speed: largest speed of the wrist [m/s].
        spin: largest angular speed of the wrist [rad/s].
        descent: speed at which the standoff shrinks [m/s].
        hover: height above the beginning of the approach that the wrist keeps for each radian it has to turn [m/rad].
        arrived: errors at the standoff below which the descent begins [m], [rad].
        settled: errors below which the candidate is reached [m], [rad]; those that close the tasks' hand.
        patience: number of control steps after which a motion has failed.
    """

    period: float = 0.05
    speed: float = 0.6
    spin: float = 2.0
    descent: float = 0.15
    hover: float = 0.0
    arrived: tuple[float, float] = (0.02, 0.15)
    settled: tuple[float, float] = (0.008, 0.08)
    patience: int = 90


@dataclass(frozen=True, eq=False)
class Motions:
    """n motions of t control steps; after its end a motion is constant.

    Attributes:
        q: (n, t, dof) commanded arm joints [rad].
        arrival: (n,) index of the step at which the descent begins; t - 1 if it never does.
        finish: (n,) index of the step at which the wrist reaches the candidate; t - 1 if it never does.
        reached: (n,) whether the wrist reaches the candidate.
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
    up: Float[Tensor, " 3"],
) -> Motions:
    """Motions from one posture to many wrist poses.

    Args:
        chain: chain from the robot's root to the wrist.
        start: (dof,) arm joints at the start [rad].
        position: (n, 3) wrist at the candidate, in the base frame [m].
        quaternion: (n, 4) wrist at the candidate, in the base frame, wxyz.
        approach: (n, 3) unit direction of the approach, in the base frame.
        standoff: length of the approach [m].
        controller: numbers of the controller.
        up: upward direction in the base frame.

    Returns:
        The motions; t is the number of steps until the last one has ended, plus one.
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
        turn = error[:, 3:]
        hover = torch.where(descending, 0.0, c.hover * turn.norm(dim=-1))
        shift = error[:, :3] + hover[:, None] * up
        away, angle = shift.norm(dim=-1), turn.norm(dim=-1)
        begins = ~descending & (away < c.arrived[0]) & (angle < c.arrived[1])
        arrival[left[begins]] = step
        descending = descending | begins
        done = descending & (back <= 0) & (away < c.settled[0]) & (angle < c.settled[1])
        if done.any():
            finish[left[done]] = step
            keep = ~done
            q, shift, turn, away, angle, back, descending, left = (
                x[keep] for x in (q, shift, turn, away, angle, back, descending, left)
            )
            position, rotation, approach = position[keep], rotation[keep], approach[keep]
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
