"""What tests of pictures share: environments with cameras, other modes of the same state, no driver."""

import os
import subprocess
import sys
from typing import Any

import gymnasium as gym
import pytest
import torch
from mani_skill.envs.utils.observations import parse_obs_mode_to_struct
from torch import Tensor

from dora.sim import BACKEND, can_render

ROWS = 3
"""Environments of a batch."""
CAMERAS = ("hand_camera", "front_camera")
EVERYTHING = "rgb+depth+segmentation"
SHAPES = {"rgb": (3, torch.uint8), "depth": (1, torch.int16), "segmentation": (1, torch.int16)}
"""Channels and type of each texture."""
MODES = {
    "rgb": ("rgb",), "depth": ("depth",), "rgbd": ("rgb", "depth"), "depth+segmentation": ("depth", "segmentation"),
    EVERYTHING: ("rgb", "depth", "segmentation"), "state_dict+rgb": ("rgb",),
}  # fmt: skip
"""Textures of some modes."""
STOCK = "PickCube-v1"

drawn = pytest.mark.skipif(not can_render(), reason="needs a Vulkan driver: docs/rendering.md")


def make(env_id: str, num_envs: int | None = None, **options: Any) -> Any:
    """An environment, on `physx_cpu_batch` if a number is given, and otherwise a single one of ManiSkill's way."""
    count, backend = (1, "physx_cpu") if num_envs is None else (num_envs, BACKEND)
    return gym.make(env_id, num_envs=count, sim_backend=backend, render_backend="cpu", **options).unwrapped


def observe(env: Any, mode: str) -> Any:
    """What is observed in another mode, of the present state."""
    kept = env._obs_mode, env.obs_mode_struct
    env._obs_mode, env.obs_mode_struct = mode, parse_obs_mode_to_struct(mode)
    try:
        return env.get_obs()
    finally:
        env._obs_mode, env.obs_mode_struct = kept


def pictures(obs: Any) -> dict[str, Tensor]:
    """All pictures by camera and texture."""
    return {f"{c}/{t}": p for c, textures in obs["sensor_data"].items() for t, p in textures.items()}


def number_of(env: Any, name: str) -> int:
    """The number of an object or link in pictures of segmentation."""
    (number,) = (key for key, body in env.segmentation_id_map.items() if body.name == name)
    return number


def run_without_driver(program: str) -> subprocess.CompletedProcess[str]:
    """What a new Python process prints in which no Vulkan driver is found."""
    environment = os.environ | {"VK_ICD_FILENAMES": "/dev/null", "VK_DRIVER_FILES": "/dev/null"}
    return subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
