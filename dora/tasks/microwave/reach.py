"""f_reach of the microwave task: which candidates an arm can carry through, wherever the microwave stands.

The wrist's way is fixed to the microwave: before the handle and along the arc of the door, or in front of the cavity
and into it with the fingers ahead. Inverse kinematics follows that way from the arm's start posture, for microwaves at
the nodes of a grid; an episode looks at the node nearest to its own.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.geometry.poses import Pose, carried, compose, relative
from dora.geometry.rotations import quaternion_apply, quaternion_from_yaw, quaternion_multiply, yaw_of
from dora.robot.motion.inverse_kinematics import InverseKinematics
from dora.tasks.env.arm import Arm

PLACES, YAWS = 3, 5
"""Nodes of the grid along x and y, and over the yaw; one where the microwave is not randomised."""
ARC = 0.15
"""Largest turn of the door between two poses that are followed [rad]."""
STEP = 0.06
"""Largest distance between two poses on a straight way [m]."""
ITERATIONS = 8
"""Largest number of damped steps for each pose."""

Way = Callable[[GraspCandidates, Float[Tensor, "m 3"], Float[Tensor, "m 4"]], list[Pose]]
"""Wrist poses (m, c, ...) one after the other, for candidates and poses of the microwave in the world."""


@dataclass(frozen=True)
class OvenReach:
    """Which of c candidates can be carried through at each of m places of the microwave.

    Attributes:
        nodes: x, y [m] and yaw [rad] of the microwave (m, 3).
        scale: differences of x, y and yaw that count as equally far.
        followed: (m, c).
    """

    nodes: Float[Tensor, "m 3"]
    scale: Float[Tensor, " 3"]
    followed: Bool[Tensor, "m c"]

    def mask(self, oven_p: Float[Tensor, "b 3"], oven_q: Float[Tensor, "b 4"]) -> Bool[Tensor, "b c"]:
        """The same for microwaves at these world poses."""
        place = torch.cat([oven_p[:, :2], yaw_of(oven_q)[:, None]], -1) / self.scale
        return self.followed[torch.cdist(place, self.nodes / self.scale).argmin(-1)]


def oven_reach(
    arm: Arm,
    candidates: GraspCandidates,
    way: Way,
    centre: tuple[float, float, float],
    spread: float,
    turn: float,
) -> OvenReach:
    """Follows the way of every candidate of an arm, for microwaves within `spread` [m] and `turn` [rad] of `centre`."""

    def nodes(half: float, count: int) -> Tensor:
        return torch.linspace(-half, half, count) if half > 0 else torch.zeros(1)

    grid = torch.cartesian_prod(nodes(spread, PLACES), nodes(spread, PLACES), nodes(turn, YAWS))
    grid[:, :2] += torch.tensor(centre[:2])
    p = torch.cat([grid[:, :2], torch.full_like(grid[:, :1], centre[2])], -1)
    poses = way(candidates.to("cpu"), p, quaternion_from_yaw(grid[:, 2]))
    base_p, base_q = torch.tensor(arm.spec.position), torch.tensor(arm.spec.quaternion)
    kinematics = InverseKinematics(arm.agent.description, arm.posture.arm)
    count = len(p) * len(candidates)
    local = [relative((base_p.expand(count, 3), base_q.expand(count, 4)), (x.flatten(0, 1), q.flatten(0, 1)))
             for x, q in poses]  # fmt: skip
    position, quaternion = (torch.stack([pose[k] for pose in local], 1) for k in (0, 1))
    start = torch.tensor(arm.posture.arm, dtype=torch.float32).expand(count, -1)
    _, solved = kinematics.follow(start, position, quaternion, ITERATIONS)
    followed = solved.all(-1).reshape(len(p), len(candidates))
    scale = torch.tensor([max(spread, 1e-3), max(spread, 1e-3), max(turn, 1e-3)])
    return OvenReach(grid.to(arm.agent.device), scale.to(arm.agent.device), followed.to(arm.agent.device))


def opening_way(hinge: Pose, handle: Pose, back: float, target: float) -> Way:
    """The way of the arm that opens the door.

    Args:
        hinge: the door's frame in the microwave's, shut [m], wxyz.
        handle: the handle in the door's frame.
        back: distance from the handle at which the approach begins [m].
        target: angle to which the door is opened [rad].
    """

    def way(candidates: GraspCandidates, p: Tensor, q: Tensor) -> list[Pose]:
        """World wrist poses (m, c, 3) [m], (m, c, 4) wxyz before the handle and along the arc, as `Way`."""

        def at(angle: float) -> Pose:
            door = compose((p, q), (hinge[0].expand(len(p), 3), hinge[1].expand(len(p), 4)))
            door = door[0], quaternion_multiply(door[1], quaternion_from_yaw(torch.full((len(p),), -angle)))
            return compose(door, (handle[0].expand(len(p), 3), handle[1].expand(len(p), 4)))

        shut = at(0.0)
        wrist = carried(candidates.position, candidates.quaternion, *shut)
        turned = shut[1][:, None].expand(-1, len(candidates), 4)
        approach = quaternion_apply(turned, candidates.approach.expand(len(p), -1, 3))
        far = [(wrist[0] - back * share * approach, wrist[1]) for share in _shares(back)]
        arc = math.ceil(target / ARC)
        doors = [at(target * k / arc) for k in range(arc + 1)]
        return [*far, *(carried(candidates.position, candidates.quaternion, *door) for door in doors)]

    return way


def placing_way(front: float, depth: float, height: float) -> Way:
    """The way of the arm that puts the cube inside, with its fingers ahead.

    Args:
        front, depth: distance of the cube from the front plane before and behind it [m].
        height: of its centre above the microwave's origin [m].
    """

    def way(candidates: GraspCandidates, p: Tensor, q: Tensor) -> list[Pose]:
        """World wrist poses (m, c, 3) [m], (m, c, 4) wxyz from before the cavity into it, as `Way`."""
        fingers = quaternion_apply(candidates.quaternion, torch.tensor([0.0, 0.0, 1.0]).expand(len(candidates), 3))
        ahead = quaternion_from_yaw(-torch.atan2(fingers[:, 1], fingers[:, 0]))
        grasp = quaternion_apply(ahead, candidates.position), quaternion_multiply(ahead, candidates.quaternion)
        m, c = len(p), len(candidates)
        turn = q[:, None].expand(m, c, 4)
        poses = []
        for share in [*_shares(front + depth), 0.0]:
            place = torch.tensor([depth - share * (front + depth), 0.0, height]).expand(m, c, 3)
            cube = p[:, None] + quaternion_apply(turn, place)
            turned = quaternion_multiply(turn, grasp[1].expand(m, c, 4))
            poses.append((cube + quaternion_apply(turn, grasp[0].expand(m, c, 3)), turned))
        return poses

    return way


def _shares(length: float) -> list[float]:
    """Shares of a straight way at which poses are followed, from 1 down to but without 0."""
    count = math.ceil(length / STEP)
    return [1 - k / count for k in range(count)]
