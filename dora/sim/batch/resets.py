"""Resets and states of environments on `physx_cpu_batch`: arguments in any form, and controllers row by row."""

import difflib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from math import prod
from typing import Any

import torch
from jaxtyping import Int
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import common
from torch import Tensor

from dora.arguments import as_tensor, checked_rows, checked_seeds, checked_truth, is_mask, tensors
from dora.errors import InputError, shown, suggestion

START, STATES = "reset_to_env_states", "env_states"
"""Option of `reset` with states in which episodes begin, and its entry for them."""
OPTIONS = ("env_idx", "reconfigure", START)
"""Options of `reset` that ManiSkill knows."""
OPTIONS_OF_TASKS = ("episode_id", "build_config_idxs", "init_config_idxs")
"""Options that tasks of ManiSkill know besides; others may have further ones."""
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
        InputError: the options, `env_idx` or the states are of another kind, or a name is nearly one of `OPTIONS`.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise InputError(f"the options of reset must be a dictionary, not {shown(options)}.")
    for name in options:
        if name not in OPTIONS_OF_TASKS + OPTIONS and difflib.get_close_matches(str(name).lower(), OPTIONS, 1):
            raise InputError(f"reset has no option {name!r}: {suggestion(str(name).lower(), OPTIONS)}")
    out = {name: value for name, value in options.items() if not (name in OPTIONS and value is None)}
    mask = order = None
    if "reconfigure" in out:
        out["reconfigure"] = checked_truth(out["reconfigure"], "options['reconfigure']")
    if "env_idx" in out:
        rows = checked_rows(out["env_idx"], count, device)
        mask = rows if is_mask(out["env_idx"]) else None
        out["env_idx"], order = rows.sort()
        if out.get("reconfigure") and len(rows) < count:
            raise InputError("'reconfigure' builds all environments anew: leave out it, or 'env_idx', in the options.")
    if START in out:
        start = out[START]
        if not isinstance(start, Mapping) or start.get(STATES) is None or not {*start} <= {STATES, "obs"}:
            raise InputError(f"options[{START!r}] must be a dictionary with {STATES!r} and perhaps 'obs'.")
        given = {name: tensors(value, name, device) for name, value in start.items() if value is not None}
        out[START] = {name: _in_order(_of_mask(value, mask, count), order) for name, value in given.items()}
        states = out[START][STATES]
        for kind in KINDS if isinstance(states, dict) else ():
            check_finite_state(states.get(kind, {}), f"{STATES}[{kind!r}]")
    return out


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
    check_rebuilding(env, options)
    _check_start(env, start, env.num_envs if rows is None else len(rows), _rebuilds(env, options))
    if "obs" in start:  # ManiSkill writes into the observation that it returned last
        env._last_obs = common.torch_clone_dict(env._last_obs)
    states = start.get(STATES)
    targets = states.get("controller", {}) if isinstance(states, dict) else _controllers_in(env, states)
    rebuilds = _rebuilds(env, options)
    with _controllers_of(env, rows, targets):
        obs, info = original(env, seed=seeds, options=options)
    if rebuilds and targets and _has_usual_states(env):  # the robots are new ones
        _restore_targets(env, targets)
        env._last_obs = obs = env.get_obs(info)
    return obs, info


def _rebuilds(env: Any, options: Mapping[str, Any]) -> bool:
    """Whether ManiSkill's `reset` builds the scene anew."""
    return options.get("reconfigure", False) or (env._reconfig_counter == 0 and env.reconfiguration_freq != 0)


def check_rebuilding(env: Any, options: Mapping[str, Any]) -> None:
    """Refuse a reset of some environments that is due to build the scene of all anew.

    Args:
        env: the environment.
        options: as of `checked_options`.

    Raises:
        InputError: `reconfiguration_freq` asks for a new scene.
    """
    if "env_idx" in options and len(options["env_idx"]) < env.num_envs and _rebuilds(env, options):
        raise InputError(
            f"reconfiguration_freq is {env.reconfiguration_freq}, and this reset is due to build all environments "
            "anew: leave out 'env_idx', or make the environment with reconfiguration_freq=0."
        )


