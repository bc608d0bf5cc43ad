"""Runs that cannot go on: what is said, what is on disk, and that they can be resumed."""

import dataclasses
import functools
import json
import math
import os
import signal
import time
from multiprocessing import parent_process
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
import torch
from commands import call, load_command
from fake_task import PointMass
from test_agents_train import BASE, SMALL_PPO, SMALL_SAC, children, run, weights
from torch import Tensor

from dora.agents.checkpoint import read_checkpoint
from dora.agents.collecting import rollouts
from dora.agents.collecting.task_env import TaskEnv
from dora.agents.config import HAPPOConfig
from dora.agents.evaluation.evaluators import Evaluators
from dora.agents.learners.finite import check_loss, check_modules
from dora.agents.runs.interrupt import IMPATIENT, Interrupt
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.trainer import Trainer
from dora.commands import run as run_command
from dora.commands.interruptions import command, interrupt
from dora.errors import RunFailure, WorkerFailure

SHORT = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=1536, eval_every=512, stagger=False)
SHORT_SAC = dataclasses.replace(SHORT, agent="sac", learner=SMALL_SAC)
SHORT_HAPPO = dataclasses.replace(SHORT, agent="happo", learner=HAPPOConfig(**vars(SMALL_PPO)))


class Breaking(PointMass):
    """Something happens to row 3 in the n-th step of its process."""

    def __init__(self, *args: Any, at: int = 60, what: str = "nan", **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.at, self.what, self.steps = at, what, 0
        if what == "die at the start" and parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        if what == "raise at the start" and parent_process() is not None:
            raise ValueError("one line\nanother line")

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        if options and self.what == "raise in a reset" and parent_process() is not None:
            raise ValueError("one line\nanother line.")
        return super().reset(seed, options)

    def step(self, action: Tensor) -> Any:
        self.steps += 1
        observation, reward, fail, truncated, info = super().step(action)
        if self.steps == self.at and self.what == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.steps == self.at and self.what == "raise":
            raise ValueError("one line\nanother line.")
        if self.steps == self.at and self.what == "hang":
            time.sleep(1000)
        if self.steps == self.at and self.what == "nan":
            self.position[3] = torch.nan
            observation = self.observe()
        if self.steps == self.at and self.what == "reward":
            reward = reward.index_fill(0, torch.tensor([3]), torch.inf)
        if self.steps >= self.at and self.what == "huge":
            reward = reward + 3e38
        return observation, reward, fail, truncated, info


def finite(tensors: dict[str, Tensor]) -> bool:
    return all(bool(value.isfinite().all()) for value in tensors.values() if value.is_floating_point())


@pytest.mark.parametrize("what", ["nan", "reward"])
@pytest.mark.parametrize("config", [SHORT, SHORT_SAC], ids=["ppo", "sac"])
def test_a_row_that_is_not_finite_costs_one_episode(tmp_path: Path, config: Any, what: str):
    """One for each task that a run makes: the one that trains and the one that evaluates."""
    result = run(tmp_path / "run", config, functools.partial(Breaking, what=what, at=20))
    assert result["finished"]
    assert result["nonfinite_episodes"] == 1  # of training; the last evaluation comes later than its task's step 20
    assert finite(weights(tmp_path / "run"))
    assert read_checkpoint(RunFolder(tmp_path / "run").latest).progress["nonfinite"] == 1


def test_a_row_that_is_not_finite_is_terminated_and_counted():
    task = Breaking(5, at=2, what="nan")
    env = TaskEnv(task, seed=0)
    data: Any = env.reset()
    last: Any = None
    for step in (1, 2):
        data["action"] = torch.zeros(5, 2)
        out, data = env.step_and_maybe_reset(data)
        last = out["next"]
        assert last["terminated"][:, 0].tolist() == [row == 3 and step == 2 for row in range(5)]
    assert finite(last.to_dict())
    assert finite(data.to_dict())
    columns = dict(zip(env.columns.names, last["statistics"].T, strict=True))
    assert columns["nonfinite"].tolist() == [0, 0, 0, 1, 0]
    assert (columns["success"][3], columns["length"][3], columns["whole"][3]) == (0, 2, 1)
    assert last["reward"][3] == 0
    task.position[1] = torch.nan  # a row that is not reset beside one that is
    assert finite(env._restart_rows(torch.tensor([False, False, True, False, False])).to_dict())


class BreakingTwo(Breaking):
    """Two agents, each of which moves the point along one axis."""

    agent_columns: ClassVar = {"x": ([0, 1, 2, 3], [0]), "y": ([0, 1, 2, 3], [1])}


@pytest.mark.parametrize("config", [SHORT, SHORT_SAC, SHORT_HAPPO], ids=["ppo", "sac", "happo"])
def test_a_run_that_diverges_keeps_its_last_good_checkpoint(tmp_path: Path, config: Any):
    config = dataclasses.replace(config, checkpoint_seconds=0.0, total_steps=4096)
    task = BreakingTwo if config is SHORT_HAPPO else Breaking
    with pytest.raises(RunFailure, match=r"^Training diverged: .*\.$"):
        run(tmp_path / "run", config, functools.partial(task, what="huge", at=80))
    folder = RunFolder(tmp_path / "run")
    assert finite(weights(tmp_path / "run"))
    assert read_checkpoint(folder.latest).progress["env_steps"] > 0
    assert json.loads((folder.path / "result.json").read_text())["finished"] is False


def test_networks_and_losses_that_are_not_finite_are_named():
    network = torch.nn.Linear(2, 2)
    check_modules({"actor": network})
    network.bias.data[1] = torch.inf
    with pytest.raises(RunFailure, match="actor/bias contains NaN or infinity"):
        check_modules({"actor": network})
    check_loss("loss", torch.zeros(()))
    with pytest.raises(RunFailure, match="the loss is nan"):
        check_loss("loss", torch.tensor(math.nan))


def test_nothing_that_is_not_finite_is_saved(tmp_path: Path):
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    trainer = Trainer(SHORT, PointMass, folder)
    trainer.save()
    next(iter(trainer.learner.modules["critic"].parameters())).data[0] = torch.nan
    with pytest.raises(RunFailure, match="critic"):
        trainer.save()
    assert finite(weights(tmp_path))


@pytest.mark.parametrize("ahead", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_worker_that_dies_leaves_a_run_that_goes_on(tmp_path: Path, ahead: bool):
    config = dataclasses.replace(SHORT_SAC if ahead else SHORT, workers=1)
    before = children()
    with pytest.raises(WorkerFailure, match=r"^A worker process died: worker 0 \(ended by SIGKILL\)\.$"):
        run(tmp_path / "run", config, functools.partial(Breaking, what="die", at=40))
    assert children() == before
    assert read_checkpoint(RunFolder(tmp_path / "run").latest).progress["env_steps"] > 0
    assert json.loads((tmp_path / "run" / "result.json").read_text())["finished"] is False
    assert run(tmp_path / "run", config, resume=True)["finished"]


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        ("raise", r"Worker 0 failed with ValueError: one line\nanother line."),
        pytest.param(
            "raise in a reset", r"Worker 0 failed with ValueError: one line\nanother line.", marks=pytest.mark.slow
        ),
        ("raise at the start", r"Worker 0 failed with ValueError: one line\nanother line."),
        ("die at the start", "A worker process died while it started: worker 0 (ended by SIGKILL)."),
    ],
)
def test_what_ends_a_worker_is_told_in_one_sentence_without_its_traceback(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], what: str, sentence: str
):
    before = children()
    with pytest.raises(WorkerFailure) as caught:
        run(tmp_path / "run", dataclasses.replace(SHORT, workers=1), functools.partial(Breaking, what=what, at=40))
    assert str(caught.value) == sentence
    assert "Traceback" not in capfd.readouterr().err
    assert children() == before


