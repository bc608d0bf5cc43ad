"""Parts of datasets by themselves: statistics, tables of frames, files on a full disk, what is counted and refused."""

import errno
import io
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest

from dora.arguments import LARGEST_SEED
from dora.datasets.episodes import FEW, PATIENCE, Episode, Plan
from dora.datasets.hdf5_files import ForgivingFile
from dora.datasets.minari import dataset_id
from dora.datasets.record import Summary, check_possible, new_folder
from dora.datasets.statistics import joined_statistics, picture_statistics, vector_statistics
from dora.datasets.tables import EpisodeTable, write_table
from dora.errors import InputError

PARTS = ("min", "max", "mean", "std")
"""Statistics with a value for each number."""


def test_a_feature_of_single_numbers_has_statistics_of_one():
    found = vector_statistics(np.array([1, 2, 3, 6]))
    assert [found[name].tolist() for name in PARTS] == [[1.0], [6.0], [3.0], [pytest.approx(3.5**0.5)]]
    assert found["count"].tolist() == [4]
    assert {name: value.tolist() for name, value in found.items() if name.startswith("q")} == {
        "q01": [pytest.approx(1.03)], "q10": [pytest.approx(1.3)], "q50": [2.5], "q90": [pytest.approx(5.1)],
        "q99": [pytest.approx(5.91)],
    }  # fmt: skip


def test_a_feature_of_any_shape_has_a_statistic_for_each_number():
    found = vector_statistics(np.arange(12).reshape(2, 3, 2))
    assert found["min"].tolist() == [0, 1, 2, 3, 4, 5]
    assert found["mean"].tolist() == [3, 4, 5, 6, 7, 8]
    assert found["std"].tolist() == [3] * 6


def test_of_pictures_every_fourth_is_looked_at_by_channel():
    pictures = np.zeros((6, 2, 5, 3), np.uint8)
    pictures[0] = 51, 102, 255
    pictures[4, 0] = 255, 0, 0
    pictures[[1, 2, 3, 5]] = 200
    found = picture_statistics(pictures)
    assert found["count"].tolist() == [2]
    assert [found[name].shape for name in (*PARTS, "q50")] == [(3, 1, 1)] * 5
    assert found["min"].ravel().tolist() == [0.0, 0.0, 0.0]
    assert found["max"].ravel().tolist() == pytest.approx([1.0, 0.4, 1.0])
    assert found["mean"].ravel().tolist() == pytest.approx([0.5 * 0.2 + 0.25, 0.2, 0.5])
    assert found["std"].ravel().tolist() == pytest.approx([0.1475**0.5, 0.2, 0.5])


@pytest.mark.parametrize("lengths", [(5,), (3, 1), (2, 7, 4)])
def test_statistics_of_episodes_join_to_those_of_all_steps(lengths: tuple[int, ...]):
    random = np.random.default_rng(0)
    episodes = [random.normal(k, 1 + k, (length, 2)) for k, length in enumerate(lengths)]
    found, every = joined_statistics(map(vector_statistics, episodes)), np.concatenate(episodes)
    for name, function in (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)):
        np.testing.assert_allclose(found[name], function(every, axis=0))
    assert found["count"].tolist() == [sum(lengths)]
    expected = sum(len(e) * np.quantile(e, 0.9, axis=0) for e in episodes) / sum(lengths)
    np.testing.assert_allclose(found["q90"], expected)


def test_statistics_of_pictures_join_by_their_counts():
    dark, light = np.zeros((4, 1, 1, 3), np.uint8), np.full((9, 1, 1, 3), 255, np.uint8)
    found = joined_statistics([picture_statistics(dark), picture_statistics(light)])
    assert found["count"].tolist() == [4]
    assert found["mean"].shape == (3, 1, 1)
    assert found["mean"].ravel().tolist() == found["q50"].ravel().tolist() == [0.75] * 3
    assert found["std"].ravel().tolist() == pytest.approx([0.75**0.5 / 2] * 3)


