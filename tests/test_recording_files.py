"""Trajectory files written by hand: what is taken from their index, which arrays are read, and how many may be."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from dora.errors import InputError
from dora.live import recordings
from dora.live.recordings import DEEPEST, MOST_SEED, Recording

ACTIONS = np.arange(200.0).reshape(10, 20)


def written(folder: Path, arrays: dict[str, Any], episode: Any = None, **info: Any) -> Recording:
    """A recording of one episode with these arrays, by their paths in its group."""
    path = folder / "a.h5"
    with h5py.File(path, "w") as file:
        for name, value in arrays.items():
            options = {"chunks": (4, 20), "compression": "gzip"} if name == "chunked" else {}
            file.create_dataset("traj_0/" + name.replace("chunked", "actions"), data=value, **options)
    episode = {"episode_id": 0} if episode is None else episode
    index = {"env_info": {"env_id": "dora:DoraCube-v1", **info}, "episodes": [episode]}
    path.with_suffix(".json").write_text(json.dumps(index))
    return Recording.open(path)


@pytest.mark.parametrize(
    ("given", "seed"),
    [
        ({"episode_seed": 5}, 5), ({}, 0), ({"episode_seed": [7, 8]}, 7), ({"episode_seed": []}, 0),
        ({"episode_seed": 0}, 0), ({"episode_seed": -1}, 0), ({"episode_seed": MOST_SEED}, MOST_SEED),
        ({"episode_seed": MOST_SEED + 1}, 0), ({"episode_seed": True}, 0), ({"episode_seed": "5"}, 0),
    ],
)  # fmt: skip
def test_seeds_that_are_none_are_zero(tmp_path: Path, given: dict[str, Any], seed: int):
    found = written(tmp_path, {"actions": ACTIONS}, {"episode_id": 0, **given})
    assert found.names == (("traj_0", seed),)
    assert found.episode(0).seed == seed


@pytest.mark.parametrize("episode", [{"episode_id": -1}, {"episode_id": True}, {"episode_seed": 1}, [0], "traj_0"])
def test_episodes_without_a_number_are_refused(tmp_path: Path, episode: Any):
    with pytest.raises(InputError, match=r"has an episode with the number .*: record it again"):
        written(tmp_path, {"actions": ACTIONS}, episode)


def test_the_module_of_a_users_task_is_no_part_of_its_id(tmp_path: Path):
    found = written(tmp_path, {"actions": ACTIONS}, env_id="my_tasks.kitchen:DoraJug-v1")
    assert found.env_id == "DoraJug-v1"


@pytest.mark.parametrize(
    ("info", "options"),
    [
        ({}, {}),
        ({"env_kwargs": [1]}, {}),
        ({"env_kwargs": {"guidance": "none", "num_envs": 4, "preset": "hard"}}, {"guidance": "none", "preset": "hard"}),
    ],
)
def test_options_of_the_machine_that_recorded_are_left_out(tmp_path: Path, info: Any, options: dict[str, Any]):
    found = written(tmp_path, {"actions": ACTIONS}, **info)
    assert (found.env_id, found.options) == ("DoraCube-v1", options)


def test_the_first_row_of_each_array_of_the_states_is_read(tmp_path: Path):
    poses = np.arange(39.0).reshape(3, 13)
    found = written(tmp_path, {"actions": ACTIONS, "env_states/actors/cube": poses, "env_states/q": poses + 1})
    episode: Any = found.episode(0)
    assert episode.actions.dtype == np.float32
    assert episode.actions.tolist() == ACTIONS.tolist()
    assert set(episode.state) == {"actors", "q"}
    assert episode.state["actors"]["cube"].tolist() == poses[:1].tolist()
    assert episode.state["q"].tolist() == (poses[:1] + 1).tolist()
    assert written(tmp_path, {"actions": ACTIONS}).episode(0).state is None


@pytest.mark.parametrize("shape", [(10,), (10, 2, 2)])
def test_actions_that_are_no_table_are_refused(tmp_path: Path, shape: tuple[int, ...]):
    with pytest.raises(InputError, match="no table of finite numbers"):
        written(tmp_path, {"actions": np.zeros(shape)}).episode(0)


@pytest.mark.parametrize(("depth", "intact"), [(DEEPEST - 1, True), (DEEPEST, False)])
def test_groups_may_be_nested_up_to_a_depth(tmp_path: Path, depth: int, intact: bool):
    name = "/".join(["env_states", *"abcdefghijkl"[:depth], "q"])
    found = written(tmp_path, {"actions": ACTIONS, name: np.zeros((1, 2))})
    if intact:
        assert found.episode(0).state
        return
    with pytest.raises(InputError, match="nested too deep"):
        found.episode(0)


@pytest.mark.parametrize(("arrays", "intact"), [(2, True), (3, False)])
def test_arrays_and_groups_of_the_states_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arrays: int, intact: bool
):
    monkeypatch.setattr(recordings, "MOST_MEMBERS", 3)  # a group, too, is one
    names = [f"env_states/group/{k}" for k in range(arrays)]
    found = written(tmp_path, {"actions": ACTIONS, **dict.fromkeys(names, np.zeros((1, 2)))})
    if intact:
        assert found.episode(0).state
        return
    with pytest.raises(InputError, match="too many"):
        found.episode(0)


@pytest.mark.parametrize(
    ("actions", "shape", "arrays", "intact"),
    [
        ("actions", (2, 13), 8, True), ("actions", (2, 13), 9, False), ("actions", (1,), 8, True),
        ("actions", (1,), 9, False), ("chunked", (2, 13), 7, True), ("chunked", (2, 13), 8, False),
    ],
)  # fmt: skip
def test_numbers_that_are_unpacked_are_counted_by_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, actions: str, shape: tuple[int, ...], arrays: int, intact: bool
):
    """Each small array counts 100, also of one number, and the actions 200, or in three chunks of 4 steps 300."""
    monkeypatch.setattr(recordings, "MOST_NUMBERS", 1000)
    names = [f"env_states/{k}" for k in range(arrays)]
    found = written(tmp_path, {actions: ACTIONS, **dict.fromkeys(names, np.zeros(shape))})
    if intact:
        assert found.episode(0).actions.tolist() == ACTIONS.tolist()
        return
    with pytest.raises(InputError, match="unpack to more than 1000 numbers"):
        found.episode(0)


@pytest.mark.parametrize(("size", "intact"), [(200, True), (199, False)])
def test_an_array_may_have_just_as_many_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int, intact: bool
):
    monkeypatch.setattr(recordings, "MOST_NUMBERS", size)
    found = written(tmp_path, {"actions": ACTIONS})
    if intact:
        assert len(found.episode(0).actions) == 10
        return
    with pytest.raises(InputError, match="too many numbers, or no rows"):
        found.episode(0)
