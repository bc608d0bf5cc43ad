"""Actions before they reach the simulator: made tensors; shape, robots' names and finite numbers are checked."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Bool, Float

from dora.arguments import as_tensor
from dora.errors import InputError, suggestion

MOST_LISTED = 8
"""Environments that a message names at most [1]."""


def plain_action(action: Any, device: torch.device | str) -> Any:
    """An action for `BaseEnv.step`, its numbers as float32 tensors without gradient; None stays None.

    Args:
        action: None, anything a tensor can be made of, or a dictionary as of `check_action`.
        device: where tensors are wanted.

    Raises:
        InputError: no tensor can be made of it.
    """
    if action is None:
        return None
    if not isinstance(action, Mapping):
        return as_tensor(action, "The action", device).to(torch.float32)
    names = ("action",) if "control_mode" in action else tuple(action)
    if lacking := [name for name in names if action.get(name) is None]:
        raise InputError(f"The action has no {lacking[0]!r}: a dictionary needs numbers for each of its parts.")
    return {**action, **{name: as_tensor(action[name], f"The action {name!r}", device).float() for name in names}}


def check_action(env: Any, action: Any) -> None:
    """Check an action for `BaseEnv.step`.

    Args:
        env: an unwrapped ManiSkill environment on `physx_cpu_batch`.
        action: None, an array (environments, dimension), or a dictionary of those by robot, or a dictionary
            with ``control_mode`` and ``action``, which puts that mode in force. One environment may leave the batch
            axis out.

    Raises:
        InputError: a shape or a robot's name does not fit, or a number is not finite.
    """
    if action is not None and env.agent is None:
        raise InputError("The environment has no robot: pass None as the action.")
    if isinstance(action, Mapping) and "control_mode" in action:
        if (modes := getattr(env.agent, "supported_control_modes", None)) is None:
            raise _several(env.agent.single_action_space)
        if action["control_mode"] not in modes:
            mode = action["control_mode"]
            raise InputError(f"The action is for the unknown control_mode {mode!r}: {suggestion(mode, modes)}")
        if action["control_mode"] == env.agent.control_mode:
            check_array(action.get("action"), env.agent.single_action_space, env.num_envs)
        else:
            _switch_mode(env, action["control_mode"], action.get("action"))
    elif isinstance(action, Mapping):
        _check_robots(env, action)
    elif isinstance(action, np.ndarray | torch.Tensor):
        check_array(action, env.agent.single_action_space, env.num_envs, "")


def _switch_mode(env: Any, mode: str, action: Any) -> None:
    """Puts another control mode in force, as ManiSkill would, if the action fits it; else everything stays as it is."""
    agent, present = env.agent, env.agent.control_mode
    is_new = mode not in agent.controllers
    agent.set_control_mode(mode)
    try:
        check_array(action, agent.single_action_space, env.num_envs, f" for {mode}")
    except InputError:
        agent.set_control_mode(present)
        if is_new:  # ManiSkill sets the properties of the drives when it makes a controller
            del agent.controllers[mode]
            agent.controller.set_drive_property()
        raise
    agent.controller.reset()


def _check_robots(env: Any, action: Mapping[Any, Any]) -> None:
    space = env.agent.single_action_space
    if not isinstance(space, spaces.Dict):
        raise InputError(
            f"The action is a dictionary but there is one robot only: pass an array of shape "
            f"({env.num_envs}, {space.shape[0]})."
        )
    if action.keys() != space.spaces.keys():
        raise InputError(f"The action has keys {sorted(action, key=str)} but the robots are {sorted(space.spaces)}.")
    for name, part in action.items():
        check_array(part, space[name], env.num_envs, f" of {name}")


def check_array(action: Any, space: Any, environments: int, whose: str = "") -> None:
    """Check an array of actions (environments, dimension) of a space of one action; InputError as `check_action`."""
    if isinstance(space, spaces.Dict):
        raise _several(space)
    shape, single = tuple(np.shape(action)), tuple(space.shape)
    if shape != (environments, *single) and not (environments == 1 and shape == single):
        raise InputError(f"The action{whose} has shape {shape} but {(environments, *single)} is needed.")
    _check_finite(action, whose, environments)


def _several(space: spaces.Dict) -> InputError:
    return InputError(f"There are several robots: pass a dictionary of actions for {sorted(space.spaces)}.")


def _check_finite(action: Any, whose: str, environments: int) -> None:
    finite = action.isfinite() if isinstance(action, torch.Tensor) else torch.as_tensor(np.isfinite(action))
    if not finite.all():
        rows = (~finite.reshape(environments, -1).all(1)).nonzero()[:, 0].tolist()
        whose += f" of environment{'s' if len(rows) > 1 else ''} {_listed(rows)}"
        raise InputError(f"The action{whose} contains NaN or infinity: all its numbers must be finite.")


def _listed(rows: list[int]) -> str:
    """Indices with commas, the first few if there are many."""
    text = ", ".join(map(str, rows[:MOST_LISTED]))
    return text + (f" and {len(rows) - MOST_LISTED} more" if len(rows) > MOST_LISTED else "")


def finite_rows(action: Any, bad: Bool[np.ndarray, " n"]) -> Any:
    """What an environment computed as its robots' action, with 0 in the rows that are not finite.

    Args:
        action: a tensor (n, a), a dictionary of those, or anything else, which stays as it is.
        bad: is set where a row is not finite.
    """
    if isinstance(action, Mapping):
        return {name: finite_rows(part, bad) for name, part in action.items()}
    if not isinstance(action, torch.Tensor) or action.shape[:1] != bad.shape or action.isfinite().all():
        return action
    rows = ~action.reshape(len(bad), -1).isfinite().all(1)
    bad |= rows.numpy(force=True)
    return torch.where(rows.reshape(-1, *[1] * (action.ndim - 1)), torch.zeros_like(action), action)


def checked_action(action: Any, space: Any, num_envs: int, device: torch.device) -> Float[torch.Tensor, "n a"] | None:
    """An action, anything a tensor can be made of, as an (n, a) tensor without gradient; None stays None.

    Numbers beyond the bounds of the space are clipped to them.

    Raises:
        InputError: as `check_array`.
    """
    if action is None:
        return None
    out = plain_action(action, device)
    check_array(out, space, num_envs)
    low, high = (torch.as_tensor(bound, device=device) for bound in (space.low, space.high))
    wide = out if out.is_floating_point() else out.double()
    return wide.clamp(low.to(wide.dtype), high.to(wide.dtype)).to(torch.float32).reshape(num_envs, -1)
