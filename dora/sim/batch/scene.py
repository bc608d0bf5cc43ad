"""A ManiSkill scene of N environments on the CPU, and its cameras."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.structs.render_camera import RenderCamera

from dora.sim.batch.system import BatchSystem


class _Picture:
    """A batch of pictures with the interface of a `sapien.CudaArray`."""

    def __init__(self, pixels: np.ndarray):
        self._pixels = pixels

    def torch(self) -> torch.Tensor:
        """(cameras, height, width, channels) pixels."""
        return torch.from_numpy(self._pixels)


class CameraGroup:
    """The same camera in several environments, with the interface of `sapien.render.RenderCameraGroup`."""

    def __init__(self, cameras: Sequence[sapien.render.RenderCameraComponent]):
        self._cameras = list(cameras)

    def take_picture(self) -> None:
        """Render all cameras, one after the other."""
        for camera in self._cameras:
            camera.take_picture()

    def get_picture_cuda(self, name: str) -> _Picture:
        """Pictures of the last `take_picture`; ``name`` is a texture such as ``"Color"``."""
        return _Picture(np.stack([camera.get_picture(name) for camera in self._cameras]))


class BatchScene(ManiSkillScene):
    """ManiSkill's scene with one CPU sub-scene per environment and a `BatchSystem` for its physics.

    ``gpu_sim_enabled`` is true, because it selects ManiSkill's code for many environments.
    ``rendered_environments`` are the environments that `render` shows (all by default), because pictures are
    expensive on a CPU. Cameras for observations always render all environments.
    """

    px: BatchSystem

    def __init__(self, sub_scenes: list[sapien.Scene], **kwargs: Any):
        super().__init__(sub_scenes, **kwargs)
        self.px = BatchSystem(sub_scenes)
        self.gpu_sim_enabled = True
        self.rendered_environments: Sequence[int] = range(len(sub_scenes))

    def create_actor_builder(self) -> ActorBuilder:
        """ManiSkill's builder, but planes collide in every environment.

        ManiSkill leaves a plane out of all environments but the first, because on a GPU they share one physics scene.
        """
        return super().create_actor_builder().set_allow_overlapping_plane_collisions(True)

    def _setup(self, enable_gpu: bool) -> None:
        """Builds the tables of all bodies, then places them as a scene on a CPU does."""
        self.px.build(self.actors, self.articulations)
        super()._setup(enable_gpu=False)

    def _gpu_apply_all(self) -> None:
        """Does nothing: writes go to the simulator directly."""

    def _gpu_fetch_all(self) -> None:
        """Does nothing: values are read on demand."""

    # ---- rendering -------------------------------------------------------------------------------

    def add_camera(self, *args: Any, **kwargs: Any) -> RenderCamera:
        """Add a camera to every environment; mounted ones follow their entity as on a single CPU."""
        self.gpu_sim_enabled = False
        try:
            return super().add_camera(*args, **kwargs)
        finally:
            self.gpu_sim_enabled = True
            self.px.invalidate()

    def update_render(self, update_sensors: bool = True, update_human_render_cameras: bool = True) -> None:
        """Update the renderers of the environments that are needed.

        Args:
            update_sensors: whether to update cameras for observations, in all environments.
            update_human_render_cameras: whether to update cameras for people, in ``rendered_environments``.
        """
        self.px.sync_poses_gpu_to_cpu()
        everyone = range(len(self.sub_scenes))
        for i in everyone if update_sensors else self.rendered_environments:
            self.sub_scenes[i].update_render()
        if update_sensors:
            self._group_cameras(self.sensors, everyone)
        if update_human_render_cameras:
            self._group_cameras(self.human_render_cameras, self.rendered_environments)

    def _group_cameras(self, sensors: Mapping[str, Any], environments: Sequence[int]) -> None:
        for sensor in sensors.values():
            cameras = sensor.camera._render_cameras
            sensor.camera.camera_group = CameraGroup([cameras[i] for i in environments])
