"""Demonstrations: the scripted solution of a task, recorded as ManiSkill trajectory files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.wrappers.record import RecordEpisode

from dora.errors import InputError
from dora.files import make_folder
from dora.tasks import check_task_id
from dora.tasks.env.env import DoraEnv
from dora.tools.episodes import play_out

LAST_SEED = 2**32 - 1
"""Largest seed that NumPy takes."""


@dataclass(frozen=True)
class Demonstrations:
    """What was recorded: the trajectory file (HDF5; its index is beside it, as .json), tries and recorded successes."""

    path: Path
    tried: int
    recorded: int


def record_demonstrations(
    env_id: str, folder: Path | str, tries: int, num_envs: int = 16, seed: int = 0, **options: Any
) -> Demonstrations:
    """Executes the scripted solution from `tries` random starts and records those that succeed.

    The files are those of ManiSkill's `RecordEpisode`: observations, actions, rewards and every state, so that its
    tools can replay and convert them. Without guidance (the default here) the actions are plain commands of the
    wrist controller; with it they are residuals, all zero.

    Args:
        env_id: a Dora id.
        folder: where `demonstrations.h5` and `demonstrations.json` go; made if missing.
        tries: starts, with the seeds `seed`, `seed` + 1, ...; rounded up to a multiple of `num_envs`.
        num_envs: environments at once.
        seed: of the first start.
        options: further arguments of the task, such as `preset`.

    Raises:
        InputError: for an unknown id, no try, or any option the task refuses.
    """
    check_task_id(env_id)
    if tries < 1 or num_envs < 1:
        raise InputError(f"demonstrations need at least one try in one environment, not {tries} in {num_envs}")
    if not 0 <= seed <= LAST_SEED - tries - num_envs:
        raise InputError(f"the seed of the first start is {seed}; the seeds of all have to be from 0 to {LAST_SEED}")
    make_folder(Path(folder))
    options = {"obs_mode": "state", "reward_mode": "dense", "guidance": "none"} | options
    env = RecordEpisode(
        cast(BaseEnv, gym.make(env_id, num_envs=num_envs, sim_backend="physx_cpu_batch", **options)),
        str(folder),
        trajectory_name="demonstrations",
        save_on_reset=False,
        save_video=False,
        source_type="motionplanning",
        source_desc="scripted solution: the chosen grasp candidate, executed in closed loop",
    )
    task, recorded, tried = cast(DoraEnv, env.unwrapped), 0, 0
    while tried < tries:
        env.reset(seed=[seed + tried + row for row in range(num_envs)])
        success = play_out(env, task.scripted_action)[0].cpu().numpy()
        env.flush_trajectory(env_idxs_to_flush=np.flatnonzero(success))
        tried, recorded = tried + num_envs, recorded + int(success.sum())
    path = Path(env._h5_file.filename)  # pyright: ignore[reportAttributeAccessIssue]
    env.close()
    return Demonstrations(path, tried, recorded)
