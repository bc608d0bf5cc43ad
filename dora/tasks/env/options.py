"""The options that every Dora task takes, checked before anything is built."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import torch
from mani_skill import logger
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.utils.structs.types import SimConfig

from dora.affordance.candidates import GraspCandidates
from dora.configs import check_finite, check_not_negative, check_ranges, overridden, plain
from dora.errors import InputError, shown
from dora.robot import available_robots
from dora.sim.batch.hooks import BACKEND, MOST_ENVS, check_room
from dora.sim.batch.rendering import can_render, refuse_pictures, wants_pictures
from dora.sim.keywords import on_gpu
from dora.sim.robot_agent import CONTROL_MODES, COUPLED, FINGERS, DescribedRobot
from dora.sim.robots import register_robot
from dora.tasks.mdp.config import TaskConfig
from dora.tasks.mdp.guidance_parts import PRIOR, guidance_in_force
from dora.tasks.mdp.randomisation import find_preset

RATES = {
    "control_frequency": (1, 10_000), "physics_frequency": (1, 1_000_000), "solver_iterations": (1, 255),
    "arm_effort": (0.01, 1.0), "hand_effort": (0.01, 1.0), "wrist_speed": (0.01, 1.0), "hand_speed": (0.01, 1.0),
    "pose_filter": (0.01, 1.0), "overlap_range": (0.01, 1000.0), "overlap_grace": (0.0, 1000.0),
    "history": (0, 100),
}  # fmt: skip
"""Lowest and highest rates [Hz], position iterations, of which PhysX takes 255, and shares."""
SHARES = ("size", "mass", "hinge")
"""Half widths of the randomisation that are shares of what they change; a task may lack some."""
NO_OVERLAP = (
    "PhysX does not report on a GPU how deep bodies overlap: no episode counts as a success there (see raw_success in "
    f"info), and overlap costs no reward. With sim_backend={BACKEND!r} it is known."
)
"""What is said of a task on a GPU."""
MOST_DELAY = 1000
"""Largest delay of an action [control steps]."""


@dataclass(frozen=True)
class TaskOptions:
    """Checked options of a task, with what they resolve to."""

    parts: frozenset[str]
    config: TaskConfig
    robots: tuple[str, ...]
    control_mode: str
    sim_backend: str
    render_backend: str


SIM_RATES = {"sim_freq": "physics_frequency", "control_freq": "control_frequency"}
"""Rates in ManiSkill's `sim_config`, and what they are called here."""


def task_config(cls: type[TaskConfig], preset: str, changes: Any, sim_config: Any = None) -> TaskConfig:
    """The numbers of a task: its own, those of the preset (randomisation and `BY_PRESET`), then `changes`, then the
    rates of ManiSkill's `sim_config`, on which more than the physics depends here.

    Raises:
        InputError: for an unknown preset, an unknown name, a value of the wrong type, a number that is not finite or
            negative where it is a size, time, speed or count, or rates that do not fit.
    """
    randomisation = find_preset(preset, cls.PRESETS)
    base: TaskConfig = replace(cls(), randomisation=randomisation, **cls.BY_PRESET.get(preset, {}))
    config = _with_rates(overridden(base, {} if changes is None else changes, "config"), sim_config)
    check_finite(config, "config")
    check_not_negative(config, "config")
    check_not_negative(config.residual, "config.residual")
    check_not_negative(config.randomisation, "config.randomisation")
    for name in SHARES:
        if (width := getattr(config.randomisation, name, 0.0)) >= 1:
            raise InputError(f"config.randomisation.{name} is {width}; it is a share and has to be below 1.")
    low, high = config.randomisation.friction
    if not 0 <= low <= high:
        raise InputError(f"config.randomisation.friction is {low, high}; it has to be a lowest and a highest value.")
    check_ranges(config, RATES, lambda name: f"config.{name}")
    check_ranges(config, {"definition": (1, cls().definition)}, lambda name: f"config.{name}")
    check_ranges(config.randomisation, {"delay": (0, MOST_DELAY)}, lambda name: f"config.randomisation.{name}")
    if config.physics_frequency % config.control_frequency:
        raise InputError(
            f"config.physics_frequency is {config.physics_frequency} Hz; it has to be a multiple of "
            f"config.control_frequency, {config.control_frequency} Hz."
        )
    return config


def numbers_under_preset(
    cls: type[TaskConfig], numbers: Mapping[str, Any], earlier: str, preset: str
) -> dict[str, Any]:
    """Numbers of a task, as plain data and perhaps not all of them, under another preset.

    The randomisation becomes that of the preset, and so does a number that presets bring (`BY_PRESET`) where it has the
    value of the earlier one. What is not there stays away: an environment takes it from its preset.

    Raises:
        InputError: for an unknown preset.
    """
    before, after = (plain(task_config(cls, name, None)) for name in (earlier, preset))
    brought = {"randomisation", *cls.BY_PRESET.get(earlier, {}), *cls.BY_PRESET.get(preset, {})}
    changed = {k for k in brought & numbers.keys() if k == "randomisation" or numbers[k] == before[k]}
    return {**numbers, **{name: after[name] for name in changed}}


def _with_rates(config: TaskConfig, sim_config: Any) -> TaskConfig:
    """The numbers with the rates of a `sim_config`; one that makes no sense is left to ManiSkill's own keywords, which
    refuse it."""
    given = vars(sim_config) if isinstance(sim_config, SimConfig) else sim_config
    given = {name: given.get(name) for name in SIM_RATES} if isinstance(given, Mapping) else {}
    whole = {name: int(v) for name, v in given.items() if isinstance(v, Integral) and not isinstance(v, bool)}
    rates = {ours: whole[theirs] for theirs, ours in SIM_RATES.items() if theirs in whole}
    changed = replace(config, **rates)
    sound = changed.control_frequency > 0 and changed.physics_frequency % changed.control_frequency == 0
    return changed if sound and changed.physics_frequency > 0 else config


