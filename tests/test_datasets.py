"""Datasets: what is recorded, and that files of each format hold it, as pyarrow, h5py and imageio read them."""

import dataclasses
import json
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import imageio.v2 as imageio
import numpy as np
import pyarrow.parquet as parquet
import pytest
import torch
from commands import call, load_command
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box

from dora.configs import plain
from dora.datasets.episodes import Episode, Plan, make_batch, roll_out
from dora.datasets.facts import Facts, facts_of
from dora.datasets.lerobot import write_lerobot
from dora.datasets.minari import write_minari
from dora.datasets.record import FORMATS, record_dataset
from dora.datasets.sources import find_source
from dora.errors import InputError
from dora.sim import can_render
from dora.tasks.mdp.randomisation import PRESETS

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


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a short Minari dataset of the scripted solution: three starts, each recorded."""
    folder = tmp_path_factory.mktemp("datasets") / "minari"
    record_dataset("minari", find_source(ENV, "scripted", "none"), Plan(3, seed=5, num_envs=2), folder)
    return folder


def test_the_description_makes_an_environment_in_which_actions_do_the_same(recorded: Path):
    said = json.loads((recorded / "data/metadata.json").read_text())
    env: Any = gym.make(EnvSpec.from_json(said["env_spec"]))
    assert env.observation_space.shape == tuple(json.loads(said["observation_space"])["shape"])
    with h5py.File(recorded / "data/main_data.hdf5") as file:
        group: Any = file["episode_0"]
        obs, _ = env.reset(seed=int(group.attrs["seed"]))
        np.testing.assert_array_equal(obs, group["observations"][0])
        over = info = None
        for k, action in enumerate(group["actions"]):
            assert not over
            obs, reward, terminated, truncated, info = env.step(action)
            np.testing.assert_array_equal(obs, group["observations"][k + 1])
            assert reward == pytest.approx(group["rewards"][k], abs=1e-5)
            over = terminated or truncated
        assert over
        assert info is not None
        assert bool(info["success"]) == group.attrs["success"]
    env.close()


def test_a_dataset_says_how_it_was_made(recorded: Path):
    own = json.loads((recorded / "recording.json").read_text())
    assert (own["env"], own["policy"], own["options"]["guidance"]) == (ENV, "scripted", "none")
    assert sorted(row["seed"] for row in own["episodes"]) == [5, 6, 7]
    assert list(recorded.parent.iterdir()) == [recorded]


@pytest.fixture(scope="module")
def batch() -> Any:
    env = make_batch(find_source(ENV, "scripted", "none"), 2, pictures=False)
    env.reset(seed=0)
    return env


def test_facts_name_every_number(batch: Any):
    found = facts_of(batch)
    size = batch.get_wrapper_attr("single_observation_space").shape[0]
    assert len(found.observation_names) == len(set(found.observation_names)) == len(found.sensed) == size
    assert len(found.action_names) == len(set(found.action_names)) == 26
    assert found.observation_names[:2] == ("hand_q.0", "hand_q.1")
    assert not found.sensed[found.observation_names.index("object_p.0")]
    assert found.rate == batch.unwrapped.control_freq
    assert (found.robot, found.task[:5]) == ("diana7_hit", "Grasp")


class Timed(gym.Wrapper):
    """Episodes of a batch end after two, three, ... steps, and even seeds are successes; nothing is simulated."""

    good, bad = True, -1

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.seeds, self.count = torch.tensor(seed), 0
        return self.seeds[:, None].float(), {}

    def step(self, action: Any) -> Any:
        self.count += 1
        assert self.count < 5, "no row is moved after the last one has ended"
        ended = self.count == 2 + torch.arange(2)
        success = ended & (self.seeds % 2 == 0) & self.good
        obs = self.seeds[:, None] + 0.1 * self.count
        bad = ended & (self.seeds == self.bad)
        return obs, torch.ones(2), success, ended & ~success, {"success": success, "nonfinite": bad}


def test_an_episode_ends_where_the_environment_says_so(batch: Any):
    plan = Plan(3, seed=4, num_envs=2)
    found = [e for _, e in roll_out(Timed(batch), lambda env, obs: torch.full((2, 1), 3.0), plan)]
    assert [(e.seed, len(e), e.success) for e in found] == [(4, 2, True), (5, 3, False), (6, 2, True)]
    np.testing.assert_allclose(found[1].observations[:, 0], [5.0, 5.1, 5.2, 5.3], rtol=1e-6)
    assert found[1].truncated.tolist() == [False, False, True]
    assert not found[1].terminated.any()
    assert (found[0].actions == 1).all()


def test_a_simulation_that_is_not_finite_is_left_out(batch: Any, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Timed, "bad", 5)
    found = [e for _, e in roll_out(Timed(batch), lambda env, obs: obs, Plan(3, seed=4, num_envs=2))]
    assert [e.seed for e in found] == [4, 6, 7]


def test_with_successes_only_further_starts_are_tried(batch: Any):
    found = [e for _, e in roll_out(Timed(batch), lambda env, obs: obs, Plan(4, 1, only_successes=True, num_envs=2))]
    assert [e.seed for e in found] == [2, 4, 6, 8]


def test_without_successes_it_gives_up(batch: Any, monkeypatch: pytest.MonkeyPatch):
    env, plan = Timed(batch), Plan(1, 1, only_successes=True, num_envs=2)
    monkeypatch.setattr(Timed, "good", False)
    with pytest.raises(InputError, match="only 0 of 120 starts"):
        list(roll_out(env, lambda env, obs: obs, plan))


def test_a_policy_acts_in_its_own_task_with_another_preset():
    source = find_source(ENV, "policy", "hard")
    assert source.options["preset"] == "hard"
    assert source.options["config"]["randomisation"] == plain(PRESETS["hard"])
    obs = torch.zeros(2, 211)
    assert source.act(None, obs).shape == (2, 26)  # pyright: ignore[reportArgumentType]


def test_maniskills_recording_holds_the_episodes_up_to_their_ends(tmp_path: Path):
    source = find_source(ENV, "policy", "none")
    made = record_dataset("maniskill", source, Plan(2, seed=5, num_envs=2), tmp_path / "out")
    index = json.loads((tmp_path / "out/demonstrations.json").read_text())
    own = json.loads((tmp_path / "out/recording.json").read_text())
    assert index["env_info"]["env_id"] == f"dora:{ENV}"
    with h5py.File(tmp_path / "out/demonstrations.h5") as file:
        assert len(file) == made.episodes == 2
        for k, (episode, row) in enumerate(zip(index["episodes"], own["episodes"], strict=True)):
            group: Any = file[f"traj_{k}"]
            assert (episode["episode_seed"], episode["elapsed_steps"]) == (row["seed"], row["steps"])
            assert len(group["actions"]) == row["steps"]
            assert bool(group["success"][-1]) == row["success"] == bool(episode["success"])


def test_nothing_is_left_of_an_interrupted_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record_dataset("minari", find_source(ENV, "scripted", "none"), Plan(1), tmp_path / "out", progress=interrupted)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_sigterm_leaves_nothing(tmp_path: Path):
    words = (sys.executable, "-m", "dora", "demos", ENV, "--out", str(tmp_path / "out"), "--episodes", "5000")
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert any("episodes/s" in line for line in iter(process.stderr.readline, ""))
    assert list(tmp_path.iterdir())
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["DoraCub-v1"], "did you mean 'DoraCube-v1'"),
        ([ENV, "--policy", "nowhere"], "nowhere"),
        ([ENV, "--episodes", "0"], "--episodes is 0"),
        ([ENV, "--seed", str(2**31 - 2)], "seed of the first start"),
        ([ENV, "--format", "minari", "--pictures"], "choose the format lerobot or maniskill"),
        (["DoraJug-v1", "--policy", str(Path(__file__).parent)], "checkpoint"),
    ],
)
def test_what_cannot_work_is_refused_in_one_sentence(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert call(load_command("demos"), monkeypatch, *words, "--out", str(tmp_path / "out")) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", FORMATS)
def test_an_existing_folder_is_refused_before_the_work(kind: str, tmp_path: Path):
    source = dataclasses.replace(find_source(ENV, "scripted"), env_id="Nothing-v1")
    with pytest.raises(InputError, match="exists already"):
        record_dataset(kind, source, Plan(1), tmp_path)


def test_without_pyarrow_a_sentence_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="pip install 'pyarrow"):
        record_dataset("lerobot", find_source(ENV, "scripted"), Plan(1), tmp_path / "out")


@pytest.mark.skipif(can_render(), reason="there is a Vulkan driver")
def test_pictures_without_a_driver_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="finds no Vulkan driver"):
        record_dataset("lerobot", find_source(ENV, "scripted"), Plan(1), tmp_path / "out", pictures=True)


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
@pytest.mark.skipif(find_spec("minari") is None, reason="Minari is not installed: pip install 'minari[hdf5]'")
def test_minari_reads_it(recorded: Path):
    import minari  # pyright: ignore[reportMissingImports]

    dataset = minari.MinariDataset(recorded / "data")
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    episodes, own = list(dataset.iterate_episodes()), json.loads((recorded / "recording.json").read_text())["episodes"]
    assert [len(e.actions) for e in episodes] == [row["steps"] for row in own]
    assert [bool(e.infos["success"][-1]) for e in episodes] == [row["success"] for row in own]


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
