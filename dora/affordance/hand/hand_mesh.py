"""The hand as coloured triangle meshes and their poses in a posture; for pictures and pages only."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float
from torch import Tensor

from dora.affordance.hand.link_meshes import joined, link_meshes
from dora.geometry.rotations import matrix_from_quaternion
from dora.robot import RobotDescription, SerialChain


class HandMesh:
    """Meshes of the wrist and every finger link of a robot, in the link frames [m].

    Args:
        robot: the robot; a link without visual meshes shows its collision shapes.

    Attributes:
        links: face-coloured mesh by link name.
    """

    def __init__(self, robot: RobotDescription) -> None:
        model = robot.model
        above = len(model.chain(robot.wrist_link))
        self._wrist = robot.wrist_link
        self._fingers = []
        for finger in robot.fingers.values():
            joints = model.chain(finger.distal)[above:]
            chain = SerialChain(joints, dtype=torch.float64)
            children = tuple(joint.child for joint in joints if joint.moves)
            index = [robot.hand.names.index(name) for name in chain.names]
            self._fingers.append((chain, children, index))
        names = [self._wrist, *(link for _, children, _ in self._fingers for link in children)]
        self.links = link_meshes(robot, names)

    def poses(self, joints: Float[Tensor, "c j"]) -> dict[str, Float[Tensor, "c 4 4"]]:
        """Pose of every link of `links` in the wrist frame [m] at hand joints [rad], in the order of `robot.hand`."""
        q = joints.to(torch.float64)
        found = {self._wrist: torch.eye(4, dtype=torch.float64).expand(len(q), 4, 4)}
        for chain, children, index in self._fingers:
            found |= dict(zip(children, chain.forward(q[:, index]).joints.unbind(1), strict=True))
        return {name: found[name] for name in self.links}

    def world_poses(
        self, position: Float[Tensor, "c 3"], quaternion: Float[Tensor, "c 4"], joints: Float[Tensor, "c j"]
    ) -> dict[str, Float[Tensor, "c 4 4"]]:
        """Pose of every link of `links` in the frame in which the wrist poses ([m], wxyz) are given."""
        wrist = torch.eye(4, dtype=torch.float64).repeat(len(joints), 1, 1)
        wrist[:, :3, :3] = matrix_from_quaternion(quaternion.to(torch.float64))
        wrist[:, :3, 3] = position
        return {name: wrist @ pose for name, pose in self.poses(joints).items()}

    def posed(
        self, position: Float[Tensor, "c 3"], quaternion: Float[Tensor, "c 4"], joints: Float[Tensor, "c j"]
    ) -> list[trimesh.Trimesh]:
        """One face-coloured mesh per row of the arguments of `world_poses`."""
        poses = {name: pose.numpy() for name, pose in self.world_poses(position, quaternion, joints).items()}
        return [
            joined([self.links[name].copy().apply_transform(pose[row]) for name, pose in poses.items()])
            for row in range(len(joints))
        ]

    @property
    def fingers(self) -> Bool[np.ndarray, " f"]:
        """Mask of the faces of a mesh of `posed` that belong to fingers, not to the wrist link."""
        return np.concatenate([np.full(len(mesh.faces), name != self._wrist) for name, mesh in self.links.items()])
