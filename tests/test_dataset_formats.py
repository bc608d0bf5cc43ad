"""Files of datasets in each format hold the episodes, as pyarrow, h5py, imageio and LeRobot read them."""

import errno
import json
import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import imageio.v2 as imageio
import numpy as np
import pyarrow.parquet as parquet
import pytest
from gymnasium.spaces import Box

from dora.datasets.episodes import Episode, Plan
from dora.datasets.facts import Facts
from dora.datasets.films import Film
from dora.datasets.hdf5_files import ForgivingFile
from dora.datasets.lerobot import write_lerobot
from dora.datasets.minari import write_minari
from dora.datasets.record import record_dataset
from dora.datasets.sources import find_source
from dora.errors import InputError
from dora.sim import can_render

ENV = "DoraCube-v1"
SIZES = {"observation": 7, "action": 3}
"""Numbers of an invented task."""
RATE = 20
"""Control steps of it per second [Hz]."""
FRAME = 32
"""Height and width of invented pictures [pixels]."""


def invented(seed: int, steps: int, success: bool, pictures: bool = False) -> Episode:
    """An episode of random numbers; its pictures are grey, brighter from step to step."""
    random = np.random.default_rng(seed)
    last = np.arange(steps) == steps - 1
    grey = np.arange(steps + 1, dtype=np.uint8)[:, None, None, None] * 10 + seed
    return Episode(
        seed=seed,
        observations=random.normal(size=(steps + 1, SIZES["observation"])).astype(np.float32),
        actions=random.uniform(-1, 1, (steps, SIZES["action"])).astype(np.float32),
        rewards=random.normal(size=steps).astype(np.float32),
        terminated=last & success,
        truncated=last & (not success),
        successes=last & success,
        pictures={"front": np.broadcast_to(grey, (steps + 1, FRAME, FRAME, 3)).copy()} if pictures else {},
    )


def facts() -> Facts:
    o, a = SIZES["observation"], SIZES["action"]
    return Facts(
        env_id=ENV, task="Do it.", robot="hand", rate=RATE, observation_names=tuple(f"o.{k}" for k in range(o)),
        sensed=np.arange(o) < 4, action_names=tuple(f"a.{k}" for k in range(a)),
        observation_space=Box(-np.inf, np.inf, (o,), np.float32), action_space=Box(-1.0, 1.0, (a,), np.float32),
    )  # fmt: skip


EPISODES = [(3, 5, True), (4, 2, False), (9, 4, True)]
"""Seed, steps and success of invented episodes."""


def frames_of(folder: Path) -> dict[str, np.ndarray]:
    """Columns of a LeRobot dataset."""
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def frames_of_film(path: Path) -> list[np.ndarray]:
    with imageio.get_reader(path) as reader:
        return [np.asarray(frame) for frame in reader]  # pyright: ignore[reportGeneralTypeIssues]


