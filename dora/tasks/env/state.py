"""Saving and restoring what a task remembers beside the simulator: memory, stages, guides, noise, sizes."""

import copy
from collections.abc import Callable, Mapping
from math import inf, prod
from typing import Any

import torch
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from torch import Tensor

from dora.arguments import as_tensor, checked_rows, taken, tensors
from dora.errors import InputError, suggestion
from dora.sim.batch.resets import (
    KINDS,
    STATES,
    check_body,
    check_finite_state,
    check_fits,
    leaves_of,
    rows_of,
    with_leaves,
)  # fmt: skip

RANGES = {"mass": (1e-9, 1e9), "friction": (0.0, 1e9), "scale": (1e-3, 1e3), "elapsed": (0.0, 1e9)}
"""Ranges of numbers of "task" and "memory" in a state, by the last word of their name: masses [kg], friction [1],
relative sizes [1] and control steps [1]."""
IN_PLACE = "in_place"
"""Option of the beginning of an episode whose robots and objects are where they shall be."""
NOT_MEASURED = ("episode.penetration", "episode.max_penetration")
"""Numbers of the memory that are NaN where overlap is not measured."""
LATER = ("episode.failed",)
"""Numbers that states of earlier versions lack: 0."""


def remembered(env: Any) -> dict[str, Any]:
    """What a task remembers of an episode, by name; each has get_state() and set_state(state, rows)."""
    guides = {f"guide.{name}": arm.guide for name, arm in env.arms.items()}
    own = {"memory": env.memory, "machine": env.machine, "perturbations": env.perturbations.buffers}
    past = {"past": env.past.buffers} if env.past.steps else {}
    return own | guides | past | env.task.stateful()


def saved_state(env: Any, simulator: dict[str, Any]) -> dict[str, Any]:
    """ManiSkill's state of simulator and controllers with the task's beside it, all tensors (n, ...)."""
    own: dict[str, dict[str, Tensor]] = {name: part.get_state() for name, part in remembered(env).items()}
    own["task"] = {"elapsed": env._elapsed_steps.clone(), "scale": env.scale.clone()}
    return simulator | {name: {k: v.flatten(min(1, v.ndim - 1)) for k, v in part.items()} for name, part in own.items()}


def checked_state(env: Any, state: Any, rows: Tensor) -> dict[str, Any]:
    """A state as tensors with a row for each of the environments `rows`, from arrays or lists, or from one row for all.

    Raises:
        InputError: something is missing, has another shape than in this environment, or is in no sound simulation.
    """
    if not isinstance(state, Mapping):
        raise InputError(f"the state must be a dictionary as of get_state_dict, not {type(state).__name__}.")
    known = (*KINDS, "controller", "task", *remembered(env))
    if unknown := [name for name in state if name not in known]:
        raise InputError(f"the state has {unknown[0]!r}, which this task has not: {suggestion(unknown[0], known)}")
    needed = [*KINDS, *(["task", *remembered(env)] if "task" in state else [])]
    given = {name: state[name] for name in (*needed, "controller") if name in state}
    if lacking := [name for name in needed if name not in given]:
        raise InputError(
            f"the state lacks {lacking[0]!r}: it has to be one of {type(env).__name__} with these options."
        )
    fitted = _fitted(tensors(given, "state", env.device), env._init_raw_state, len(rows), "state")
    _check(env, fitted)
    return fitted


def check_start(env: Any, start: Mapping[str, Any], rows: Tensor) -> None:
    """Refuse states and observations to begin in before anything is set.

    Args:
        env: the environment.
        start: the states and perhaps an observation, as of `dora.sim.batch.resets.checked_options`.
        rows: environments (b,) that begin in them.

    Raises:
        InputError: as `checked_state` and `dora.sim.batch.resets.check_fits`.
    """
    states = start[STATES]
    checked_state(env, states if isinstance(states, dict) else unflattened(env, states, rows), rows)
    if "obs" in start:
        check_fits(start["obs"], env._last_obs, len(rows), "obs")


def _check(env: Any, state: dict[str, Any]) -> None:
    """Refuses a state, as of `_fitted`, with numbers that are not finite or out of range."""
    measured = {name: v for name, v in state.get("memory", {}).items() if name not in NOT_MEASURED}
    check_finite_state(state | {"memory": measured}, "state")
    for kind in KINDS:
        for name, values in state[kind].items():
            check_body(values, f"state[{kind!r}][{name!r}]")
    if "task" not in state:
        return
    parts = remembered(env)
    for part in ("task", *parts):
        own = parts[part].state_ranges() if hasattr(parts.get(part), "state_ranges") else {}
        usual = RANGES if part in ("task", "memory") else {}
        for name, values in state[part].items():
            low, high = own.get(name) or usual.get(name.split(".")[-1], (-inf, inf))
            if bool(((values < low) | (values > high)).any()):
                raise InputError(f"state[{part!r}][{name!r}] has a number not from {low:g} to {high:g}: correct it.")


def _fitted(state: dict[str, Any], like: Mapping[str, Any], count: int, what: str) -> dict[str, Any]:
    out = {}
    if unknown := [name for name in state if name not in like]:
        raise InputError(f"{what} has {unknown[0]!r}, which is not known here: {suggestion(unknown[0], like)}")
    for name, part in like.items():
        path = f"{what}[{name!r}]"
        if name not in state:
            if name in LATER:
                out[name] = torch.zeros(count, *part.shape[1:], dtype=part.dtype, device=part.device)
            elif what != "state":  # whole parts may be missing, as in states of the simulator alone
                raise InputError(f"{path} is missing: the state has to be one of this task with these options.")
        elif isinstance(part, Mapping):
            if not isinstance(state[name], dict):
                raise InputError(f"{path} must be a dictionary with {', '.join(part)}.")
            out[name] = _fitted(state[name], part, count, path)
        elif isinstance(state[name], dict):
            raise InputError(f"{path} must be rows of numbers, not a dictionary.")
        else:
            out[name] = _rows(state[name], part, count, path)
    return out


