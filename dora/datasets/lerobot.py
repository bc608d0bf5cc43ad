"""LeRobot's dataset format 3.0: tables (Parquet) of frames and episodes, films of cameras, and what describes them.

The format is that of https://huggingface.co/docs/lerobot/lerobot-dataset-v3, written with pyarrow and imageio.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from dora.datasets.episodes import Episode
from dora.datasets.facts import Facts
from dora.datasets.films import Film
from dora.datasets.statistics import Statistics, as_lists, joined_statistics, picture_statistics, vector_statistics
from dora.datasets.tables import EpisodeTable, require_pyarrow, write_table
from dora.files import write_json

VERSION = "v3.0"
"""Version of the format."""
FILES_PER_CHUNK = 1000
"""Files in one folder `chunk-...`."""
DATA_SIZE, FILM_SIZE = 100, 200
"""Size above which a further file of frames or of film is begun [MB of 2^20 bytes]."""
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
"""Place of a file within its kind."""
DATA, FILM = f"data/{PLACE}.parquet", f"videos/{{video_key}}/{PLACE}.mp4"
"""Places of the frames and of the film of a camera."""
EPISODES, TASKS = "meta/episodes/chunk-000/file-000.parquet", "meta/tasks.parquet"
"""Places of the tables of episodes and of tasks."""
STATE, PRIVILEGED, IMAGES = "observation.state", "observation.environment_state", "observation.images."
"""Names of features."""
INDICES = ("frame_index", "episode_index", "index", "task_index")
"""Features of every dataset that are whole numbers."""


def write_lerobot(folder: Path, facts: Facts, episodes: Iterable[Episode]) -> None:
    """Write a dataset of one task.

    Frames are steps: what was observed, the action taken, the reward that followed, and whether the episode was over
    or a success then. The last observation of an episode is not stored, as the format has no place for it.

    Without pictures `observation.state` is the whole observation. With pictures it is what the robot senses, and
    `observation.environment_state` the rest.

    Args:
        folder: an empty folder.
        facts: what holds for all episodes.
        episodes: in the order in which they are stored.

    Raises:
        InputError: pyarrow is not installed, or a film could not be written whole.
    """
    require_pyarrow()
    writer = _Writer(folder, facts)
    try:
        for episode in episodes:
            writer.add(episode)
    finally:
        writer.close()
    writer.check()
    writer.describe()


class _Writer:
    """Writes episodes one by one, and what describes them all at the end."""

    def __init__(self, folder: Path, facts: Facts):
        self.folder, self.facts = folder, facts
        self.rows: list[dict[str, Any]] = []
        self.statistics: list[dict[str, Statistics]] = []
        self.features: dict[str, Any] = {}
        self.table = EpisodeTable(folder, DATA, FILES_PER_CHUNK, DATA_SIZE)
        self.films: dict[str, Film] = {}
        self.frames = 0

    def add(self, episode: Episode) -> None:
        """Append the t steps of an episode to tables and films; its last observation has no place in the format."""
        if not self.rows:
            self.features = _features(self.facts, episode)
            self.films = {
                name: Film(self.folder, FILM.replace("{video_key}", IMAGES + name), FILES_PER_CHUNK, FILM_SIZE,
                           self.facts.rate) for name in episode.pictures
            }  # fmt: skip
        number, steps = len(self.rows), len(episode)
        columns = _columns(self.facts, episode, number, self.frames)
        chunk, file = self.table.add(columns)
        row: dict[str, Any] = {
            "episode_index": number, "tasks": [self.facts.task], "length": steps, "seed": episode.seed,
            "success": episode.success, "data/chunk_index": chunk, "data/file_index": file,
            "dataset_from_index": self.frames, "dataset_to_index": self.frames + steps,
            "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
        }  # fmt: skip
        found = {name: vector_statistics(values) for name, values in columns.items()}
        for name, pictures in episode.pictures.items():
            place = self.films[name].add(pictures[:steps])
            row |= {f"videos/{IMAGES}{name}/{what}": value for what, value in place.items()}
            found[IMAGES + name] = picture_statistics(pictures[:steps])
        parts = {f"stats/{f}/{s}": v for f, part in found.items() for s, v in as_lists(part).items()}
        self.rows.append(row | parts)
        self.statistics.append(found)
        self.frames += steps

    def close(self) -> None:
        self.table.close()
        for film in self.films.values():
            film.close()

    def check(self) -> None:
        """Refuse films that are not whole, as `Film.check`."""
        for film in self.films.values():
            film.check()

    def describe(self) -> None:
        """Write `meta/`: the table of episodes, that of the one task, statistics and `info.json`."""
        write_table(self.folder / EPISODES, self.rows)
        write_table(self.folder / TASKS, [{"task_index": 0, "task": self.facts.task}], index="task")
        names = self.statistics[0] if self.statistics else {}
        joined = {name: as_lists(joined_statistics(part[name] for part in self.statistics)) for name in names}
        write_json(self.folder / "meta/stats.json", joined)
        count = len(self.rows)
        info = {
            "codebase_version": VERSION, "robot_type": self.facts.robot, "total_episodes": count,
            "total_frames": self.frames, "total_tasks": 1, "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": DATA_SIZE, "video_files_size_in_mb": FILM_SIZE, "fps": self.facts.rate,
            "splits": {"train": f"0:{count}"}, "data_path": DATA, "video_path": FILM if self.films else None,
            "features": self.features,
        }  # fmt: skip
        write_json(self.folder / "meta/info.json", json.loads(json.dumps(info)))


def _states(facts: Facts, pictures: bool) -> dict[str, np.ndarray]:
    """Which numbers of the observation (o,) are in which feature."""
    if not pictures:
        return {STATE: np.ones(len(facts.sensed), bool)}
    return {STATE: facts.sensed, PRIVILEGED: ~facts.sensed}


def _columns(facts: Facts, episode: Episode, number: int, first: int) -> dict[str, np.ndarray]:
    """The features of an episode that are no pictures, by name; each has a row for every step."""
    steps = len(episode)
    frames = np.arange(steps, dtype=np.int64)
    done = np.zeros(steps, bool)
    done[-1] = True
    states = _states(facts, bool(episode.pictures))
    return {
        **{name: episode.observations[:steps, chosen] for name, chosen in states.items()},
        "action": episode.actions,
        "next.reward": episode.rewards,
        "next.done": done,
        "next.success": episode.successes,
        "timestamp": (frames / facts.rate).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(steps, number, np.int64),
        "index": first + frames,
        "task_index": np.zeros(steps, np.int64),
    }


def _features(facts: Facts, episode: Episode) -> dict[str, Any]:
    """The features as `info.json` describes them."""

    def feature(kind: str, names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": kind, "shape": [1 if names is None else len(names)], "names": names}

    features = {
        name: feature("float32", [n for n, own in zip(facts.observation_names, chosen, strict=True) if own])
        for name, chosen in _states(facts, bool(episode.pictures)).items()
    }
    features["action"] = feature("float32", list(facts.action_names))
    features |= {"next.reward": feature("float32"), "next.done": feature("bool"), "next.success": feature("bool")}
    features |= {"timestamp": feature("float32"), **{name: feature("int64") for name in INDICES}}
    for name, pictures in episode.pictures.items():
        features[IMAGES + name] = {
            "dtype": "video",
            "shape": list(pictures.shape[1:]),
            "names": ["height", "width", "channels"],
            "info": Film.description(pictures.shape[1:], facts.rate),
        }
    return features
