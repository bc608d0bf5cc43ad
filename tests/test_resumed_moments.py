"""What a run that was interrupted at an awkward moment does when it is resumed."""

import csv
import dataclasses
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from fake_task import PointMass
from short_runs import BASE, SMALL_PPO, run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict import TensorDict

from dora.agents.checkpoint import read_checkpoint
from dora.agents.config import SACConfig
from dora.agents.evaluation.evaluators import Evaluators
from dora.agents.learners import replay as replay_module
from dora.agents.learners.replay import Replay
from dora.agents.learners.sac import SAC
from dora.agents.runs import trainer as trainer_module
from dora.agents.runs.interrupt import Interrupt
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.trainer import Trainer

CONFIG = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=1024, eval_every=512)
"""Two evaluations, the second one at the end."""


def curve(path: Path) -> list[int]:
    """Environment steps of the evaluations."""
    with (path / "curve.csv").open() as stream:
        return [int(row["env_steps"]) for row in csv.DictReader(stream)]


def interrupt_at(monkeypatch: pytest.MonkeyPatch, name: str, call: int) -> None:
    """Ctrl-C in the given call of a method of `Evaluators`, counted from 1, and in no other."""
    method, calls = getattr(Evaluators, name), []

    def interrupted(*arguments: Any, **options: Any) -> Any:
        calls.append(name)
        if len(calls) == call:
            raise KeyboardInterrupt
        return method(*arguments, **options)

    monkeypatch.setattr(Evaluators, name, interrupted)


def test_an_evaluation_at_the_end_of_the_budget_that_was_interrupted_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole = run(tmp_path / "whole", CONFIG)
    interrupt_at(monkeypatch, "run", 2)
    stopped = run(tmp_path / "run", CONFIG)
    assert not stopped["finished"]
    assert stopped["env_steps"] == 1024
    assert curve(tmp_path / "run") == [512]
    resumed = run(tmp_path / "run", CONFIG, resume=True)
    assert curve(tmp_path / "run") == [512, 1024]
    assert resumed["success_rate"] == whole["success_rate"]


@pytest.mark.parametrize(("total", "steps"), [(9999, 1024), (20_000, 2048)])
def test_a_run_that_was_good_enough_trains_no_further_unless_its_budget_grows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, total: int, steps: int
):
    config = dataclasses.replace(CONFIG, total_steps=9999, stop_success=0.0)
    interrupt_at(monkeypatch, "final", 1)
    assert not run(tmp_path / "run", config)["finished"]
    resumed = run(tmp_path / "run", dataclasses.replace(config, total_steps=total), resume=True)
    assert resumed["finished"]
    assert resumed["env_steps"] == steps


def test_the_best_policy_of_steps_that_a_kill_undid_keeps_its_rank(tmp_path: Path):
    """The file of the best policy is written before the next checkpoint."""
    config = dataclasses.replace(CONFIG, total_steps=512)
    run(tmp_path / "run", config)
    folder = RunFolder(tmp_path / "run")
    before = folder.latest.read_bytes()
    run(tmp_path / "run", dataclasses.replace(config, total_steps=8192), resume=True)
    best = read_checkpoint(folder.best)
    assert best.progress["env_steps"] > 512
    folder.latest.write_bytes(before)
    resumed = Trainer(dataclasses.replace(config, total_steps=8192), PointMass, folder, resume=True)
    assert resumed.counters.env_steps == 512
    assert resumed.counters.best == best.progress["best"]


def test_a_result_names_the_commit_with_which_its_run_began(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    commits = iter(["0123456789ab", "of a checkout that has changed meanwhile"])
    monkeypatch.setattr(trainer_module, "source_commit", lambda: next(commits))
    assert run(tmp_path / "run", dataclasses.replace(CONFIG, total_steps=256))["commit"] == "0123456789ab"


def test_a_signal_while_the_result_is_written_is_told_and_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    write = RunFolder.write_result

    def interrupted(folder: RunFolder, result: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        return write(folder, result)

    monkeypatch.setattr(RunFolder, "write_result", interrupted)
    folder = RunFolder(tmp_path / "run")
    folder.create(CONFIG)
    trainer = Trainer(CONFIG, PointMass, folder)
    assert trainer.run()["finished"]
    assert trainer.interrupted == signal.SIGTERM


@pytest.mark.parametrize("at_once", [False, True])
def test_what_was_not_saved_is_not_called_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: bool):
    class Impatient(Interrupt):
        def __init__(self) -> None:
            super().__init__()
            self.at_once = at_once

    monkeypatch.setattr(trainer_module, "Interrupt", Impatient)
    interrupt_at(monkeypatch, "run", 2)
    folder = RunFolder(tmp_path / "run")
    folder.create(CONFIG)
    trainer = Trainer(CONFIG, PointMass, folder)
    assert not trainer.run()["finished"]
    assert trainer.interrupted == signal.SIGINT
    assert trainer.saved is not at_once
    assert read_checkpoint(folder.latest).progress["env_steps"] == (512 if at_once else 1024)


def test_tensorboard_shows_the_last_point_before_a_run_was_resumed(tmp_path: Path):
    run(tmp_path / "run", dataclasses.replace(CONFIG, total_steps=512))
    run(tmp_path / "run", CONFIG, resume=True)
    events = EventAccumulator(str(tmp_path / "run"))
    events.Reload()
    assert [event.step for event in events.Scalars("evaluation/success_rate")] == [512, 1024]
    assert [event.step for event in events.Scalars("speed/steps_per_second")] == [256, 512, 768, 1024]


def test_files_of_large_transitions_hold_fewer(tmp_path: Path):
    """At 16,384 of them a file of the jug with a history of 15 observations could not be read again."""
    replay = Replay(capacity=64, batch=8, size=replay_module.FULL // 10)
    replay.extend(TensorDict({"observation": torch.arange(25.0)[:, None]}, batch_size=[25]))
    replay.save(tmp_path)
    assert [path.stem for path in sorted(tmp_path.iterdir())] == [
        "0000000000-0000000010", "0000000010-0000000020", "0000000020-0000000025",
    ]  # fmt: skip
    settings = SACConfig(hidden=(8,), capacity=8)
    small, large = (SAC(settings, observation, 26, 1000).replay.shard for observation in (500, 20_000))
    assert small == replay_module.SHARD
    assert 1000 < large < replay_module.FULL // (8 * 20_000)
