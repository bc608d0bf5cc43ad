"""What describes a dataset, word for word: LeRobot's info and rows of episodes, Minari's metadata, names of numbers."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pyarrow.parquet as parquet
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from test_dataset_formats import ENV, EPISODES, FRAME, RATE, facts, invented

from dora.datasets.facts import WRIST, facts_of
from dora.datasets.lerobot import write_lerobot
from dora.datasets.minari import write_minari
from dora.sim.robot_agent import CONTROL_MODES
from dora.tasks.env.env import DoraEnv

SINGLE: dict[str, Any] = {"shape": [1], "names": None}
"""A feature of one number."""


def feature(kind: str, names: str) -> dict[str, Any]:
    return {"dtype": kind, "shape": [len(names.split())], "names": names.split()}


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "pictures"])
def lerobot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bool]:
    folder = tmp_path_factory.mktemp("lerobot")
    write_lerobot(folder, facts(), (invented(*row, pictures=request.param) for row in EPISODES))
    return folder, request.param


def test_the_info_of_lerobot_says_all(lerobot: tuple[Path, bool]):
    folder, pictures = lerobot
    info = json.loads((folder / "meta/info.json").read_text())
    features = info.pop("features")
    film = features.pop("observation.images.front", None)
    assert info == {
        "codebase_version": "v3.0", "robot_type": "hand", "total_episodes": 3, "total_frames": 11, "total_tasks": 1,
        "chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": RATE,
        "splits": {"train": "0:3"}, "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4" if pictures else None,
    }  # fmt: skip
    states = {
        "observation.state": feature("float32", "o.0 o.1 o.2 o.3" if pictures else "o.0 o.1 o.2 o.3 o.4 o.5 o.6"),
        **({"observation.environment_state": feature("float32", "o.4 o.5 o.6")} if pictures else {}),
    }
    kinds = {"next.reward": "float32", "next.done": "bool", "next.success": "bool", "timestamp": "float32"}
    kinds |= dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    singles = {name: {"dtype": kind, **SINGLE} for name, kind in kinds.items()}
    assert features == states | {"action": feature("float32", "a.0 a.1 a.2")} | singles
    assert (film is not None) is pictures
    if film is not None:
        assert (film["dtype"], film["shape"]) == ("video", [FRAME, FRAME, 3])
        assert film["names"] == ["height", "width", "channels"]


def test_rows_of_episodes_say_where_their_frames_are(lerobot: tuple[Path, bool]):
    folder, pictures = lerobot
    rows = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    found = [{name: value for name, value in row.items() if not name.startswith(("stats/", "videos/"))} for row in rows]
    assert found == [
        {
            "episode_index": k, "tasks": ["Do it."], "length": length, "seed": seed, "success": success,
            "data/chunk_index": 0, "data/file_index": 0, "dataset_from_index": first,
            "dataset_to_index": first + length, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
        }
        for k, ((seed, length, success), first) in enumerate(zip(EPISODES, (0, 5, 7), strict=True))
    ]  # fmt: skip
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    for name, values in (("task_index", [0] * 11), ("frame_index", [0, 1, 2, 3, 4, 0, 1, 0, 1, 2, 3])):
        assert table[name].to_pylist() == values
    if pictures:
        front = [row["stats/observation.images.front/max"][0][0][0] for row in rows]
        assert front == pytest.approx([43 / 255, 4 / 255, 9 / 255])  # steps 0 and 4 of the first, step 0 of the others
        stats = json.loads((folder / "meta/stats.json").read_text())["observation.images.front"]
        assert (stats["count"], stats["min"][0][0][0]) == ([4], pytest.approx(3 / 255))


def test_the_metadata_of_minari_say_all(tmp_path: Path):
    options = {"guidance": "none", "config": {"lift": 0.1}}
    write_minari(tmp_path, facts(), options, ("by hand", "It is clever."), (invented(k, 60_000, True) for k in (4, 5)))
    said = json.loads((tmp_path / "data/metadata.json").read_text())
    spec = EnvSpec.from_json(said.pop("env_spec"))
    assert (spec.id, spec.kwargs, spec.disable_env_checker) == (ENV, {"env_id": ENV, **options}, True)
    assert spec.entry_point == "dora.datasets.minari:recovered"
    observations, actions = (json.loads(said.pop(f"{name}_space")) for name in ("observation", "action"))
    assert (observations["low"], observations["high"]) == ([-np.inf] * 7, [np.inf] * 7)
    assert actions == {"type": "Box", "dtype": "float32", "shape": [3], "low": [-1.0] * 3, "high": [1.0] * 3}
    assert said == {
        "dataset_id": "dora/doracube/by-hand-v0", "data_format": "hdf5", "minari_version": "0.5.4",
        "total_episodes": 2, "total_steps": 120_000, "algorithm_name": "by hand",
        "dataset_size": round((tmp_path / "data/main_data.hdf5").stat().st_size / 1e6, 1),
        "description": "Do it. It is clever.",
    }  # fmt: skip
    assert said["dataset_size"] > 4


@pytest.mark.parametrize("count", [0, 12])
def test_minari_keeps_the_order_of_the_episodes(tmp_path: Path, count: int):
    write_minari(tmp_path, facts(), {}, ("a", "b"), (invented(k, 1, True) for k in range(count)))
    with h5py.File(tmp_path / "data/main_data.hdf5") as file:
        assert list(file) == [f"episode_{k}" for k in range(count)]
    said = json.loads((tmp_path / "data/metadata.json").read_text())
    assert (said["total_episodes"], said["total_steps"]) == (count, count)


class Invented(DoraEnv):
    """Hold the cube.

    Quite long.
    """

    def __init__(self, arms: int, extra: int = 0, mode: str = CONTROL_MODES[0]):
        hand = SimpleNamespace(joint_names=("arm", "thumb", "index"), hand_index=torch.tensor([2, 1]))
        names = ("left", "right")[:arms]
        agents = [SimpleNamespace(uid=f"{name}_hand") for name in names]
        own = {
            "arms": {name: SimpleNamespace(agent=hand) for name in names}, "control_mode": mode, "control_freq": 20.0,
            "action_size": arms * 8 + extra, "spec": EnvSpec("Invented-v1"), "observed": None,
            "agent": agents[0] if arms == 1 else SimpleNamespace(agents=agents),
            "observation_entries": {
                "q": SimpleNamespace(value=lambda _: torch.zeros(1, 2), sensed=True),
                "p": SimpleNamespace(value=lambda _: torch.zeros(1, 1), sensed=False),
            },
        }  # fmt: skip
        self.__dict__.update(own)

    def __getattribute__(self, name: str) -> Any:
        own = object.__getattribute__(self, "__dict__")
        return own[name] if name in own else object.__getattribute__(self, name)


@pytest.mark.parametrize("arms", [1, 2])
def test_facts_of_a_task_name_the_numbers_of_each_arm(arms: int):
    env: gym.Env = Invented(arms)
    found = facts_of(env)
    assert (found.env_id, found.task, found.rate) == ("Invented-v1", "Hold the cube.", 20)
    assert found.robot == ("left_hand" if arms == 1 else "left_hand+right_hand")
    assert (found.observation_names, found.sensed.tolist()) == (("q.0", "q.1", "p.0"), [True, True, False])
    own = (*WRIST, "index", "thumb")
    assert found.action_names == (own if arms == 1 else tuple(f"{arm}/{n}" for arm in ("left", "right") for n in own))
    assert (found.observation_space.shape, found.action_space.shape) == ((3,), (8 * arms,))
    assert (found.action_space.low.min(), found.action_space.high.max()) == (-1.0, 1.0)
    assert (found.observation_space.low.max(), found.observation_space.high.min()) == (-np.inf, np.inf)


@pytest.mark.parametrize(("extra", "mode"), [(1, CONTROL_MODES[0]), (0, CONTROL_MODES[1])])
def test_actions_that_are_more_than_wrist_and_joints_are_counted(extra: int, mode: str):
    assert facts_of(Invented(1, extra, mode)).action_names == tuple(f"action.{k}" for k in range(8 + extra))
