"""What a run finds in its folder: checkpoints of others, damaged weights, other processes, leftovers of killed ones."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from test_agents_train import BASE, SMALL_PPO, run, weights

from dora import parallel
from dora.agents.checkpoint import read_checkpoint
from dora.agents.config import SACConfig
from dora.agents.evaluation.play import load_policy
from dora.agents.learners import replay
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.trainer import Trainer
from dora.errors import InputError
from dora.parallel import name_of_process

SHORT = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=1536, eval_every=512, stagger=False)
SMALL_SAC = SACConfig(rollout=16, batch=64, warmup=100, critic_only=2, hidden=(16, 16))
SHORT_SAC = dataclasses.replace(SHORT, agent="sac", learner=SMALL_SAC, total_steps=1024)


@pytest.mark.parametrize(
    "change", [{"seed": 5}, {"learner": dataclasses.replace(SMALL_PPO, gamma=0.9)}], ids=["seed", "gamma"]
)
def test_the_best_policy_of_another_run_is_refused(tmp_path: Path, change: Any):
    run(tmp_path / "run", SHORT)
    run(tmp_path / "other", dataclasses.replace(SHORT, **change))
    best = RunFolder(tmp_path / "run").best
    shutil.copy(RunFolder(tmp_path / "other").best, best)
    with pytest.raises(InputError, match=f"{best} belongs to another run"):
        run(tmp_path / "run", SHORT, resume=True)


def test_a_missing_best_policy_is_told(tmp_path: Path):
    run(tmp_path / "run", SHORT)
    RunFolder(tmp_path / "run").best.unlink()
    with pytest.raises(
        InputError, match=r"best\.safetensors is missing, the best policy of this run so far: put it back"
    ):
        run(tmp_path / "run", SHORT, resume=True)


@pytest.mark.parametrize("config", [SHORT, SHORT_SAC], ids=["ppo", "sac"])
def test_networks_too_large_for_a_checkpoint_are_refused_before_training(
    tmp_path: Path, config: Any, monkeypatch: pytest.MonkeyPatch
):
    """The size that is foreseen is that of what is written."""
    run(tmp_path / "run", config)
    size = sum(value.nbytes for name, value in weights(tmp_path / "run").items() if not name.startswith("rng/"))
    monkeypatch.setattr("dora.agents.limits.MOST_HEADER", 0)
    monkeypatch.setattr("dora.agents.limits.MOST_BYTES", int(0.95 * size))
    with pytest.raises(InputError, match=r"--learner\.hidden makes checkpoints of .* give fewer or narrower layers"):
        run(tmp_path / "larger", config)
    assert not (tmp_path / "larger" / "progress.csv").exists()
    monkeypatch.setattr("dora.agents.limits.MOST_BYTES", size)
    run(tmp_path / "fits", config)


def spoilt(path: Path, name: str) -> None:
    """Write a checkpoint again, with NaN in one of its tensors."""
    checkpoint = read_checkpoint(path)
    checkpoint.tensors[name].view(-1)[0] = torch.nan
    checkpoint.write(path)


def test_weights_that_are_not_finite_are_refused_with_their_file(tmp_path: Path):
    run(tmp_path / "run", SHORT)
    folder, name = RunFolder(tmp_path / "run"), "actor/mean.0.weight"
    spoilt(folder.best, name)
    with pytest.raises(InputError, match=f"{folder.best} holds NaN or infinity in {name}"):
        load_policy(read_checkpoint(folder.best), folder.best)
    moment = next(key for key in weights(folder.path) if key.endswith("exp_avg"))
    spoilt(folder.latest, moment)
    with pytest.raises(InputError, match=f"{folder.latest} holds NaN or infinity in {moment}"):
        run(folder.path, SHORT, resume=True)


def test_only_one_process_trains_in_a_folder(tmp_path: Path):
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    with folder.locked(), pytest.raises(InputError, match="Another process is at work in"), folder.locked():
        pass
    holder = (
        "import sys, time; from pathlib import Path; from dora.agents.runs.run_folder import RunFolder\n"
        "with RunFolder(Path(sys.argv[1])).locked(): print('held', flush=True); time.sleep(100)"
    )
    process = subprocess.Popen([sys.executable, "-c", holder, str(tmp_path)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match="wait until it ends"), folder.locked():
        pass
    process.kill()
    process.wait()
    with folder.locked():
        pass


def test_what_a_killed_run_left_half_written_is_removed(tmp_path: Path):
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    folder.replay.mkdir()
    halves = [folder.path / ".curve.csv.abcd_123", folder.checkpoints / ".latest.safetensors.zyxw9876"]
    halves.append(folder.replay / ".0000000000-0000016384.safetensors.aaaaaaaa")
    folder.nonfinite.mkdir()
    halves.append(folder.nonfinite / ".cube-1-2.safetensors.aaaaaaaa")
    others = [folder.path / ".notes", folder.path / ".hidden.toml"]
    for path in halves + others:
        path.write_text("half")
    with folder.locked():
        assert not any(path.exists() for path in halves)
        assert all(path.exists() for path in others)


def test_a_run_without_a_checkpoint_is_resumed_from_its_beginning(tmp_path: Path):
    folder = RunFolder(tmp_path / "killed")
    folder.create(SHORT)  # and killed before the first checkpoint
    run(folder.path, SHORT, resume=True)
    run(tmp_path / "straight", SHORT)
    for name, value in weights(tmp_path / "straight").items():
        assert torch.equal(value, weights(folder.path)[name]), name


def test_what_is_left_of_a_run_without_a_checkpoint_does_not_get_into_its_replay_buffer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = RunFolder(tmp_path / "killed")
    folder.create(SHORT_SAC)
    run(tmp_path / "other", dataclasses.replace(SHORT_SAC, seed=5))
    shutil.copytree(tmp_path / "other" / "checkpoints" / "replay", folder.replay)  # and killed before the checkpoint
    run(folder.path, SHORT_SAC, resume=True)
    assert "no checkpoint" in capsys.readouterr().err
    run(tmp_path / "straight", SHORT_SAC)
    for path in (tmp_path / "straight" / "checkpoints" / "replay").iterdir():
        ours, theirs = load_file(folder.replay / path.name), load_file(path)
        assert all(torch.equal(value, theirs[name]) for name, value in ours.items())


def test_shards_of_a_state_that_was_never_finished_are_written_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(replay, "SHARD", 512)
    run(tmp_path / "run", SHORT_SAC)
    newer = tmp_path / "run" / "checkpoints" / "replay" / "0000001024-0000001536.safetensors"
    newer.write_bytes(b"of a state whose checkpoint was not written")
    for total_steps in (1536, 2048):
        result = run(tmp_path / "run", dataclasses.replace(SHORT_SAC, total_steps=total_steps), resume=True)
        assert result["env_steps"] == total_steps
    assert len(load_file(newer)) > 0


@pytest.mark.parametrize("left", ["curve.csv", "checkpoints/best.safetensors", "a link"])
def test_a_run_that_lost_its_checkpoint_does_not_begin_anew(tmp_path: Path, left: str):
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    if left == "a link":
        folder.latest.symlink_to(tmp_path / "nowhere")
    else:
        (tmp_path / left).write_text("")
    with pytest.raises(InputError, match=r"latest\.safetensors is missing"):
        run(tmp_path, SHORT, resume=True)


def test_a_finished_run_that_goes_on_is_unfinished_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run(tmp_path / "run", SHORT)
    result = tmp_path / "run" / "result.json"
    assert json.loads(result.read_text())["finished"]
    monkeypatch.setattr(Trainer, "_write_result", lambda *_: {})  # as if killed
    run(tmp_path / "run", dataclasses.replace(SHORT, total_steps=2048), resume=True)
    assert not json.loads(result.read_text())["finished"]


@pytest.mark.parametrize("content", ["[" * 100_000, '{"finished": true, "a": ' + "[" * 50 + "]" * 50 + "}"])
def test_a_result_that_is_nested_too_deep_does_not_prevent_a_run(tmp_path: Path, content: str):
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    (tmp_path / "result.json").write_text(content)
    folder.mark_unfinished()
    assert (tmp_path / "result.json").read_text() == content


LEAVING = """
import os, signal, sys
from multiprocessing import get_context
from dora.parallel import name_leftovers, name_of_process
if __name__ == "__main__":
    name_leftovers()
    lock = get_context("spawn").Lock()
    print(name_of_process(), flush=True)
    os.killpg(0, signal.SIGKILL)
