"""Resets and states of environments on `physx_cpu_batch`: arguments in any form, and controllers row by row."""

import difflib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from mani_skill.utils import common
from torch import Tensor

from dora.arguments import as_tensor, checked_rows, checked_seeds, is_mask, tensors
from dora.errors import InputError, shown, suggestion

START, STATES = "reset_to_env_states", "env_states"
"""Option of `reset` with states in which episodes begin, and its entry for them."""
OPTIONS, LIKE = ("env_idx", "reconfigure", START), 0.8
"""Options of `reset` that every task has, and how like one of them another name is that is taken for a slip [1]."""
KINDS = ("actors", "articulations")
"""Parts of a state that ManiSkill restores."""
QUATERNION, UNIT = slice(3, 7), 0.01
"""Columns of the orientation in the rows of a state, and the largest error of its norm [1]."""
LARGEST = 1e6
"""No number of a state of the simulator is larger: SI units and radians."""


def checked_options(options: Any, count: int, device: torch.device) -> dict[str, Any]:
    """Options of `reset` with `env_idx` as whole numbers and states as tensors; the given ones stay as they are.

    Args:
        options: as of ManiSkill's `reset`, or None. With a mask as `env_idx`, states may have a row for each
            environment, of which those of the mask are used. ManiSkill writes rows in ascending order whatever
            `env_idx` says, so it becomes ascending, and states are put in that order.
        count: how many environments there are.
        device: where tensors are wanted.

    Raises:
        InputError: the options, `env_idx` or the states are of another kind.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise InputError(f"the options of reset must be a dictionary, not {options!r}.")
    for name in options:
        near = difflib.get_close_matches(str(name), OPTIONS, 1, LIKE)
        if near and name not in OPTIONS:
            raise InputError(f"reset has no option {name!r}: did you mean {near[0]!r}?")
    out = {name: value for name, value in options.items() if not (name in OPTIONS and value is None)}
    if not isinstance(again := out.get("reconfigure", False), bool | np.bool_):
        raise InputError(f"options['reconfigure'] must be True or False, not {shown(again)}.")
    mask = order = None
    if "env_idx" in out:
        rows = checked_rows(out["env_idx"], count, device)
        mask = rows if is_mask(out["env_idx"]) else None
        out["env_idx"], order = rows.sort()
        if again and len(rows) < count:
            raise InputError("options has both reconfigure and some of the environments: a scene is built for all.")
    if START in out:
        start = out[START]
        if not isinstance(start, Mapping) or start.get(STATES) is None:
            raise InputError(f"options[{START!r}] must be a dictionary with {STATES!r} and perhaps 'obs'.")
        given = {name: tensors(value, name, device) for name, value in start.items() if value is not None}
        out[START] = {name: _in_order(_of_mask(value, mask, count), order) for name, value in given.items()}
        states = out[START][STATES]
        if isinstance(states, dict):
            check_parts(states, STATES)
            for kind in KINDS:
                check_finite_state(states.get(kind, {}), f"{STATES}[{kind!r}]")
    return out


def check_parts(state: Mapping[str, Any], what: str) -> None:
    """Refuse a state that has no part that ManiSkill restores, or one that is no dictionary.

    Raises:
        InputError: naming the part.
    """
    near = [name for name in state if name not in KINDS and difflib.get_close_matches(str(name), KINDS, 1, LIKE)]
    if near or not any(kind in state for kind in KINDS):
        has = f"has {', '.join(map(shown, near or state))}" if state else "is empty"
        raise InputError(f"{what} {has}: its parts are those of get_state_dict, {' and '.join(KINDS)}.")
    for name in (*KINDS, "controller"):
        if not isinstance(state.get(name, {}), Mapping):
            raise InputError(f"{what}[{name!r}] must be a dictionary, not {shown(state[name])}.")


def _in_order(state: Any, order: Tensor | None) -> Any:
    """A state whose rows are put in another order, as far as it has so many; one row stands for all."""
    if isinstance(state, dict):
        return {name: _in_order(part, order) for name, part in state.items()}
    return state if order is None or state.ndim == 0 or len(state) != len(order) else state[order]


def _of_mask(state: Any, rows: Tensor | None, count: int) -> Any:
    """The rows of a mask of a state that has a row for each environment."""
    if isinstance(state, dict):
        return {name: _of_mask(part, rows, count) for name, part in state.items()}
    return state if rows is None or state.ndim == 0 or len(state) != count else state[rows]


def nothing_reset(env: Any) -> tuple[Any, dict[str, Any]]:
    """What `reset` of no environment returns: the present observation and info."""
    info = env.get_info()
    return env.get_obs(info), info | {"reconfigure": False}


def reset(original: Callable, env: Any, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
    """ManiSkill's `reset` with seeds and options in any form.

    A partial reset leaves the controllers' targets of the other environments as they are, and states restore those
    that they hold.
    """
    options, seeds = checked_options(options, env.num_envs, env.device), checked_seeds(seed, env.num_envs)
    rows, start = options.get("env_idx"), options.get(START, {})
    if rows is not None and len(rows) == 0:
        return nothing_reset(env)
    if "obs" in start:  # ManiSkill writes into the observation that it returned last
        env._last_obs = common.torch_clone_dict(env._last_obs)
    states = start.get(STATES)
    targets = states.get("controller", {}) if isinstance(states, dict) else {}
    if "obs" in start:
        _check_like(start["obs"], env._last_obs, env.num_envs if rows is None else len(rows), f"{START}['obs']")
    if targets:
        _check_known(targets, env.agent.controller, f"{STATES}['controller']")
    with _controllers_of(env, rows, targets):
        return original(env, seed=seeds, options=options)


def _check_like(given: Any, last: Any, count: int, what: str) -> None:
    """Refuse an observation of `count` environments whose parts or sizes are not those of the last one."""
    if isinstance(last, Mapping) or isinstance(given, Mapping):
        if not (isinstance(last, Mapping) and isinstance(given, Mapping) and last.keys() == given.keys()):
            raise InputError(f"{what} must be an observation of this environment, with all of its parts.")
        for name, part in last.items():
            _check_like(given[name], part, count, f"{what}[{name!r}]")
    elif given.shape != (needed := (count, *last.shape[1:])):
        raise InputError(f"{what} has shape {tuple(given.shape)} but {tuple(needed)} is needed.")


def _check_known(targets: Mapping[str, Any], controller: Any, what: str) -> None:
    """Refuse a state of controllers that names one that there is not."""
    several = isinstance(controller, dict)
    known = {uid: each.get_state() for uid, each in controller.items()} if several else controller.get_state()
    unknown = [name for name in targets if name not in known]
    if unknown:
        raise InputError(f"{what} has {shown(unknown[0])}, which the robot has not: {suggestion(unknown[0], known)}")


@contextmanager
def _controllers_of(env: Any, rows: Tensor | None, targets: Mapping[str, Any]) -> Iterator[None]:
    """Context in which `reset` of the controllers is about some environments, and then restores their targets."""
    agent = getattr(env, "agent", None)
    if agent is None or (rows is None and not targets):
        yield
        return
    rows = torch.arange(env.num_envs, device=env.device) if rows is None else rows
    several = isinstance(agent.controller, dict)
    controllers = agent.controller if several else {"": agent.controller}
    for uid, controller in controllers.items():
        own = targets.get(uid, {}) if several else targets
        controller.reset = partial(_reset_controller, controller, controller.reset, env, rows, own)
    try:
        yield
    finally:
        for controller in controllers.values():
            vars(controller).pop("reset", None)


def _reset_controller(
    controller: Any, original: Callable[[], None], env: Any, rows: Int[Tensor, " b"], targets: Mapping[str, Any]
) -> None:
    scene = env.scene
    kept, scene._reset_mask = scene._reset_mask, torch.zeros_like(scene._reset_mask)
    scene._reset_mask[rows] = True
    try:
        original()
    finally:
        scene._reset_mask = kept
    if targets:
        controller.set_state(_merged(controller.get_state(), targets, rows))


def _merged(state: Mapping[str, Any], new: Mapping[str, Any], rows: Tensor) -> dict[str, Any]:
    """A state of controllers with some rows replaced by those of another one, as far as it has them."""
    out = dict(state)
    for name in state.keys() & new.keys():
        if isinstance(state[name], Mapping):
            out[name] = _merged(state[name], new[name], rows)
        else:
            out[name] = state[name].clone()
            out[name][rows] = new[name].reshape(-1, *state[name].shape[1:])
    return out


# ---- states --------------------------------------------------------------------------------------


def set_state_dict(original: Callable, env: Any, state: Any, env_idx: Any = None) -> None:
    """ManiSkill's `set_state_dict` with arrays, lists or tensors, for all environments or for those of `env_idx`."""
    rows = None if env_idx is None else checked_rows(env_idx, env.num_envs, env.device)
    if not isinstance(state, Mapping):
        raise InputError(f"the state must be a dictionary as of get_state_dict, not {type(state).__name__}.")
    check_parts(state, "the state")
    state = tensors(state, "state", env.device)
    count = env.num_envs if rows is None else len(rows)
    rows, order = (None, slice(None)) if rows is None else rows.sort()
    for kind in KINDS:
        known = getattr(env.scene.state_dict_registry, kind)
        for name, values in state.get(kind, {}).items():
            if name not in known:
                raise InputError(f"the state has {kind} {name!r}, which the scene has not: {suggestion(name, known)}")
            size = 13 if kind == "actors" else 13 + 2 * known[name].max_dof
            everywhere = len(known[name]._objs) == env.num_envs
            shape, what = (count if everywhere else len(values), size), f"state[{kind!r}][{name!r}]"
            state[kind][name] = rows_of(values, *shape, what)[order if everywhere else ...]
            check_body(values, what)
    if count:
        original(env, state, *(() if rows is None else (rows,)))