def test_a_table_of_frames_goes_on_in_a_file_until_that_is_too_large(tmp_path: Path):
    table = EpisodeTable(tmp_path, "{chunk_index}/{file_index}", 2, 300 / 2**20)
    rows = {"a": np.arange(2), "b": np.arange(6.0).reshape(2, 3)}
    assert table.add(rows) == (0, 0)
    assert table.add(rows) == (0, 0)  # so far only its first bytes are on the disk
    while (place := table.add(rows)) == (0, 0):
        pass
    assert place == (0, 1)
    table.close()
    table.close()
    first = parquet.read_table(tmp_path / "0/0")
    assert (tmp_path / "0/0").stat().st_size > 300
    assert first["b"].to_pylist()[:2] == [[0, 1, 2], [3, 4, 5]]
    assert len(parquet.read_table(tmp_path / "0/1")) == 2
    assert parquet.ParquetFile(tmp_path / "0/1").num_row_groups == 1


def test_pandas_finds_the_kinds_of_columns_in_a_table(tmp_path: Path):
    write_table(tmp_path / "new/a", [{"n": 1, "word": "x"}, {"n": 2, "word": "y"}], index="word")
    said = json.loads(parquet.read_table(tmp_path / "new/a").schema.metadata[b"pandas"])
    assert {c["name"]: (c["pandas_type"], c["numpy_type"]) for c in said["columns"]} == {
        "n": ("int64", "int64"), "word": ("unicode", "unicode"),
    }  # fmt: skip
    write_table(tmp_path / "plain", [{"n": 1}])
    assert b"pandas" not in (parquet.read_table(tmp_path / "plain").schema.metadata or {})


@pytest.mark.parametrize("room", [0, 5, 7, 10**6])
def test_a_file_reads_what_was_written_even_where_the_disk_did_not_take_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
):
    """Like a file in memory, whatever part of it the disk has room for."""

    def write(descriptor: int, content: bytes, at: int) -> int:
        if at >= room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return pwrite(descriptor, content[: min(room - at, 3)], at)

    pwrite = os.pwrite
    monkeypatch.setattr(os, "pwrite", write)
    with ForgivingFile(tmp_path / "file") as found, io.BytesIO() as expected:
        assert found.readable()
        assert found.writable()
        assert found.seekable()
        for file in (found, expected):
            file.write(b"abcdefghij")
            file.seek(4)
            file.write(b"XY")
            file.seek(-1, os.SEEK_END)
            file.write(b"012")
            file.seek(-2, os.SEEK_CUR)
        assert found.tell() == expected.tell() == 10
        for place, count in ((0, 12), (0, 3), (3, 4), (5, 3), (4, 2), (8, 99), (12, 5), (40, 1), (6, 1)):
            assert found.seek(place) == expected.seek(place) == place
            left, right = bytearray(b"-" * count), bytearray(b"-" * count)
            assert found.readinto(left) == expected.readinto(right)
            assert left == right
            assert found.tell() == expected.tell()
        assert (found.failure is None) == (room > 12)