def _rows(values: Tensor, like: Tensor, count: int, what: str) -> Tensor:
    """Values (count, size) or (count,) as in the state `like`, which has a row for each environment."""
    if like.ndim == 1:
        values = values.reshape(-1, 1)
    return rows_of(values, count, prod(like.shape[1:]), what).reshape(count, *like.shape[1:]).to(like.dtype)


def set_rows(env: Any, simulator: Callable[..., None], state: Any, env_idx: Any) -> None:
    """What `DoraEnv.set_state_dict` does.

    Args:
        env: the environment.
        simulator: ManiSkill's `set_state_dict`, for the simulator alone.
        state: rows as of `get_state_dict`, or one for all.
        env_idx: environments, or None for all.

    Raises:
        InputError: as `dora.arguments.checked_rows` and `checked_state`.
    """
    rows = _chosen(env, env_idx)
    if len(rows) == 0:
        return
    order = rows.argsort()  # in which ManiSkill writes rows
    rows, state = rows[order], taken(checked_state(env, state, rows), order)
    resize(env, state, rows)
    partial = {} if env_idx is None else {"env_idx": rows}
    simulator({kind: state[kind] for kind in KINDS}, **partial)
    restore(env, state, rows)
    env._snapshot = None


def _chosen(env: Any, env_idx: Any) -> Tensor:
    return checked_rows(slice(None) if env_idx is None else env_idx, env.num_envs, env.device)


def unflattened(env: Any, flat: Any, env_idx: Any) -> dict[str, Any]:
    """The state dictionary of rows as of `get_state`, or of those of the simulator alone (as ManiSkill reads them).

    Args:
        env: the environment.
        flat: (count, size) numbers, or (size,).
        env_idx: environments, or None for all.

    Raises:
        InputError: the rows have another length.
    """
    rows = as_tensor(flat, "the state", env.device)
    like = env._init_raw_state
    simulator = {kind: like[kind] for kind in KINDS}
    short = sum(_width(leaf) for leaf in leaves_of(simulator))
    like = simulator if rows.ndim and rows.shape[-1] == short else like
    widths = [_width(leaf) for leaf in leaves_of(like)]
    columns = rows_of(rows, len(_chosen(env, env_idx)), sum(widths), "the state").split(widths, -1)
    return with_leaves(like, iter(columns))


def _width(leaf: Tensor) -> int:
    return prod(leaf.shape[1:])


def restore(env: Any, state: dict, rows: Tensor) -> None:
    """Inverse of `saved_state` for the environments `rows` (b,), whose simulator has been restored: controllers and,
    if it holds them, the task's parts. In a reset to a state of the simulator alone a new episode begins there."""
    if "controller" in state:
        for k, arm in enumerate(env.arms.values()):
            if arm.agent.commands_wrist:
                own = state["controller"] if len(env.arms) == 1 else state["controller"][f"{arm.agent.uid}-{k}"]
                arm.agent.wrist_controller.restore(own["target"], rows)
                if env.resetting:  # ManiSkill resets controllers after it has restored the state
                    arm.agent.wrist_controller.expect_reset(torch.zeros_like(env.scene._reset_mask))
    if "task" in state:
        env._elapsed_steps[rows] = state["task"]["elapsed"].reshape(-1).to(env._elapsed_steps.dtype)
        for name, part in remembered(env).items():
            part.set_state(state[name], rows)
        env.task_scene.apply_properties(env.memory, rows)
    elif env.resetting:
        env._initialize_episode(rows, {IN_PLACE: True})


def resize(env: Any, state: dict, rows: Tensor) -> None:
    """Builds the scene anew if the objects of a state have other sizes than those in the environments `rows`; keeps
    everybody's state and random numbers."""
    if "task" not in state:
        return
    scale = state["task"]["scale"].reshape(len(rows), -1)
    if torch.equal(env.scale[rows], scale):
        return
    keep = _with_rows(env.get_state_dict(), state, rows)  # what is there may be no sound state
    streams = _streams(env)
    sizes = env.scale.clone()
    sizes[rows] = scale
    env.rebuild(sizes)
    keep["task"]["scale"] = sizes
    env.set_state_dict(keep)
    env._batched_main_rng, env._batched_episode_rng, env._episode_seed = streams
    env._main_rng, env._episode_rng = env._batched_main_rng[0], env._batched_episode_rng[0]
    if env.resetting:
        env._last_obs = env.get_obs(env.get_info())


def _with_rows(state: dict[str, Any], new: Mapping[str, Any], rows: Tensor) -> dict[str, Any]:
    """A state in which some rows are those of another one, as far as it has them; the first is changed in place."""
    for name, part in new.items():
        if isinstance(part, Mapping):
            _with_rows(state[name], part, rows)
        else:
            state[name][rows] = part.reshape(len(rows), *state[name].shape[1:]).to(state[name].dtype)
    return state


def _streams(env: Any) -> tuple[BatchedRNG, BatchedRNG, Any]:
    """Copies of the random streams of all environments, and their seeds."""
    main, episode = (
        BatchedRNG.from_rngs([copy.deepcopy(stream) for stream in streams.rngs])
        for streams in (env._batched_main_rng, env._batched_episode_rng)
    )
    return main, episode, env._episode_seed.copy()
