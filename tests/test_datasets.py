"""Datasets: what is recorded, what is refused, and that an interrupted recording leaves nothing."""

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from commands import call, load_command
from gymnasium.envs.registration import EnvSpec

from dora import parallel
from dora.configs import plain
from dora.datasets.episodes import Plan, make_batch, roll_out
from dora.datasets.facts import facts_of
from dora.datasets.hdf5_files import undisturbed
from dora.datasets.record import FORMATS, check_possible, new_folder, record_dataset
from dora.datasets.sources import find_source
from dora.errors import InputError
from dora.sim import can_render
from dora.tasks.mdp.randomisation import PRESETS

ENV = "DoraCube-v1"


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
    """Whatever the folder is called."""
    source = find_source(ENV, "policy", "none")
    made = record_dataset("maniskill", source, Plan(2, seed=5, num_envs=2), tmp_path / "out.h5")
    index = json.loads((tmp_path / "out.h5/demonstrations.json").read_text())
    own = json.loads((tmp_path / "out.h5/recording.json").read_text())
    assert index["env_info"]["env_id"] == f"dora:{ENV}"
    with h5py.File(tmp_path / "out.h5/demonstrations.h5") as file:
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


def test_what_a_killed_recording_left_is_removed_by_the_next_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not that of another target, nor of a process that is still at work."""
    target, other, long = tmp_path / "out[1]", tmp_path / "out[1].b", tmp_path / ("o" * 255)
    with new_folder(target) as working:
        with monkeypatch.context() as patch:
            patch.setattr(parallel, "name_of_process", lambda: f"dora-{parallel._namespace()}-4194305-7-")  # it is gone
            for path in (target, other):
                (parallel.folder_beside(path) / "data").mkdir()
        assert len(list(tmp_path.iterdir())) == 3
        for path in (long, target):
            with new_folder(path) as place:
                assert place != working
                shutil.copy(__file__, place / "whole")
        assert working.is_dir()
        left = {path.name for path in tmp_path.iterdir()} - {target.name, long.name, working.name}
        assert len(left) == 1
        assert left.pop().startswith(f".{other.name}.")
        shutil.rmtree(target)


@pytest.mark.parametrize(
    ("name", "words"), [("a" * 300, "File name too long"), ("caf\udce9", "not in UTF-8"), ("there", "exists already")]
)
def test_a_folder_that_cannot_be_made_is_refused_before_the_work(tmp_path: Path, name: str, words: str):
    (tmp_path / "there").symlink_to("nowhere")
    with pytest.raises(InputError, match=words) as error:
        check_possible("minari", Plan(1), tmp_path / name, pictures=False)
    assert "\n" not in str(error.value)
    str(error.value).encode()


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "most"), [("minari", 100_000), ("maniskill", 100_000), ("maniskill", 9_000)])
def test_a_disk_that_fills_up_leaves_nothing(tmp_path: Path, kind: str, most: int):
    """No file may have more bytes than `most` here; of the last case the settings in JSON are too large."""
    code = f"""
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
from dora.commands import demos
sys.argv = ["demos", {ENV!r}, "--episodes", "4", "--num-envs", "4", "--format", {kind!r}, "--out", "out"]
resource.setrlimit(resource.RLIMIT_FSIZE, ({most}, {most}))
sys.exit(demos.main())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert "ignored" not in done.stderr
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


DISTURBED = """
import os, signal, sys
import numpy as np
from pathlib import Path
from dora.datasets.hdf5_files import ForgivingFile, open_undisturbed, undisturbed

def end(number, frame):
    raise SystemExit(128 + number)

for at in map(int, sys.argv[2:]):
    if not (child := os.fork()):
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
else:
    sys.exit()

signal.signal(signal.SIGTERM, end)
calls = [0]

class Disturbed(ForgivingFile):
    def seek(self, *arguments):
        calls[0] += 1
        if calls[0] == at:
            os.kill(os.getpid(), signal.SIGTERM)
        return super().seek(*arguments)

with Disturbed(Path(sys.argv[1], f"{at}.h5")) as below:
    with open_undisturbed(below) as file:
        for k in range(5):
            with undisturbed():
                file.create_dataset(str(k), data=np.arange(2000.0))
            below.check()
"""
"""Writes HDF5 files in a folder, each in a process that gets SIGTERM in the nth call that HDF5 makes."""


def test_a_signal_within_hdf5_is_answered_after_it(tmp_path: Path):
    words = [sys.executable, "-c", DISTURBED, str(tmp_path), "1", "5", "9", "14"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.stdout.split() == 4 * [str(128 + signal.SIGTERM)], done.stderr
    assert done.stderr == ""


def test_signals_wait_for_the_end_of_what_may_not_be_disturbed(tmp_path: Path):
    came: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: came.append(number))
    try:
        with undisturbed():
            signal.raise_signal(signal.SIGTERM)
            assert came == []
        assert came == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


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
