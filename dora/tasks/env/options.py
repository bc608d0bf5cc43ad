"""The options that every Dora task takes, checked before anything is built."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from mani_skill.agents.registration import REGISTERED_AGENTS

from dora.errors import InputError
from dora.robot import available_robots
from dora.sim.batch.rendering import can_render
from dora.sim.robot_agent import CONTROL_MODES, COUPLED, DescribedRobot
from dora.sim.robots import register_robot
from dora.tasks.mdp.guidance_parts import guidance_in_force
from dora.tasks.mdp.randomisation import Randomisation, find_preset


def choose_render_backend(render_mode: str | None, obs_mode: str | None) -> str:
    """The render backend for a task: "none" unless a picture can be asked for.

    Raises:
        InputError: if one can be asked for and there is no Vulkan driver.
    """
    if render_mode is None and obs_mode in (None, "state", "state_dict", "none"):
        return "none"
    if not can_render():
        raise InputError(
            "rendering was asked for, but SAPIEN finds no Vulkan driver: install one (docs/rendering.md), or leave "
            'render_mode at None and obs_mode at "state"'
        )
    return "gpu" if torch.cuda.is_available() else "cpu"


@dataclass(frozen=True)
class TaskOptions:
    """Checked options of a task, with what they resolve to."""

    parts: frozenset[str]
    preset: Randomisation
    robot: str
    control_mode: str
    sim_backend: str
    render_backend: str


def check_options(
    guidance: str,
    guidance_parts: Sequence[str] | None,
    hand_joints: int,
    preset: str,
    robot_uids: Any,
    num_envs: int,
    control_mode: str | None,
    sim_backend: str,
    render_backend: str,
    render_mode: str | None,
    obs_mode: str | None,
) -> TaskOptions:
    """Resolves defaults and refuses what cannot be built.

    `sim_backend="auto"` is ManiSkill's choice where there is CUDA; otherwise "physx_cpu" for one environment and
    "physx_cpu_batch" for more. `render_backend="auto"` is "none" unless a picture can be asked for.

    Raises:
        InputError: one sentence about the first option that is wrong.
    """
    parts = guidance_in_force(guidance, guidance_parts)
    if hand_joints not in (15, 20):
        raise InputError(
            f"hand_joints must be 20, or 15 with distal joints coupled to medial ones, not {hand_joints!r}"
        )
    if not isinstance(num_envs, int) or num_envs < 1:
        raise InputError(f"num_envs must be a whole number of at least 1, not {num_envs!r}")
    if not isinstance(robot_uids, str):
        raise InputError(f"robot_uids must be one of {', '.join(available_robots())}, not {robot_uids!r}")
    if robot_uids not in REGISTERED_AGENTS:
        register_robot(robot_uids)
    if not issubclass(REGISTERED_AGENTS[robot_uids].agent_cls, DescribedRobot):
        raise InputError(f"robot {robot_uids!r} has no hand for this task; use one of {', '.join(available_robots())}")
    mode = control_mode or CONTROL_MODES[0]
    if hand_joints == 15 and not mode.endswith(COUPLED):
        mode += COUPLED
    known = [m + end for m in CONTROL_MODES for end in ("", COUPLED)]
    if mode not in known:
        raise InputError(f"unknown control mode {control_mode!r}; choose one of {', '.join(known)}")
    if sim_backend == "auto" and not torch.cuda.is_available():
        sim_backend = "physx_cpu_batch" if num_envs > 1 else "physx_cpu"
    if render_backend == "auto":
        render_backend = choose_render_backend(render_mode, obs_mode)
    return TaskOptions(parts, find_preset(preset), robot_uids, mode, sim_backend, render_backend)
