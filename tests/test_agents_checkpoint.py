"""Checkpoints: atomic, complete, and refused when they do not fit."""

import dataclasses
import errno
import json
import os
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from tensordict import TensorDict

from dora.agents.checkpoint import Checkpoint, check_belongs, read_checkpoint
from dora.agents.config import RunConfig
from dora.agents.counters import checked_counters
from dora.agents.learners import replay as replay_module
from dora.agents.learners.replay import Replay
from dora.errors import InputError
from dora.files import write_bytes

CONFIG = RunConfig("Fake-v1", "ppo", "none")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "a.safetensors"
    Checkpoint(CONFIG, (4, 2), {"w": torch.arange(1000.0)}, {"env_steps": 7}).write(path)
    return path


def test_round_trip(path: Path):
    checkpoint = read_checkpoint(path)
    assert checkpoint.config == CONFIG
    assert checkpoint.progress == {"env_steps": 7}
    assert torch.equal(checkpoint.tensors["w"], torch.arange(1000.0))


def test_damaged_files_are_refused(path: Path, tmp_path: Path):
    content = path.read_bytes()
    damaged = bytearray(content)
    damaged[-5] ^= 1
    save_file({"w": torch.zeros(2)}, tmp_path / "other.safetensors")
    cases = {
        "truncated": content[:-100],
        "damaged": bytes(damaged),
        "no checkpoint": b"hello",
        "no checkpoint of this version": (tmp_path / "other.safetensors").read_bytes(),
    }
    for words, bad in cases.items():
        path.write_bytes(bad)
        with pytest.raises(InputError, match=words):
            read_checkpoint(path)
    with pytest.raises(InputError, match="There is no checkpoint"):
        read_checkpoint(tmp_path / "missing.safetensors")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("curve", 3, "curve must be"),
        ("curve", [[1, 2.0, "much"]], "curve has to be rows"),
        ("curve", [[-1, 2.0, 0.5]], "curve has to be rows"),
        ("env_steps", -1, "env_steps is -1"),
        ("env_steps", "many", "env_steps must be int"),
        ("env_steps", True, "env_steps has to be a number"),
        ("wall_seconds", float("nan"), "wall_seconds is nan"),
        ("episodes", 10**13, "episodes is 1"),
        ("best", [0.5], "best has to be a success rate and a return"),
        ("best", [1.5, 3.0], "best has to be a success rate and a return"),
        ("seconds", {"collect": 1.0}, "seconds has to be"),
        ("seconds", {"collect": 1.0, "learn": -1.0, "evaluate": 0.0}, "seconds has to be"),
        ("learner", {"added": "all"}, "learner has to be finite numbers"),
        ("learner", [3], "learner has to be finite numbers"),
        ("epochs", 3, "has no field 'epochs'"),
    ],
)
def test_counters_of_a_wrong_type_or_size_are_refused(path: Path, name: str, value: object, words: str):
    Checkpoint(CONFIG, (4, 2), {}, {name: value}).write(path)
    with pytest.raises(InputError, match=f"the counters in {path}") as caught:
        read_checkpoint(path)
    assert words in str(caught.value)


def test_counters_of_every_kind_are_read(path: Path):
    nan = float("nan")
    progress = {"env_steps": 9, "wall_seconds": 2, "best": [1, -3.5], "curve": [[9, 2, 1.0, -3.5, nan, nan]]}
    progress |= {"learner": {"due": 0.5}, "reached": 0, "other_seconds": 0.0}
    Checkpoint(CONFIG, (4, 2), {}, progress).write(path)
    counters = checked_counters(read_checkpoint(path).progress, path)
    assert (counters.env_steps, counters.wall_seconds, counters.best) == (9, 2.0, [1.0, -3.5])
    assert counters.seconds == {"collect": 0.0, "learn": 0.0, "evaluate": 0.0}


def test_foreign_checkpoints_are_refused(path: Path):
    checkpoint = read_checkpoint(path)
    check_belongs(checkpoint, path, CONFIG, (4, 2), exactly=True)
    for change in ({"env": "Other-v1"}, {"agent": "sac"}, {"guidance": "affordance"}):
        with pytest.raises(InputError, match=next(iter(change))):
            check_belongs(checkpoint, path, dataclasses.replace(CONFIG, **change), (4, 2), exactly=False)
    with pytest.raises(InputError, match="action size 2, not 3"):
        check_belongs(checkpoint, path, CONFIG, (4, 3), exactly=False)
    other = dataclasses.replace(CONFIG, seed=5)
    check_belongs(checkpoint, path, other, (4, 2), exactly=False)
    with pytest.raises(InputError, match="digest"):
        check_belongs(checkpoint, path, other, (4, 2), exactly=True)


def test_a_full_disk_leaves_the_old_file(path: Path, monkeypatch: pytest.MonkeyPatch):
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        Checkpoint(CONFIG, (4, 2), {"w": torch.zeros(9)}).write(path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_unwritable_folder(tmp_path: Path):
    with pytest.raises(InputError, match="Cannot write"):
        write_bytes(tmp_path / "missing" / "file", b"x")


def test_digest_ignores_the_budget_only():
    assert dataclasses.replace(CONFIG, total_steps=5).digest() == CONFIG.digest()
    assert dataclasses.replace(CONFIG, seed=5).digest() != CONFIG.digest()
    assert len(json.dumps(CONFIG.digest())) == 14


def fill(replay: Replay, first: int, end: int) -> None:
    rows = torch.arange(first, end, dtype=torch.float32)
    data = {"observation": rows[:, None], "next": {"reward": -rows[:, None]}}
    replay.extend(TensorDict(data, batch_size=[len(rows)]))


def test_replay_is_restored_slot_by_slot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(replay_module, "SHARD", 16)
    replay = Replay(capacity=64, batch=8)
    fill(replay, 0, 40)
    replay.save(tmp_path)
    first_files = {p.name for p in tmp_path.iterdir()}
    fill(replay, 40, 100)
    replay.save(tmp_path)
    replay.forget_old_files(tmp_path)
    ranges = [tuple(map(int, p.stem.split("-"))) for p in sorted(tmp_path.iterdir())]
    assert ranges == [(36, 48), (48, 64), (64, 80), (80, 96), (96, 100)]
    assert not {p.name for p in tmp_path.iterdir()} & first_files
    other = Replay(capacity=64, batch=8)
    other.added = replay.added
    other.load(tmp_path)
    for more in (None, (100, 110)):
        for buffer in (replay, other):
            if more:
                fill(buffer, *more)
        for key in ("observation", ("next", "reward")):
            assert torch.equal(other.buffer.storage[:][key], replay.buffer.storage[:][key])
    torch.manual_seed(0)
    drawn = replay.sample()["observation"]
    torch.manual_seed(0)
    assert torch.equal(other.sample()["observation"], drawn)


def test_a_missing_replay_file_is_reported(tmp_path: Path):
    replay = Replay(capacity=64, batch=8)
    replay.added = 10
    with pytest.raises(InputError, match="replay"):
        replay.load(tmp_path)
