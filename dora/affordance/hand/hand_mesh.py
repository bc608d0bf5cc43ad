"""The hand as coloured triangle meshes and their poses in a posture; for pictures and pages only."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from trimesh.visual import ColorVisuals

from dora.affordance.objects.solids import shape_mesh
from dora.containers import MOST_FACES, check_container
from dora.errors import InputError
from dora.geometry.rotations import matrix_from_quaternion
from dora.reading import read_xml
from dora.robot import RobotDescription, SerialChain

GAMMA = 2.2
"""Exponent between the linear colours of a glTF material and the colours of a screen [1]."""
PLAIN = (0.55, 0.57, 0.6)
"""Colour of a link that has no visual mesh, red, green and blue in 0..1."""


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
        visuals = _visual_files(robot)
        self.links = {name: mesh for name in names if (mesh := _link_mesh(robot, name, visuals)) is not None}

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


def joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh with all faces and face colours of several meshes."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return trimesh.Trimesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, offsets, strict=False)]),
        face_colors=np.concatenate([face_colours(mesh) for mesh in meshes]),
        process=False,
    )


def face_colours(mesh: trimesh.Trimesh) -> UInt8[np.ndarray, "f 4"]:
    """Red, green, blue and opacity, 0 to 255, of every face of a mesh with colours (not textures)."""
    return np.asarray(cast(ColorVisuals, mesh.visual).face_colors)


def _visual_files(robot: RobotDescription) -> dict[str, list[Path]]:
    """Files of the visual meshes of each link of the URDF; meshes are in the link frames."""
    files = {}
    for link in read_xml(robot.urdf, "URDF").findall("link"):
        meshes = link.findall("visual/geometry/mesh")
        files[link.get("name")] = [robot.urdf.parent / mesh.get("filename", "") for mesh in meshes]
    return files


def _link_mesh(robot: RobotDescription, link: str, visuals: dict[str, list[Path]]) -> trimesh.Trimesh | None:
    parts = [part for path in visuals.get(link, []) if path.is_file() for part in _coloured(path)]
    parts = parts or [_painted(shape_mesh(shape), np.array(PLAIN)) for shape in robot.shapes.get(link, ())]
    return joined(parts) if parts else None


@cache
def _coloured(path: Path) -> tuple[trimesh.Trimesh, ...]:
    """Geometries of a mesh file, each in the one colour that a screen shows."""
    check_container(path)
    try:
        scene = trimesh.load_scene(path)
        faces = sum(len(scene.geometry[scene.graph[node][1]].faces) for node in scene.graph.nodes_geometry)
        pieces = cast(list[trimesh.Trimesh], scene.dump() if faces <= MOST_FACES else [])
    except Exception as error:  # the readers of meshes raise whatever they meet
        raise InputError(f"{path} cannot be read ({type(error).__name__}): export the mesh again.") from error
    if faces > MOST_FACES:
        raise InputError(f"{path} has {faces} faces; reduce it to at most {MOST_FACES}.")
    parts = []
    for part in pieces:
        factor = getattr(getattr(part.visual, "material", None), "baseColorFactor", None)
        linear = np.full(4, 255) if factor is None else np.asarray(factor)
        shown = (linear[:3] / 255) ** (1 / GAMMA)
        parts.append(_painted(part, shown))
    return tuple(parts)


def _painted(mesh: trimesh.Trimesh, color: np.ndarray) -> trimesh.Trimesh:
    faces = np.tile((np.append(color, 1.0) * 255).astype(np.uint8), (len(mesh.faces), 1))
    return trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=faces, process=False)