"""


def test_a_run_that_was_archived_with_checksums_goes_on(tmp_path: Path):
    """A larger budget is written, and with it the checksum of the settings."""
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    subprocess.run("sha256sum config.yaml > SHA256SUMS", shell=True, check=True, cwd=tmp_path)
    folder.write_config(dataclasses.replace(SHORT, total_steps=2 * SHORT.total_steps))
    assert folder.read_config().total_steps == 2 * SHORT.total_steps


ENDING = """
import os, signal
from dora.agents.runs.interrupt import ending_at_once
from dora.parallel import name_leftovers, name_of_process
if __name__ == "__main__":
    with ending_at_once():
        name_leftovers()
        print(name_of_process(), flush=True)
        os.kill(os.getpid(), signal.SIGINT)
"""


def test_a_command_that_ends_at_once_leaves_no_folder(tmp_path: Path):
    """After it has named what its workers will use, and before it trains."""
    (tmp_path / "ending.py").write_text(ENDING)
    done = subprocess.run([sys.executable, str(tmp_path / "ending.py")], stdout=subprocess.PIPE, text=True)
    assert done.returncode == 128 + signal.SIGINT
    assert done.stdout.startswith("dora-")
    assert not list(Path(tempfile.gettempdir()).glob(f"{done.stdout.strip()}*"))


DOUBLING = """
from dora.parallel import name_leftovers, run_cases
def doubler():
    return lambda number: 2 * number