def test_lerobot_tables_hold_the_episodes(tmp_path: Path):
    episodes = [invented(*row) for row in EPISODES]
    write_lerobot(tmp_path, facts(), iter(episodes))
    frames = frames_of(tmp_path)
    rows = parquet.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    info = json.loads((tmp_path / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (3, 11, RATE)
    assert set(frames) == set(info["features"])
    for k, (episode, row) in enumerate(zip(episodes, rows, strict=True)):
        own = slice(row["dataset_from_index"], row["dataset_to_index"])
        own_row = (row["episode_index"], row["length"], row["seed"], row["success"])
        assert own_row == (k, *EPISODES[k][1::-1], episode.success)
        np.testing.assert_array_equal(frames["observation.state"][own], episode.observations[:-1])
        np.testing.assert_array_equal(frames["action"][own], episode.actions)
        np.testing.assert_array_equal(frames["next.reward"][own], episode.rewards)
        np.testing.assert_array_equal(frames["next.success"][own], episode.successes)
        assert frames["next.done"][own].tolist() == [False] * (len(episode) - 1) + [True]
        np.testing.assert_allclose(frames["timestamp"][own], np.arange(len(episode)) / RATE, rtol=1e-6)
        assert (frames["episode_index"][own] == k).all()
    assert frames["index"].tolist() == list(range(11))
    for name, shape in (("observation.state", [7]), ("action", [3]), ("next.reward", [1])):
        feature = info["features"][name]
        assert feature["shape"] == shape
        assert feature["names"] is None or len(feature["names"]) == shape[0]


def test_lerobot_statistics_are_those_of_all_frames(tmp_path: Path):
    write_lerobot(tmp_path, facts(), (invented(*row) for row in EPISODES))
    frames, found = frames_of(tmp_path), json.loads((tmp_path / "meta/stats.json").read_text())
    assert set(found) == set(frames)
    for name in ("observation.state", "action"):
        for what, function in (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)):
            np.testing.assert_allclose(found[name][what], function(frames[name].astype(float), axis=0), rtol=1e-6)
        assert found[name]["count"] == [11]
        assert (np.array(found[name]["q01"]) <= found[name]["q99"]).all()
    (row, *_) = parquet.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    np.testing.assert_allclose(row["stats/action/mean"], frames["action"][:5].mean(0), rtol=1e-5)


def test_pandas_would_read_the_task_as_the_index(tmp_path: Path):
    write_lerobot(tmp_path, facts(), iter([invented(1, 3, True)]))
    table = parquet.read_table(tmp_path / "meta/tasks.parquet")
    said = json.loads(table.schema.metadata[b"pandas"])
    assert said["index_columns"] == ["task"]
    assert {column["field_name"] for column in said["columns"]} == set(table.column_names)
    assert table.to_pylist() == [{"task_index": 0, "task": "Do it."}]


def test_films_show_each_episode_at_its_time_and_states_are_parted(tmp_path: Path):
    episodes = [invented(*row, pictures=True) for row in EPISODES]
    write_lerobot(tmp_path, facts(), iter(episodes))
    rows = parquet.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    film = frames_of_film(tmp_path / "videos/observation.images.front/chunk-000/file-000.mp4")
    assert len(film) == 11
    for episode, row in zip(episodes, rows, strict=True):
        start = round(row["videos/observation.images.front/from_timestamp"] * RATE)
        assert round(row["videos/observation.images.front/to_timestamp"] * RATE) - start == len(episode)
        shown = [picture.mean() for picture in film[start : start + len(episode)]]
        np.testing.assert_allclose(shown, episode.pictures["front"][:-1].mean((1, 2, 3)), atol=3)
    frames, info = frames_of(tmp_path), json.loads((tmp_path / "meta/info.json").read_text())
    assert info["features"]["observation.images.front"]["shape"] == [FRAME, FRAME, 3]
    observed = np.concatenate([episode.observations[:-1] for episode in episodes])
    np.testing.assert_array_equal(frames["observation.state"], observed[:, :4])
    np.testing.assert_array_equal(frames["observation.environment_state"], observed[:, 4:])


def test_a_film_that_is_not_whole_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    close = Film.close

    def cut(self: Film) -> None:
        close(self)
        content = self._path.read_bytes()
        self._path.write_bytes(content[: len(content) // 2])

    monkeypatch.setattr(Film, "close", cut)
    with pytest.raises(InputError, match="could not be written whole"):
        write_lerobot(tmp_path, facts(), (invented(*row, pictures=True) for row in EPISODES))


def test_a_large_dataset_is_parted_into_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("dora.datasets.lerobot.DATA_SIZE", 0.0)
    monkeypatch.setattr("dora.datasets.lerobot.FILM_SIZE", -1.0)
    monkeypatch.setattr("dora.datasets.lerobot.FILES_PER_CHUNK", 2)
    write_lerobot(tmp_path, facts(), (invented(*row, pictures=True) for row in EPISODES))
    rows = parquet.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for kind, files in (("data", "data"), ("videos/observation.images.front", "videos/observation.images.front")):
        places = [(row[f"{kind}/chunk_index"], row[f"{kind}/file_index"]) for row in rows]
        assert places == [(0, 0), (0, 1), (1, 0)]
        assert len(list((tmp_path / files).glob("*/*"))) == 3
    table = parquet.read_table(tmp_path / "data/chunk-001/file-000.parquet")
    assert table["index"].to_pylist() == [7, 8, 9, 10]
    assert rows[2]["videos/observation.images.front/from_timestamp"] == 0


def test_minari_files_hold_the_episodes(tmp_path: Path):
    episodes = [invented(*row) for row in EPISODES]
    write_minari(tmp_path, facts(), {"guidance": "none"}, ("scripted", "By hand."), iter(episodes))
    said = json.loads((tmp_path / "data/metadata.json").read_text())
    assert (said["total_episodes"], said["total_steps"], said["data_format"]) == (3, 11, "hdf5")
    assert json.loads(said["observation_space"])["shape"] == [7]
    with h5py.File(tmp_path / "data/main_data.hdf5") as file:
        for k, episode in enumerate(episodes):
            group: Any = file[f"episode_{k}"]
            assert {name: group.attrs[name] for name in ("id", "seed", "total_steps", "success")} == {
                "id": k, "seed": episode.seed, "total_steps": len(episode), "success": episode.success,
            }  # fmt: skip
            for name, value in (
                ("observations", episode.observations), ("actions", episode.actions), ("rewards", episode.rewards),
                ("terminations", episode.terminated), ("truncations", episode.truncated),
                ("infos/success", [False, *episode.successes]),
            ):  # fmt: skip
                np.testing.assert_array_equal(group[name][()], value)


@pytest.mark.parametrize("room", [0, 1000, 10**6])
def test_a_disk_that_fills_up_is_told_and_hdf5_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int):
    def write(descriptor: int, content: bytes, at: int) -> int:
        if at >= room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return pwrite(descriptor, content[: room - at], at)

    pwrite = os.pwrite
    monkeypatch.setattr(os, "pwrite", write)
    values = np.random.default_rng(0).normal(size=(20, 50, 30))
    with ForgivingFile(tmp_path / "file.h5") as below:
        with h5py.File(below, "w") as file:
            for k, value in enumerate(values):
                file.create_group(f"episode_{k}", track_order=True).create_dataset("actions", data=value)
            file.flush()
            for k, value in enumerate(values):
                np.testing.assert_array_equal(file[f"episode_{k}/actions"], value)  # pyright: ignore[reportArgumentType]
        if room == 10**6:
            below.check()
            return
        with h5py.File(below) as file:
            assert len(file) == len(values)
        with pytest.raises(OSError, match="No space left"):
            below.check()


@pytest.mark.skipif(not can_render(), reason="pictures need a Vulkan driver")
def test_pictures_of_both_cameras_are_filmed(tmp_path: Path):
    record_dataset("lerobot", find_source(ENV, "policy", "none"), Plan(1), tmp_path / "out", pictures=True)
    frames = len(frames_of(tmp_path / "out")["index"])
    for name in ("front", "hand"):
        path = tmp_path / f"out/videos/observation.images.{name}/chunk-000/file-000.mp4"
        film = frames_of_film(path)
        assert len(film) == frames
        assert np.ptp(film[0]) > 50
        assert not np.array_equal(film[0], film[-1])


@pytest.mark.slow
@pytest.mark.skipif(find_spec("lerobot") is None, reason="LeRobot is not installed")
def test_lerobot_reads_it(tmp_path: Path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

    episodes = [invented(*row) for row in EPISODES]
    write_lerobot(tmp_path / "set", facts(), iter(episodes))
    dataset: Any = LeRobotDataset("local/set", root=tmp_path / "set")
    assert (len(dataset), dataset.num_episodes) == (11, 3)
    actions = np.stack([dataset[k]["action"].numpy() for k in range(11)])
    np.testing.assert_array_equal(actions, np.concatenate([episode.actions for episode in episodes]))


def test_an_interruption_waits_until_hdf5_has_closed_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def write(descriptor: int, content: bytes, at: int) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "pwrite", write)
    with ForgivingFile(tmp_path / "file.h5") as below:
        with h5py.File(below, "w") as file:
            file.create_dataset("values", data=np.zeros(1000))
        with pytest.raises(KeyboardInterrupt):
            below.check()


def test_a_file_that_cannot_be_made_or_closed_leaves_no_descriptor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(OSError, match="No such file"):
        ForgivingFile(tmp_path / "nowhere" / "file.h5")
    below, closed = ForgivingFile(tmp_path / "file.h5"), list[int]()
    assert below.write(b"abc") == below.tell() == 3

    def close(descriptor: int) -> None:
        closed.append(descriptor)
        raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))

    with monkeypatch.context() as patch:
        patch.setattr(os, "close", close)
        with pytest.raises(OSError, match="quota"):
            below.close()
        below.close()
    assert len(closed) == 1
    os.close(closed[0])