def _check_start(env: Any, start: Mapping[str, Any], count: int, rebuilds: bool) -> None:
    """Refuse states, targets of controllers and observations for `count` environments before anything is set.

    A task with a `set_state_dict` of its own knows what a state of it holds, and a new scene may hold other objects.
    """
    states = start.get(STATES)
    if states is not None and not rebuilds and _has_usual_states(env):
        if isinstance(states, dict):
            _checked_parts(env, states, count)
        else:
            _checked_flat(env, states, count)
    if isinstance(states, dict) and "controller" in states:
        known = env.agent.get_controller_state() if getattr(env, "agent", None) is not None else {}
        check_finite_state(states["controller"], f"{STATES}['controller']")
        check_fits(states["controller"], known, count, f"{STATES}['controller']", whole=False)
    if "obs" in start:
        check_fits(start["obs"], env._last_obs, count, "obs")


def check_fits(given: Any, like: Any, count: int, what: str, *, whole: bool = True) -> None:
    """Refuse numbers of `count` environments that are not like others in names and shapes; one row stands for all.

    Args:
        given: nested dicts of tensors.
        like: the same with a row for each environment; where it is an empty dictionary, nothing is compared.
        count: how many environments there are.
        what: how messages call them.
        whole: whether everything has to be there.

    Raises:
        InputError: naming the first part that is unknown, missing or of another shape.
    """
    if isinstance(like, Mapping):
        if not isinstance(given, Mapping):
            raise InputError(f"{what} must be a dictionary with {', '.join(like) or 'no entries'}.")
        if unknown := [name for name in given if like and name not in like]:
            raise InputError(f"{what} has {unknown[0]!r}, which is not known here: {suggestion(unknown[0], like)}")
        if lacking := [name for name in like if whole and name not in given]:
            raise InputError(f"{what} lacks {lacking[0]!r}: give all of {', '.join(like)}.")
        for name in given.keys() & like.keys():
            check_fits(given[name], like[name], count, f"{what}[{name!r}]", whole=whole)
        return
    row = tuple(like.shape[1:])
    if isinstance(given, Mapping) or tuple(given.shape) not in ((count, *row), (1, *row), row):
        shape = "names" if isinstance(given, Mapping) else f"shape {tuple(given.shape)}"
        raise InputError(f"{what} has {shape} but numbers of shape {(count, *row)} are needed.")


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


def _controllers_in(env: Any, flat: Tensor | None) -> dict[str, Any]:
    """The state of the controllers in rows as of `get_state`; empty if they have none."""
    whole = env._init_raw_state if flat is not None else {}
    widths = [prod(leaf.shape[1:]) for leaf in leaves_of(whole)]
    if flat is None or "controller" not in whole or flat.shape[-1] != sum(widths):
        return {}
    columns = flat.reshape(-1, flat.shape[-1]).split(widths, -1)
    return with_leaves(whole, iter(columns))["controller"]


def leaves_of(state: Mapping[str, Any]) -> Iterator[Tensor]:
    """The tensors of a state, in its order."""
    for part in state.values():
        yield from leaves_of(part) if isinstance(part, Mapping) else [part]


def with_leaves(state: Mapping[str, Any], leaves: Iterator[Tensor]) -> dict[str, Any]:
    """A state with other leaves, in the same order."""
    return {name: with_leaves(p, leaves) if isinstance(p, Mapping) else next(leaves) for name, p in state.items()}


def _restore_targets(env: Any, targets: Mapping[str, Any]) -> None:
    """Gives all environments' controllers the targets of a state."""
    rows, several = torch.arange(env.num_envs, device=env.device), isinstance(env.agent.controller, dict)
    for uid, controller in (env.agent.controller if several else {"": env.agent.controller}).items():
        own = targets.get(uid, {}) if several else targets
        if own:
            controller.set_state(_merged(controller.get_state(), own, rows))


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


def get_state_dict(original: Callable, env: Any) -> dict[str, Any]:
    """ManiSkill's `get_state_dict`, which does not change with the controllers whose targets it holds."""
    state = original(env)
    return state | {name: _cloned(state[name]) for name in ("controller",) if name in state}


