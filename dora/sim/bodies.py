"""Poses and velocities of chosen bodies in one tensor, on every backend; one body of those of all environments."""

from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation, Link
from torch import Tensor

POSE = slice(0, 7)
"""Columns of position and quaternion in the rigid-body buffer."""
VELOCITY = slice(7, 13)
"""Columns of linear and angular velocity in the rigid-body buffer."""

B = TypeVar("B", Actor, Articulation)
"""An actor or an articulation."""


def merged(scene: ManiSkillScene, parts: Sequence[B], kind: type[B], name: str) -> B:
    """One body of those that were built for each environment, saved and restored under its name only.

    Args:
        scene: the ManiSkill scene of the bodies.
        parts: one for each environment, in their order.
        kind: of the bodies; the links and joints of articulations are merged as well.
        name: of the whole.
    """
    for part in parts:
        scene.remove_from_state_dict_registry(part)
    links: dict[str, bool] = {"merge_links": True} if kind is Articulation else {}
    merge: Any = kind.merge
    whole = merge(list(parts), name=name, **links)
    scene.add_to_state_dict_registry(whole)
    return whole


class BodyReader:
    """Reads k bodies of each of n environments at once, in the world frame of each environment.

    On batched backends a read is one gather from the rigid-body buffer, on a stock single CPU environment one read
    per body.

    Args:
        scene: the ManiSkill scene of the bodies.
        bodies: k actors or links.
    """

    def __init__(self, scene: ManiSkillScene, bodies: Sequence[Actor | Link]):
        self.scene, self.bodies = scene, tuple(bodies)
        self._index: Tensor | None = None

    def poses(self) -> Float[Tensor, "n k 7"]:
        """Positions [m] and quaternions wxyz, in the order of `bodies`."""
        if self.scene.gpu_sim_enabled:
            return self._gather(POSE)
        return torch.stack([b.pose.raw_pose for b in self.bodies], 1)

    def velocities(self) -> Float[Tensor, "n k 6"]:
        """Linear [m/s] and angular [rad/s] velocities, in the order of `bodies`."""
        if self.scene.gpu_sim_enabled:
            return self._gather(VELOCITY)
        parts = [torch.cat([b.get_linear_velocity(), b.get_angular_velocity()], -1) for b in self.bodies]
        return torch.stack(parts, 1)

    def _gather(self, columns: slice) -> Tensor:
        if self._index is None:  # bodies have no rows until the scene is complete
            self._index = torch.stack([torch.as_tensor(b._body_data_index) for b in self.bodies], 1).long()
        system: Any = self.scene.px  # PhysX's GPU system or BatchSystem
        return system.cuda_rigid_body_data.torch()[self._index, columns]
