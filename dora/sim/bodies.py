"""Poses and velocities of chosen bodies in one tensor, on every backend."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from torch import Tensor


class BodyReader:
    """Reads k bodies of each of n environments at once.

    On batched backends that is one gather from the rigid-body buffer; on a stock single CPU environment, one read
    per body.
    """

    def __init__(self, scene: ManiSkillScene, bodies: Sequence[Actor | Link]):
        self.scene, self.bodies = scene, tuple(bodies)
        self._index: Tensor | None = None

    def read(self) -> Float[Tensor, "n k 13"]:
        """Position [m], quaternion wxyz, linear [m/s] and angular velocity [rad/s], world frame of each environment."""
        if not self.scene.gpu_sim_enabled:
            parts = [
                torch.cat([b.pose.raw_pose, b.get_linear_velocity(), b.get_angular_velocity()], -1)
                for b in self.bodies
            ]
            return torch.stack(parts, 1)
        if self._index is None:
            self._index = torch.stack([b._body_data_index for b in self.bodies], 1).long()
        return self.scene.px.cuda_rigid_body_data.torch()[self._index]