def test_a_file_has_the_size_that_it_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "file"
    with ForgivingFile(path) as file:
        file.write(b"abcdef")
        assert file.truncate(4) == 4
        assert path.stat().st_size == 4
        assert file.seek(0, os.SEEK_END) == 4
        file.seek(9)
        assert file.truncate() == 9
        buffer = bytearray(9)
        file.seek(0)
        assert file.readinto(buffer) == 9
        assert buffer == b"abcd\0\0\0\0\0"
        with monkeypatch.context() as patch:
            patch.setattr(os, "ftruncate", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
            assert file.truncate(20) == 20
        assert file.truncate(30) == 30  # the disk is not asked any more
        assert path.stat().st_size == 9
        file.write(b"z")
        assert file.seek(0, os.SEEK_END) == 30
        with pytest.raises(OSError, match="full"):
            file.check()


@pytest.mark.parametrize(
    ("recorded", "tried", "given_up"),
    [(0, FEW * 3 + PATIENCE - 1, False), (0, FEW * 3 + PATIENCE, True), (2, 900, True), (3, 900, False)],
)
def test_a_recording_is_given_up_after_many_starts(recorded: int, tried: int, given_up: bool):
    for plan, words in ((Plan(3, only_successes=True), "starts ended in a success"), (Plan(3), "stayed finite")):
        if given_up:
            with pytest.raises(InputError, match=f"only {recorded} of {tried} .*{words}, and 3 are wanted"):
                plan.check(recorded, tried)
        else:
            plan.check(recorded, tried)


def test_episodes_successes_and_steps_are_counted():
    steps = np.zeros(3, bool)
    episode = Episode(
        seed=1, observations=np.zeros((4, 2), np.float32), actions=np.zeros((3, 1), np.float32),
        rewards=np.zeros(3, np.float32), terminated=steps, truncated=steps, successes=np.array([True, False, False]),
    )  # fmt: skip
    summary = Summary()
    summary.count(episode)
    summary.count(replace(episode, successes=np.array([False, False, True])))
    assert (summary.episodes, summary.successes, summary.steps) == (2, 1, 6)


@pytest.mark.parametrize(
    ("kind", "plan", "words"),
    [
        ("minari", Plan(1, num_envs=1), ""),
        ("minari", Plan(2, seed=LARGEST_SEED - 200), ""),
        ("minari", Plan(2, seed=LARGEST_SEED - 199), "have to be from 0 to 2147483647"),
        ("minari", Plan(2, seed=-1), "have to be from 0 to 2147483647"),
        ("minari", Plan(0), "not 0 in 16"),
        ("minari", Plan(1, num_envs=0), "not 1 in 0"),
        ("csv", Plan(1), "choose one of lerobot, minari, maniskill"),
    ],
)
def test_numbers_of_a_dataset_have_bounds(tmp_path: Path, kind: str, plan: Plan, words: str):
    if not words:
        check_possible(kind, plan, tmp_path / "new" / "out", pictures=False)
        assert [path.name for path in tmp_path.iterdir()] == ["new"]
        return
    with pytest.raises(InputError, match=words):
        check_possible(kind, plan, tmp_path / "new" / "out", pictures=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["lerobot", "maniskill"])
@pytest.mark.parametrize("driver", [False, True])
def test_pictures_need_a_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, driver: bool):
    monkeypatch.setattr("dora.datasets.record.can_render", lambda: driver)
    check_possible(kind, Plan(1), tmp_path / "out", pictures=False)
    if driver:
        check_possible(kind, Plan(1), tmp_path / "out", pictures=True)
        return
    with pytest.raises(InputError, match="finds no Vulkan driver"):
        check_possible(kind, Plan(1), tmp_path / "out", pictures=True)


def test_a_folder_that_came_to_exist_meanwhile_is_kept(tmp_path: Path):
    def meanwhile() -> None:
        with new_folder(tmp_path / "out") as place:
            (place / "mine").touch()
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / "theirs").touch()

    with pytest.raises(InputError, match="exists meanwhile"):
        meanwhile()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["out", "theirs"]


def test_a_disk_that_is_full_is_told_in_one_sentence(tmp_path: Path):
    words = r"Cannot write .*out \(No space left on device\): nothing was written"
    with pytest.raises(InputError, match=words), new_folder(tmp_path / "out"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_others_may_read_a_dataset(tmp_path: Path):
    with new_folder(tmp_path / "out") as place:
        assert place.parent == tmp_path
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize(
    ("source", "expected"), [("scripted", "scripted"), ("my run_2.a/é", "my-run_2-a-é"), ("a+b", "a-b")]
)
def test_names_of_minari_have_letters_digits_and_dashes(source: str, expected: str):
    assert dataset_id("DoraCube-v1", source) == f"dora/doracube/{expected}-v0"
