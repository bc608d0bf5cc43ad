"""Recorded episodes are played as they were recorded, and files that are none are refused in one sentence."""

import contextlib
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from live import Watched
from mani_skill.trajectory.merge_trajectory import merge_trajectories

from dora.datasets.episodes import Plan
from dora.datasets.record import record_dataset
from dora.datasets.sources import find_source
from dora.errors import InputError
from dora.live.orders import Choose, Play, Randomise, Start
from dora.live.players import ZERO, recorded, zero_correction
from dora.live.recordings import Recording, seal


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "new"
    record_dataset("maniskill", find_source("DoraCube-v1", "scripted"), Plan(2, 5, True, 2), folder)
    return folder / "demonstrations.h5"


@pytest.mark.slow
def test_a_demonstration_of_a_batch_succeeds_again_alone(recording: Path):
    opened = Recording.open(recording)
    assert (opened.env_id, opened.options["guidance"]) == ("DoraCube-v1", "none")
    watched = Watched("DoraCube-v1", [recorded(opened), zero_correction({})])
    episode = opened.episode(0)
    with h5py.File(recording) as file:
        group: Any = file["traj_0"]
        poses = np.array(group["env_states"]["actors"]["cube"])[:, :7]
    assert watched.state.player == "recording demonstrations.h5"
    np.testing.assert_allclose(watched.state.objects["cube"], poses[0], atol=1e-5)
    assert watched.do(Start((0.5, 0.5, 0.5))).message.startswith("A recording has its own start")
    assert watched.do(Choose(0)).message.startswith("A recording has its own candidate")
    assert watched.do(Randomise("none")).message.startswith("A recording has its own randomisation")
    state = watched.to_the_end()
    assert (state.episode.step, state.episode.success) == (len(episode.actions), True)
    np.testing.assert_allclose(state.objects["cube"][:3], poses[-1, :3], atol=0.01)
    state = watched.do(Play(ZERO))
    assert "candidate" in state.setup.terms  # guided again: another environment
    assert watched.do(Play("recording demonstrations.h5")).episode.step == 0
    watched.session.stop()


def test_an_episode_begins_in_its_recorded_state_whatever_its_seed(recording: Path, tmp_path: Path):
    copy = damaged(recording, tmp_path, "")
    index = json.loads(copy.with_suffix(".json").read_text())
    index["episodes"][0]["episode_seed"] = 99
    copy.with_suffix(".json").write_text(json.dumps(index))
    with h5py.File(recording) as file:
        group: Any = file["traj_0"]
        pose = np.array(group["env_states"]["actors"]["cube"])[0, :7]
    watched = Watched("DoraCube-v1", [recorded(Recording.open(copy))])
    np.testing.assert_allclose(watched.state.objects["cube"], pose, atol=1e-5)
    watched.session.stop()


def damaged(path: Path, folder: Path, how: str) -> Path:
    """A copy of a recording with something wrong, and without the checksums that would tell."""
    copy = folder / "copy.h5"
    shutil.copy(path, copy)
    index = json.loads(path.with_suffix(".json").read_text())
    if how == "stock":
        index["env_info"]["env_id"] = "PickCube-v1"
    elif how == "empty":
        index["episodes"] = []
    elif how == "list":
        index = [1, 2]
    elif how == "number":
        index["episodes"][0]["episode_id"] = "../x"
    if how != "no index":
        copy.with_suffix(".json").write_text(json.dumps(index) if how != "no json" else "{")
    if how == "text":
        copy.write_text("nothing")
    elif how in ("no actions", "nan", "link", "words", "no rows", "one number", "state"):
        with h5py.File(copy, "a") as file:
            group: Any = file["traj_0"]
            if how == "nan":
                group["actions"][3] = np.nan
            elif how == "state":
                del group["env_states"]["actors"]["cube"]
            else:
                del group["actions"]
            if how == "link":
                group["actions"] = h5py.ExternalLink(str(path), "traj_0/actions")
            elif how == "words":
                group["actions"] = ["left", "right"]
            elif how in ("no rows", "one number"):
                group["actions"] = np.zeros((0, 26)) if how == "no rows" else 1.0
    return copy


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("no index", "is missing: the index"),
        ("no json", "is not valid JSON"),
        ("list", "is no index of a ManiSkill recording"),
        ("stock", "unknown environment 'PickCube-v1'"),
        ("empty", "has no episode"),
        ("number", "has an episode with the number '../x'"),
        ("text", "has no intact episode traj_0"),
        ("no actions", "has no intact episode traj_0"),
        ("nan", "are no table of finite numbers"),
        ("link", "actions is missing or is a link"),
        ("words", "actions is no array of numbers"),
        ("no rows", "actions has too many numbers, or no rows"),
        ("one number", "actions has too many numbers, or no rows"),
    ],
)
def test_a_file_that_is_no_recording_is_refused(recording: Path, tmp_path: Path, how: str, words: str):
    path = damaged(recording, tmp_path, how)
    with pytest.raises(InputError, match=words):
        Recording.open(path).episode(0)


