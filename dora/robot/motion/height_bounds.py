"""Lower bounds of the heights of hand and arm above a plane, batched, and exact for all shapes but cylinders.

Each collision shape is the convex hull of equal spheres: a capsule of two, a box of eight with radius zero. Its lowest
point is that of its lowest sphere. The rim of a cylinder is replaced by a circumscribed polygon.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.geometry.rotations import matrix_from_quaternion
from dora.robot import RobotDescription, SerialChain, Shape
from dora.robot.kinematics import Frames
from dora.robot.motion.collision import hand_links

RIM_POINTS = 16
"""Number of corners of the polygon around each rim of a cylinder."""


def spheres_of(shape: Shape) -> tuple[Float[np.ndarray, "m 3"], float]:
    """Centres in the link frame [m] and common radius [m] of spheres whose convex hull contains the shape."""
    centre = np.asarray(shape.position)
    if shape.kind == "sphere":
        return centre[None], shape.size[0]
    if shape.kind == "capsule":
        return shape.segment, shape.size[0]
    turn = matrix_from_quaternion(torch.tensor(shape.quaternion, dtype=torch.float64)).numpy()
    if shape.kind == "box":
        corners = np.stack(np.meshgrid(*([-half, half] for half in shape.size)), -1).reshape(-1, 3)
        return centre + corners @ turn.T, 0.0
    angle = 2 * math.pi * np.arange(RIM_POINTS) / RIM_POINTS
    radius = shape.size[0] / math.cos(math.pi / RIM_POINTS)
    rim = np.stack([np.zeros(RIM_POINTS), radius * np.cos(angle), radius * np.sin(angle)], -1)
    ends = np.array([[-shape.size[1], 0.0, 0.0], [shape.size[1], 0.0, 0.0]])
    return centre + (ends[:, None] + rim).reshape(-1, 3) @ turn.T, 0.0


def _spheres(robot: RobotDescription, link: str) -> tuple[Tensor, Tensor]:
    """Centres (m, 3) in the link frame and radii (m,) of the spheres of all shapes of a link [m]."""
    parts = [spheres_of(shape) for shape in robot.shapes[link]]
    centres = torch.tensor(np.concatenate([points for points, _ in parts]), dtype=torch.float32)
    return centres, torch.tensor(np.repeat([r for _, r in parts], [len(p) for p, _ in parts]), dtype=torch.float32)


class HandHeightBounds:
    """The hand as m spheres in the frame of its wrist link."""

    def __init__(self, robot: RobotDescription):
        above = len(robot.model.chain(robot.wrist_link))
        self._fixed: list[tuple[Tensor, Tensor]] = []
        self._moving: list[tuple[SerialChain, list[int], Tensor, Tensor]] = []
        for link in sorted(hand_links(robot)):
            joints, spheres = robot.model.chain(link)[above:], _spheres(robot, link)
            if any(joint.moves for joint in joints):
                chain = SerialChain(joints)
                self._moving.append((chain, [robot.hand.names.index(name) for name in chain.names], *spheres))
            else:
                pose = np.linalg.multi_dot([np.eye(4), *(joint.origin for joint in joints), np.eye(4)])
                pose = torch.tensor(pose, dtype=torch.float32)
                self._fixed.append((spheres[0] @ pose[:3, :3].T + pose[:3, 3], spheres[1]))
        self.radii = torch.cat([radii for _, radii in self._fixed] + [radii for *_, radii in self._moving])
        """(m,) radii of the spheres [m]."""

    def spheres(self, joints: Float[Tensor, "c h"]) -> Float[Tensor, "c m 3"]:
        """Centres in the wrist frame [m] at hand joints [rad], in the order of `robot.hand`."""
        parts = [centres.expand(len(joints), -1, -1) for centres, _ in self._fixed]
        for chain, index, centres, _ in self._moving:
            position, rotation = chain.tip_pose(joints[:, index])
            parts.append(centres @ rotation.transpose(1, 2) + position[:, None])
        return torch.cat(parts, 1)


class ArmHeightBounds:
    """The links between the first joint and the wrist as spheres; `chain` is the one from the root to the wrist."""

    def __init__(self, robot: RobotDescription, chain: SerialChain):
        joints = [joint for joint in robot.model.chain(robot.wrist_link) if joint.moves]
        parts = [(i, *_spheres(robot, j.child)) for i, j in enumerate(joints) if j.child in robot.shapes]
        self._chain = chain
        self._parts = [part for part in parts if joints[part[0]].child not in hand_links(robot)]

    def height(
        self, q: Float[Tensor, "*batch dof"], normal: Float[Tensor, " 3"], level: float, frames: Frames | None = None
    ) -> Float[Tensor, "*batch"]:
        """Smallest height above a plane at arm joints.

        Args:
            q: arm joints [rad].
            normal: unit normal of the plane in the base frame.
            level: the plane is normal . x = level [m].
            frames: forward kinematics of `q`, if known.

        Returns:
            Heights, negative below the plane [m].
        """
        poses = (frames or self._chain.forward(q.reshape(-1, q.shape[-1]))).joints
        lowest = [
            ((normal @ poses[:, i, :3, :3])[:, None] * centres).sum(-1) + (poses[:, i, :3, 3] @ normal)[:, None] - radii
            for i, centres, radii in self._parts
        ]
        return (torch.cat(lowest, -1).amin(-1) - level).reshape(q.shape[:-1])
