"""Minari's format: episodes in one HDF5 file, and a description from which the environment can be made again.

The format is that of Minari 0.5 (https://minari.farama.org), written with h5py.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

from dora import registration as registration
from dora.datasets.episodes import Episode
from dora.datasets.facts import Facts
from dora.datasets.hdf5_files import ForgivingFile, open_undisturbed, undisturbed
from dora.files import write_json

VERSION = "0.5.4"
"""Version of Minari whose format is written."""
DATA, DESCRIPTION = "data/main_data.hdf5", "data/metadata.json"
"""Files of a dataset."""
MEGABYTE = 1e6
"""Bytes of a megabyte as the format counts them [bytes]."""


def recovered(env_id: str, **options: Any) -> gym.Env:
    """One environment as gymnasium has it, with arrays without an axis of environments; what a dataset's
    `recover_environment` makes.

    Args:
        env_id: a Dora id.
        options: further arguments of `gym.make`.
    """
    return CPUGymWrapper(gym.make(env_id, num_envs=1, **options))


def dataset_id(env_id: str, source: str) -> str:
    """Name of a dataset, such as "dora/doracube/scripted-v0"."""
    task, plain = env_id.lower().split("-")[0], "".join(c if c.isalnum() or c in "_" else "-" for c in source)
    return f"dora/{task}/{plain}-v0"


def write_minari(
    folder: Path, facts: Facts, options: Mapping[str, Any], source: tuple[str, str], episodes: Iterable[Episode]
) -> None:
    """Write a dataset of one task.

    Args:
        folder: an empty folder.
        facts: what holds for all episodes.
        options: arguments of `gym.make` with which the task was made, as plain data.
        source: what acted: a word, and a sentence.
        episodes: in the order in which they are stored.
    """
    (folder / DATA).parent.mkdir()
    steps, count = 0, 0
    with ForgivingFile(folder / DATA) as below:
        with open_undisturbed(below, track_order=True) as file:
            for count, episode in enumerate(episodes, 1):
                with undisturbed():
                    _write_episode(file.create_group(f"episode_{count - 1}"), count - 1, episode)
                steps += len(episode)
                below.check()
        below.check()
    spec = EnvSpec(
        facts.env_id,
        entry_point=f"{__name__}:{recovered.__name__}",
        disable_env_checker=True,
        kwargs={"env_id": facts.env_id, **options},
    )
    name, text = source
    size = round((folder / DATA).stat().st_size / MEGABYTE, 1)
    write_json(
        folder / DESCRIPTION,
        {
            "dataset_id": dataset_id(facts.env_id, name), "data_format": "hdf5", "minari_version": VERSION,
            "total_episodes": count, "total_steps": steps, "dataset_size": size, "env_spec": spec.to_json(),
            "observation_space": _space(facts.observation_space), "action_space": _space(facts.action_space),
            "algorithm_name": name, "description": f"{facts.task} {text}",
        },
    )  # fmt: skip


def _write_episode(group: h5py.Group, number: int, episode: Episode) -> None:
    group.attrs.update({"id": number, "seed": episode.seed, "total_steps": len(episode), "success": episode.success})
    values = {
        "observations": episode.observations,
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminations": episode.terminated,
        "truncations": episode.truncated,
        "infos/success": np.concatenate([[False], episode.successes]),
    }
    for name, value in values.items():
        group.create_dataset(name, data=value)


def _space(space: Box) -> str:
    """A space as Minari stores it."""
    content = {"type": "Box", "dtype": str(space.dtype), "shape": list(space.shape)}
    return json.dumps({**content, "low": space.low.tolist(), "high": space.high.tolist()})