@pytest.mark.parametrize("changed", ["h5", "json", "sha256"])
@pytest.mark.parametrize("place", [0.0, 0.2, 0.5, 0.8])
def test_any_change_of_a_recording_of_ours_is_found(recording: Path, tmp_path: Path, changed: str, place: float):
    for end in (".h5", ".json", ".sha256"):
        shutil.copy(recording.with_suffix(end), tmp_path)
    copy = tmp_path / recording.name
    assert len(Recording.open(copy).episode(0).actions)
    file = copy.with_suffix(f".{changed}")
    content = bytearray(file.read_bytes())
    content[int(place * len(content))] ^= 1
    file.write_bytes(content)
    with pytest.raises(
        InputError, match=r"is not as it was written, .* remove demonstrations.sha256 to play it as it is"
    ):
        Recording.open(copy)
    copy.with_suffix(".sha256").unlink()
    with contextlib.suppress(InputError):
        Recording.open(copy)


def test_a_recording_may_be_renamed_and_is_checked_all_the_same(recording: Path, tmp_path: Path):
    for end in (".h5", ".json", ".sha256"):
        shutil.copy(recording.with_suffix(end), tmp_path / f"a cube{end}")
    copy = tmp_path / "a cube.h5"
    assert len(Recording.open(copy).episode(0).actions)
    copy.with_suffix(".json").write_text(copy.with_suffix(".json").read_text() + " ")
    with pytest.raises(InputError, match=r"a cube\.json is not as it was written"):
        Recording.open(copy)


def test_recordings_that_maniskill_joined_can_be_played(recording: Path, tmp_path: Path):
    merge_trajectories(str(tmp_path / "merged.h5"), [str(recording), str(recording)])
    merged = Recording.open(tmp_path / "merged.h5")
    assert len(merged.names) == 4
    np.testing.assert_array_equal(merged.episode(2).actions, Recording.open(recording).episode(0).actions)


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
def test_the_checksums_are_those_of_sha256sum(recording: Path):
    words = ["sha256sum", "--check", "--strict", "demonstrations.sha256"]
    assert subprocess.run(words, cwd=recording.parent, capture_output=True).returncode == 0


def test_an_index_of_any_size_gets_checksums(tmp_path: Path):
    (tmp_path / "large.h5").write_bytes(b"any")
    (tmp_path / "large.json").write_bytes(b" " * 10_000_000)
    seal(tmp_path / "large.h5")
    assert len((tmp_path / "large.sha256").read_text().splitlines()) == 2


def test_a_missing_file_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="There is no trajectory file"):
        Recording.open(tmp_path / "none.h5")


@pytest.mark.parametrize(("how", "words"), [("nan", "are no table of finite numbers"), ("state", "cube")])
def test_a_damaged_recording_leaves_the_present_player(recording: Path, tmp_path: Path, how: str, words: str):
    """Also one whose first state is refused when its task has been made already."""
    broken = recorded(Recording.open(damaged(recording, tmp_path, how)))
    watched = Watched("DoraCube-v1", [zero_correction({}), broken], preset="none")
    state = watched.do(Play(broken.name))
    assert state.player == ZERO
    assert words in state.message
    assert watched.steps(2).episode.step == 2
    assert "candidate" in watched.state.setup.terms
    watched.session.stop()


def test_a_recording_is_played_at_the_rate_at_which_it_was_made(recording: Path, tmp_path: Path):
    copy = damaged(recording, tmp_path, "")
    index = json.loads(copy.with_suffix(".json").read_text())
    index["env_info"]["env_kwargs"]["sim_config"] = {"control_freq": 10, "sim_freq": 200}
    copy.with_suffix(".json").write_text(json.dumps(index))
    watched = Watched("DoraCube-v1", [recorded(Recording.open(copy))])
    task = watched.env.unwrapped
    assert (task.control_freq, task.config.control_frequency, task.sim_freq) == (10, 10, 200)
    watched.session.stop()


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("guidance", "nothing", "nothing"),
        ("guidance_parts", 5, "cannot be made|guidance_parts"),
        ("config", [1], "config"),
        ("control_mode", "fly", "unknown control mode 'fly'"),
    ],
)
def test_a_recording_of_a_task_that_cannot_be_made_is_refused(
    recording: Path, tmp_path: Path, name: str, value: Any, words: str
):
    copy = damaged(recording, tmp_path, "")
    index = json.loads(copy.with_suffix(".json").read_text())
    index["env_info"]["env_kwargs"][name] = value
    copy.with_suffix(".json").write_text(json.dumps(index))
    with pytest.raises(InputError, match=words):
        Watched("DoraCube-v1", [recorded(Recording.open(copy))])
