"""Posed hands in a scene of viser: those of grasp candidates, as they are or as ghosts."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from dora.affordance.hand.hand_mesh import HandMesh
from dora.affordance.hand.link_meshes import face_colours
from dora.affordance.views.surface import unshared
from dora.geometry.rotations import quaternion_from_matrix
from dora.robot import RobotDescription


class Hands:
    """Up to `most` posed hands in a scene of viser; links of equal shape form one batch.

    Args:
        scene: of viser's server.
        robot: whose hand it is.
        most: largest number of hands that are shown at once.
        root: name of the frame in which the hands stand.
        ghost: colour (red, green, blue, 0 to 255) and opacity (0 to 1) of hands that are only a hint; None for the
            colours of the robot.

    Attributes:
        frame: handle of the frame in which the hands stand.
    """

    def __init__(
        self,
        scene: Any,
        robot: RobotDescription,
        most: int,
        root: str = "/hands",
        ghost: tuple[tuple[int, int, int], float] | None = None,
    ) -> None:
        self.mesh, self._most = HandMesh(robot), most
        self.frame = scene.add_frame(root, show_axes=False)
        groups: dict[bytes, list[str]] = {}
        for name, link in self.mesh.links.items():
            groups.setdefault(link.vertices.tobytes() + face_colours(link).tobytes(), []).append(name)
        self._batches = []
        for names in groups.values():
            link, count = self.mesh.links[names[0]], most * len(names)
            nowhere = {
                "batched_wxyzs": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
                "batched_positions": np.zeros((count, 3)),
                "batched_scales": np.zeros(count),
                "lod": "off",
            }
            path = f"{root}/{names[0]}"
            if ghost is None:
                handle = scene.add_batched_meshes_trimesh(path, unshared(link, face_colours(link)), **nowhere)
            else:
                vertices, faces = np.asarray(link.vertices, np.float32), np.asarray(link.faces, np.uint32)
                look = {"batched_colors": ghost[0], "opacity": ghost[1], "cast_shadow": False}
                handle = scene.add_batched_meshes_simple(path, vertices, faces, **nowhere, **look)
            self._batches.append((names, handle))

    def show(
        self, position: Float[Tensor, "c 3"], quaternion: Float[Tensor, "c 4"], joints: Float[Tensor, "c j"]
    ) -> None:
        """Pose hands, `most` at most.

        Args:
            position, quaternion: of the wrists in `frame` [m], wxyz.
            joints: of the hands [rad], in the order of the robot's description.
        """
        poses = self.mesh.world_poses(position, quaternion, joints)
        for names, handle in self._batches:
            handle.batched_positions = self._filled([poses[name][:, :3, 3] for name in names], (0.0, 0.0, 0.0))
            turns = [quaternion_from_matrix(poses[name][:, :3, :3]) for name in names]
            handle.batched_wxyzs = self._filled(turns, (1.0, 0.0, 0.0, 0.0))
        self._show_first(len(joints))

    def hide(self) -> None:
        """Show no hand."""
        self._show_first(0)

    def _show_first(self, count: int) -> None:
        for names, handle in self._batches:
            scales = np.zeros((len(names), self._most))
            scales[:, :count] = 1.0
            handle.batched_scales = scales.ravel().astype(np.float32)

    def _filled(self, values: list[Float[Tensor, "c d"]], rest: tuple[float, ...]) -> Float[np.ndarray, "n d"]:
        """Rows of every link, padded to `most` each with `rest`."""
        table = np.tile(np.array(rest, dtype=np.float32), (len(values), self._most, 1))
        for link, value in enumerate(values):
            table[link, : len(value)] = value.numpy()
        return table.reshape(-1, len(rest))
