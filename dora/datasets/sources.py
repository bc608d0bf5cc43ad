"""What can act in a dataset: the scripted solution, the policy that comes with a task, or a policy of one's own."""

from pathlib import Path

import gymnasium as gym
from torch import Tensor

from dora.datasets.episodes import Source
from dora.errors import InputError
from dora.policies.policy import load_policy
from dora.tasks import check_task_id, options_under_preset
from dora.tasks.env.env import DoraEnv
from dora.tasks.mdp.randomisation import find_preset

SCRIPTED, BUNDLED = "scripted", "policy"
"""Names of the scripted solution and of the policy that comes with a task."""
CHECKPOINTS, OF_RUNS = "checkpoints", ("policy", "best", "latest")
"""Folder of the checkpoints in that of a run, and names that the files of all runs have."""
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
    own = policy.env_kwargs if preset is None else options_under_preset(env_id, policy.env_kwargs, preset)
    name = BUNDLED if which == BUNDLED else policy_name(Path(which))
    text = f"A policy trained with {policy.config.agent.upper()} for {policy.env_steps:,} steps."
    return Source(name, text, env_id, {**USUAL, **own}, lambda env, obs: policy(obs))


def policy_name(path: Path) -> str:
    """Name of a policy of one's own in datasets: that of its file, or of the run's folder where files are all called
    the same, as "lift0.12" of `runs/lift0.12/checkpoints/best.safetensors`.

    Args:
        path: of a checkpoint or run folder.
    """
    path = path.absolute()
    folder = path if path.is_dir() else path.parent.parent if path.parent.name == CHECKPOINTS else path.parent
    name = folder.name if path.is_dir() or path.stem in OF_RUNS else path.stem
    return name if name not in (SCRIPTED, BUNDLED, "") else f"own-{name}"


def _scripted(env: gym.Env, obs: Tensor) -> Tensor:
    task = env.unwrapped
    assert isinstance(task, DoraEnv)
    return task.scripted_action()