def _cloned(state: Any) -> Any:
    if isinstance(state, Mapping):
        return {name: _cloned(part) for name, part in state.items()}
    return state.clone() if isinstance(state, Tensor) else state


def set_state_dict(original: Callable, env: Any, state: Any, env_idx: Any = None) -> None:
    """ManiSkill's `set_state_dict` with arrays, lists or tensors, for all environments or for those of `env_idx`."""
    rows = None if env_idx is None else checked_rows(env_idx, env.num_envs, env.device)
    count = env.num_envs if rows is None else len(rows)
    state = _checked_parts(env, state, count)
    rows, order = (None, slice(None)) if rows is None else rows.sort()
    for kind in KINDS:
        for name, values in state.get(kind, {}).items():
            state[kind][name] = values[order if _is_everywhere(env, kind, name) else ...]
    if count:
        original(env, state, *(() if rows is None else (rows,)))


def _has_usual_states(env: Any) -> bool:
    """Whether a task's states are ManiSkill's, and hold nothing of its own."""
    return all(getattr(type(env), name) is getattr(BaseEnv, name) for name in ("get_state_dict", "set_state_dict"))


def _is_everywhere(env: Any, kind: str, name: str) -> bool:
    """Whether each environment has an actor or articulation."""
    return len(getattr(env.scene.state_dict_registry, kind)[name]._objs) == env.num_envs


def _checked_parts(env: Any, state: Any, count: int) -> dict[str, Any]:
    """A state of the simulator as tensors with `count` rows.

    Raises:
        InputError: a name is unknown, nothing would be set, or a part has another shape or is in no sound simulation.
    """
    if not isinstance(state, Mapping):
        raise InputError(f"the state must be a dictionary as of get_state_dict, not {type(state).__name__}.")
    parts = (*KINDS, "controller")
    if _has_usual_states(env) and (unknown := [name for name in state if name not in parts]):
        raise InputError(f"the state has {unknown[0]!r}, which no state has: {suggestion(unknown[0], parts)}")
    registry = {kind: getattr(env.scene.state_dict_registry, kind) for kind in KINDS}
    for kind in KINDS:
        if not isinstance(state.get(kind, {}), Mapping):
            raise InputError(f"state[{kind!r}] must be a dictionary of rows by name, not {shown(state[kind])}.")
    if not any(state.get(kind) for kind in KINDS) and any(registry.values()):
        raise InputError("the state has nothing in 'actors' or 'articulations': give one as of get_state_dict.")
    state = tensors(state, "state", env.device)
    for kind, known in registry.items():
        for name, values in state.get(kind, {}).items():
            if name not in known:
                raise InputError(f"the state has {kind} {name!r}, which the scene has not: {suggestion(name, known)}")
            size, what = 13 if kind == "actors" else 13 + 2 * known[name].max_dof, f"state[{kind!r}][{name!r}]"
            if isinstance(values, dict):
                raise InputError(f"{what} must be rows of {size} numbers, not a dictionary.")
            rows = count if _is_everywhere(env, kind, name) else len(values) if values.ndim else 1
            state[kind][name] = rows_of(values, rows, size, what)
            check_body(values, what)
    return state


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
    original(env, _checked_flat(env, state, env.num_envs if rows is None else len(rows)), rows)


def _checked_flat(env: Any, state: Any, count: int) -> Tensor:
    """Rows as of `get_state`, or of the simulator alone, as a tensor with `count` rows.

    Raises:
        InputError: they have another shape, or are in no sound simulation.
    """
    flat = as_tensor(state, "the state", env.device)
    widths = [values.shape[-1] for kind in KINDS for values in env._init_raw_state.get(kind, {}).values()]
    needed, whole = sum(widths), sum(prod(leaf.shape[1:]) for leaf in leaves_of(env._init_raw_state))
    size = needed if flat.ndim and flat.shape[-1] == needed else whole
    flat = rows_of(flat, count, size, "the state")
    for body in flat[:, :needed].split(widths, -1):
        check_body(body, "the state")
    return flat
