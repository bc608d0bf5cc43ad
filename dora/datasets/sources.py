"""What can act in a dataset: the scripted solution, the policy that comes with a task, or a policy of one's own."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
from torch import Tensor

from dora.configs import plain
from dora.datasets.episodes import Source
from dora.errors import InputError
from dora.policies.policy import load_policy
from dora.tasks import check_task_id
from dora.tasks.env.env import DoraEnv
from dora.tasks.mdp.randomisation import find_preset

SCRIPTED, BUNDLED = "scripted", "policy"
"""Names of the scripted solution and of the policy that comes with a task."""
USUAL = {"obs_mode": "state", "reward_mode": "dense"}
"""Arguments of every task that is recorded."""


def find_source(env_id: str, which: str, preset: str | None = None) -> Source:
    """What acts in a task, by its name.

    Args:
        env_id: a Dora id.
        which: "scripted" for the scripted solution as plain commands of wrist and hand, without guidance; "policy" for
            the policy that comes with the task; otherwise the path of a checkpoint or run folder.
        preset: how much episodes are randomised; "standard", or that with which the policy was trained, by default.

    Raises:
        InputError: for an unknown id or preset, and a policy that is missing, damaged or of another task.
    """
    check_task_id(env_id)
    if preset is not None:
        find_preset(preset)
    if which == SCRIPTED:
        options = {**USUAL, "guidance": "none", "preset": preset or "standard"}
        return Source(
            SCRIPTED, "The scripted solution executes the chosen grasp candidate.", env_id, options, _scripted
        )
    policy = load_policy(env_id if which == BUNDLED else Path(which))
    if policy.env_id != env_id:
        raise InputError(f"{which} is a policy of {policy.env_id}, not of {env_id}: name the task that it is of.")
    options = {**USUAL, **_with_preset(policy.env_kwargs, preset)}
    name = BUNDLED if which == BUNDLED else Path(which).absolute().stem
    text = f"A policy trained with {policy.config.agent.upper()} for {policy.config.total_steps:,} steps."
    return Source(name, text, env_id, options, lambda env, obs: policy(obs))


def _scripted(env: gym.Env, obs: Tensor) -> Tensor:
    task = env.unwrapped
    assert isinstance(task, DoraEnv)
    return task.scripted_action()


def _with_preset(options: Mapping[str, Any], preset: str | None) -> dict[str, Any]:
    """Arguments of a task with another preset, which stands in its numbers as well."""
    if preset is None:
        return dict(options)
    config = options.get("config") or {}
    config = {**config, "randomisation": plain(find_preset(preset))} if "randomisation" in config else config
    return {**options, "preset": preset, **({"config": config} if config else {})}