if __name__ == "__main__":
    from multiprocessing import get_context
    print(run_cases(doubler, (), [1, 2, 3], 2, chunk=1))
    queue = get_context("spawn").Manager().Queue()
    queue.put(8)
    print(queue.get())
"""


@pytest.mark.parametrize("length", [60, pytest.param(200, marks=pytest.mark.slow)])
def test_workers_begin_whatever_the_length_of_the_path_of_temporary_files(tmp_path: Path, length: int):
    script, place = tmp_path / "doubling.py", tempfile.gettempdir()
    script.write_text(DOUBLING)
    folder = Path(place) / ("x" * (length - len(place) - 1))
    folder.mkdir(exist_ok=True)
    words, env = [sys.executable, str(script)], os.environ | {"TMPDIR": str(folder)}
    done = subprocess.run(words, capture_output=True, text=True, env=env, timeout=120)
    assert done.stdout.splitlines() == ["[2, 4, 6]", "8"], done.stderr
    assert not any(folder.iterdir())
    folder.rmdir()


TRAINING = """
import dataclasses, sys
from multiprocessing.synchronize import SemLock
from pathlib import Path
sys.path.insert(0, sys.argv[1])
if __name__ == "__main__":
    from short_runs import BASE, PointMass, RunFolder, Trainer
    from dora.agents.config import SACConfig
    made, make_name = [], SemLock._make_name
    SemLock._make_name = staticmethod(lambda: made.append(make_name()) or made[-1])
    folder, config = RunFolder(Path(sys.argv[2])), dataclasses.replace(BASE, agent="sac", learner=SACConfig())
    folder.create(config)
    Trainer(config, PointMass, folder)
    print(*made, flush=True)
"""


@pytest.mark.skipif(not parallel.SHARED.is_dir(), reason="semaphores have no names here")
def test_every_semaphore_of_a_run_tells_which_process_made_it(tmp_path: Path):
    """Also those of the replay buffer, which are made before any worker process."""
    script = tmp_path / "training.py"
    script.write_text(TRAINING)
    words = [sys.executable, str(script), str(Path(__file__).parent), str(tmp_path / "run")]
    names = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
    assert names
    assert all(name.startswith("/mp-dora-") for name in names), names


@pytest.mark.skipif(not parallel.SHARED.is_dir(), reason="semaphores have no names here")
def test_what_killed_processes_left_is_removed_at_the_next_start(tmp_path: Path):
    """Not before their end, and nothing that another process may use."""
    script, places = tmp_path / "leaving.py", (parallel.SHARED, Path(tempfile.gettempdir()))
    script.write_text(LEAVING)
    done = subprocess.run([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, start_new_session=True)
    name = done.stdout.strip()
    left = [path for place in places for path in place.glob(f"*{name}*")]
    assert done.returncode == -signal.SIGKILL
    assert len(left) == 2  # a semaphore and a folder
    own = Path(tempfile.mkdtemp(prefix=name_of_process()))
    foreign = Path(tempfile.mkdtemp(prefix=name.replace(f"dora-{parallel._namespace()}", "dora-1")))
    parallel.name_leftovers.cache_clear()
    parallel.name_leftovers()
    assert not any(path.exists() for path in left)
    assert own.exists()
    assert foreign.exists()
    own.rmdir()
    foreign.rmdir()