def check_finite_state(state: Any, what: str) -> None:
    """Refuse a state, or observation, that holds NaN or infinity, which would end in the simulator.

    Raises:
        InputError: naming the part.
    """
    if isinstance(state, Mapping):
        for name, part in state.items():
            check_finite_state(part, f"{what}[{name!r}]")
    elif state.is_floating_point() and not bool(state.isfinite().all()):
        raise InputError(f"{what} holds a number that is not finite: give the state of a simulation that is sound.")


def check_body(values: Tensor, what: str) -> None:
    """Refuse rows (..., 13 or more) of a state of a body or robot that no simulation can be in.

    Raises:
        InputError: a number is not finite or above `LARGEST`, or a quaternion is not of norm 1.
    """
    check_finite_state(values, what)
    values = values.float()
    if bool((values.abs() > LARGEST).any()):
        raise InputError(f"{what} holds a number above {LARGEST:g}: give the state of a simulation that is sound.")
    if bool(((values[..., QUATERNION].norm(dim=-1) - 1).abs() > UNIT).any()):
        raise InputError(f"{what} has a quaternion (columns 3 to 6) whose norm is not 1: divide it by its norm.")


def rows_of(values: Tensor, count: int, size: int, what: str) -> Tensor:
    """Values of `count` environments as (count, size); one row, or one without the first axis, stands for all.

    Raises:
        InputError: if they have another shape.
    """
    rows = values[None] if values.ndim == 1 else values
    if rows.ndim != 2 or rows.shape[1] != size or len(rows) not in (1, count):
        raise InputError(f"{what} has shape {tuple(values.shape)} but {(count, size)} is needed.")
    return rows.expand(count, size)


def set_state(original: Callable, env: Any, state: Any, env_idx: Any = None) -> None:
    """ManiSkill's `set_state` with an array, lists or a tensor: a row as of `get_state` for each environment."""
    rows = None if env_idx is None else checked_rows(env_idx, env.num_envs, env.device)
    flat = as_tensor(state, "state", env.device)
    needed = sum(values.shape[-1] for kind in KINDS for values in env._init_raw_state[kind].values())
    whole = env.get_state().shape[1]
    size = needed if flat.ndim and flat.shape[-1] == needed else whole
    flat = rows_of(flat, env.num_envs if rows is None else len(rows), size, "the state")
    widths = [values.shape[-1] for kind in KINDS for values in env._init_raw_state[kind].values()]
    for body in flat[:, :needed].split(widths, -1):
        check_body(body, "the state")
    original(env, flat, rows)