def test_a_worker_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rollouts, "PATIENCE", 3.0)
    before, start = children(), time.monotonic()
    with pytest.raises(WorkerFailure, match="hang"):
        run(tmp_path / "run", dataclasses.replace(SHORT, workers=1), functools.partial(Breaking, what="hang", at=40))
    assert time.monotonic() - start < 40
    assert children() == before


def test_a_failing_run_is_told_in_one_line_with_the_command_that_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail(*_: Any) -> None:
        raise WorkerFailure("A worker process died: worker 0 (ended by SIGKILL).")

    monkeypatch.setattr(run_command.Trainer, "run", fail)
    words = ("--env", "DoraCube-v1", "--num-envs", "2", "--eval-envs", "2", "--out", str(tmp_path / "run"))
    assert call(load_command("run"), monkeypatch, *words) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("A worker process died: worker 0 (ended by SIGKILL). To go on: python ")
    assert said.endswith(f"--resume {tmp_path / 'run'}")


@pytest.mark.parametrize(
    ("original", "own", "shown"),
    [
        ("/v/bin/python experiments/run.py --env E --seed 1", 4, "python experiments/run.py"),
        ("/v/bin/python /v/bin/dora run --env E", 2, "dora run"),
        ("python3 -m dora run --env E", 2, "python -m dora run"),
        ("python experiments/run.py", 0, "python experiments/run.py"),
    ],
)
def test_the_command_that_resumes_begins_as_the_run_began(original: str, own: int, shown: str):
    words = original.split()
    assert " ".join(run_command.started_as(words, ["dora run", *words[len(words) - own :]])) == shown