def check_options(
    guidance: str,
    guidance_parts: Any,
    hand_joints: int,
    config: TaskConfig,
    robot_uids: Any,
    arms: Sequence[str],
    num_envs: Any,
    control_mode: str | None,
    sim_backend: str,
    render_backend: str | None,
    render_mode: str | None,
    obs_mode: str | None,
) -> TaskOptions:
    """Resolves defaults and refuses what cannot be built.

    `sim_backend="auto"` is "physx_cpu" for one environment and "physx_cpu_batch" for more, also where there is CUDA:
    PhysX does not report overlap on a GPU. `render_backend="auto"` is "none" unless a picture can be asked for.

    Raises:
        InputError: one sentence about the first option that is wrong.
    """
    parts = guidance_in_force(guidance, guidance_parts)
    if hand_joints not in (15, 20):
        raise InputError(
            f"hand_joints must be 20, or 15 with distal joints coupled to medial ones, not {hand_joints!r}"
        )
    if not isinstance(num_envs, int) or not 1 <= num_envs <= MOST_ENVS:
        raise InputError(f"num_envs must be a whole number from 1 to {MOST_ENVS}, not {shown(num_envs)}")
    check_room(2 * num_envs)  # a reset with a seed builds the scene anew, beside the old one
    robots = _robots(robot_uids, arms)
    mode = control_mode or CONTROL_MODES[0]
    if hand_joints == 15 and not mode.endswith(COUPLED):
        mode += COUPLED
    by_finger = CONTROL_MODES[0] + FINGERS
    known = [m + end for m in CONTROL_MODES for end in ("", COUPLED)] + [by_finger]
    if mode not in known:
        raise InputError(f"unknown control mode {control_mode!r}; choose one of {', '.join(known)}")
    if config.hand_action == "fingers" or mode == by_finger:
        if mode not in (CONTROL_MODES[0], by_finger):
            raise InputError(
                f'config.hand_action="fingers" is for {CONTROL_MODES[0]!r}, not {mode!r}: leave one of them out.'
            )
        if PRIOR in parts:
            raise InputError(
                "a number for each finger is too coarse for the residual action on a reference: use "
                'hand_action="joints", or guidance="none", or guidance_parts without "prior".'
            )
        mode, config = by_finger, replace(config, hand_action="fingers")
    if sim_backend == "auto":
        sim_backend = BACKEND if num_envs > 1 else "physx_cpu"
    if on_gpu(sim_backend):
        logger.warning(NO_OVERLAP)
    render_backend = choose_render_backend(render_backend, render_mode, obs_mode)
    return TaskOptions(parts, config, robots, mode, sim_backend, render_backend)


def check_grasps(grasps: Any, arms: Sequence[str]) -> dict[str, GraspCandidates]:
    """The `grasps` of a task by arm: given like that, or those of the only arm; none where nothing is given.

    Raises:
        InputError: they are no candidates, of no arm, or of one of several that is not named.
    """
    if grasps is None:
        return {}
    if not isinstance(grasps, Mapping) and len(arms) > 1:
        raise InputError(f"grasps must be a dictionary by arm, and there are {', '.join(arms)}: name the arms.")
    given = dict(grasps) if isinstance(grasps, Mapping) else {arms[0]: grasps}
    for arm, found in given.items():
        if arm not in arms:
            raise InputError(f"grasps are of {shown(arm)}, and there is only {', '.join(arms)}: name one of these.")
        if not isinstance(found, GraspCandidates):
            raise InputError(f"grasps must be GraspCandidates, such as GraspCandidates.load(path), not {found!r}")
    return given


def _robots(robot_uids: Any, arms: Sequence[str]) -> tuple[str, ...]:
    """Names of the robots of all arms, registered with ManiSkill; one name stands for all, and None for the task's own,
    `arms`."""
    chosen: Any = arms if robot_uids is None else robot_uids
    names = chosen if isinstance(chosen, tuple | list) else (chosen,) * len(arms)
    known = ", ".join(available_robots())
    if len(names) != len(arms):
        raise InputError(f"robot_uids must name one robot for each of {len(arms)} arms, not {len(names)}")
    for name in names:
        if not isinstance(name, str):
            raise InputError(f"robot_uids must be one of {known}, not {name!r}")
        if name not in REGISTERED_AGENTS:
            register_robot(name)
        if not issubclass(REGISTERED_AGENTS[name].agent_cls, DescribedRobot):
            raise InputError(f"robot {name!r} has no hand for this task; use one of {known}")
    return tuple(names)


def choose_render_backend(render_backend: str | None, render_mode: str | None, obs_mode: str | None) -> str:
    """The render backend for a task: "none" where no picture can be asked for, or nothing can draw it.

    ManiSkill's tools ask for a `render_mode` whether they draw or not, so that one alone is no reason to refuse, but
    for "human"; `render` does where nothing can be drawn.

    Raises:
        InputError: if observations are pictures or a window is wanted, and there is no Vulkan driver or
            `render_backend` is "none".
    """
    needed = wants_pictures(obs_mode) or render_mode == "human"
    if render_backend == "auto" and not needed and render_mode is None:
        return "none"
    if render_backend not in ("none", None) and can_render():
        default = "gpu" if torch.cuda.is_available() else "cpu"
        return default if render_backend == "auto" else render_backend
    if needed:
        refuse_pictures(obs_mode, render_mode)
    return "none"