def test_the_last_evaluation_leaves_the_networks_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Also if it is interrupted: what is resumed is the last state, not the best policy with the last critic."""
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    trainer = Trainer(SHORT, PointMass, folder)
    seen: dict[str, Tensor] = {}

    def final(self: Evaluators, policy: Any, *_: Any, **__: Any) -> Any:
        seen.update({k: v.clone() for k, v in policy.state_dict().items()})
        os.kill(os.getpid(), signal.SIGTERM)
        raise KeyboardInterrupt

    def keep_first(self: Trainer) -> None:
        if not folder.best.exists():
            original(self)

    original = Trainer._keep_as_best
    monkeypatch.setattr(Trainer, "_keep_as_best", keep_first)
    monkeypatch.setattr(Evaluators, "final", final)
    assert not trainer.run()["finished"]
    assert trainer.interrupted == signal.SIGTERM
    best, latest = read_checkpoint(folder.best).tensors, weights(tmp_path)
    name = "actor/mean.0.weight"
    assert torch.equal(best[name], seen[name.replace("/", ".")])
    assert not torch.equal(best[name], latest[name])
    assert torch.equal(trainer.learner.modules["actor"].state_dict()["mean.0.weight"], latest[name])
    monkeypatch.undo()
    run(tmp_path, SHORT, resume=True)
    straight = run(tmp_path / "straight", SHORT)
    assert straight["finished"]
    for key, value in weights(tmp_path / "straight").items():
        assert torch.equal(value, weights(tmp_path)[key]), key


def test_the_first_signal_asks_and_a_later_one_ends(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with Interrupt() as asked:
        asked.check()
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)  # at once, as `timeout` does
        assert (asked.requested, asked.number) == (True, signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            asked.check()
        asked._since -= IMPATIENT
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        assert asked.at_once
    assert capfd.readouterr().err.count("Interrupted") == 1
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("moment", [0.5, 2.0])
def test_a_command_ends_quietly_while_it_is_imported(number: int, moment: float):
    line, end, status, said, _ = interrupt(command("--env", "DoraCube-v1"), number, moment, group=True)
    assert status == 128 + number, said
    assert line is not None
    assert end < 2 + moment
    assert "Traceback" not in said


def test_a_second_signal_while_the_result_is_written_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    trainer, close = Trainer(SHORT, PointMass, folder), Evaluators.close
    update = trainer.learner.update

    def interrupted(*batch: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        return update(*batch)

    def closing(self: Evaluators) -> None:
        time.sleep(IMPATIENT + 0.1)
        os.kill(os.getpid(), signal.SIGTERM)
        close(self)

    monkeypatch.setattr(trainer.learner, "update", interrupted)
    monkeypatch.setattr(Evaluators, "close", closing)
    assert not trainer.run()["finished"]
    assert trainer.interrupted == signal.SIGTERM
    assert json.loads((tmp_path / "result.json").read_text())["finished"] is False


def test_what_is_half_learned_is_not_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A second signal comes in the middle of learning: the checkpoint before stays."""
    folder = RunFolder(tmp_path)
    folder.create(SHORT)
    trainer = Trainer(SHORT, PointMass, folder)
    trainer.save()
    update, calls = trainer.learner.update, []

    def half(*batch: Any) -> Any:
        calls.append(update(*batch))
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(IMPATIENT + 0.1)
            os.kill(os.getpid(), signal.SIGINT)
        return calls[-1]

    monkeypatch.setattr(trainer.learner, "update", half)
    assert not trainer.run()["finished"]
    assert read_checkpoint(folder.latest).progress["env_steps"] == 0


def test_what_a_collector_had_made_before_it_failed_is_let_go_of(monkeypatch: pytest.MonkeyPatch):
    ended = []

    def failing(self: Any) -> None:
        self._weight_sync_schemes = {"policy": SimpleNamespace(shutdown=lambda: ended.append("policy"))}
        raise RuntimeError("no memory")

    monkeypatch.setattr(rollouts.MultiSyncCollector, "__init__", failing)
    with pytest.raises(RuntimeError, match="no memory"):
        rollouts._Workers()
    assert ended == ["policy"]
