"""Whole runs on the fake task: learning, resuming, interruptions, workers."""

import contextlib
import csv
import dataclasses
import functools
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch
from fake_task import PointMass
from short_runs import BASE, SMALL_PPO, run
from torch import Tensor

from dora.agents.checkpoint import read_checkpoint
from dora.agents.collecting.rollouts import Rollouts
from dora.agents.collecting.task_env import TrainingRules
from dora.agents.config import SACConfig
from dora.agents.evaluation.evaluators import Evaluators
from dora.agents.evaluation.play import evaluate_checkpoint
from dora.agents.learners.networks import last_layer
from dora.agents.learners.ppo import PPO
from dora.agents.runs import trainer
from dora.agents.runs.progress_table import read_progress
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.trainer import Trainer
from dora.errors import InputError
from dora.parallel import warm_up

RESULT_KEYS = [
    *("env", "agent", "guidance", "preset", "seed", "commit", "task_config"),
    *("env_steps", "wall_seconds", "env_steps_per_second", "episodes"),
    *("success_rate", "zero_success_rate", "stage_rates", "return_mean", "penetration_max_mm"),
    *("num_envs", "workers", "config_digest", "finished"),
]

SMALL_SAC = SACConfig(rollout=8, batch=64, warmup=256, critic_only=8, hidden=(32, 32))


class Drifting(PointMass):
    """A task that breaks after some steps."""

    def step(self, action: Tensor) -> Any:
        if int(self.elapsed_steps.max()) == 5:
            raise InputError("The action of environment 3 is NaN: send finite numbers.")
        return super().step(action)


class Placed(PointMass):
    """A task that can be made only where a variable of the environment is set."""

    def __init__(self, *args: Any, **kwargs: Any):
        assert os.environ.get("DORA_TEST") == "now"
        super().__init__(*args, **kwargs)


def weights(path: Path) -> dict[str, Tensor]:
    return read_checkpoint(RunFolder(path).latest).tensors


def test_ppo_learns_and_leaves_a_complete_folder(tmp_path: Path):
    config = dataclasses.replace(BASE, total_steps=40_000, eval_every=10_000)
    result = run(tmp_path / "run", config)
    assert list(result)[: len(RESULT_KEYS)] == RESULT_KEYS
    assert json.loads((tmp_path / "run" / "result.json").read_text()) == result
    assert result["success_rate"] > 0.9
    assert result["zero_success_rate"] < 0.3
    assert result["finished"]
    assert result["stage_rates"].keys() == {"approach", "reach"}
    with (tmp_path / "run" / "eval.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 40
    assert sum(float(r["success"]) for r in rows) / 40 == pytest.approx(result["success_rate"])
    assert {p.name for p in (tmp_path / "run").iterdir()} >= {"config.yaml", "versions.txt", "curve.csv"}
    _, evaluation, zero = evaluate_checkpoint(RunFolder(tmp_path / "run").best, config, PointMass)
    assert evaluation.success_rate == result["success_rate"]
    assert zero is not None


def test_the_curve_has_the_success_of_the_latest_training_episodes(tmp_path: Path):
    run(tmp_path / "run", dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=2048, eval_every=1024))
    rows = read_progress(tmp_path / "run" / "progress.csv")
    with (tmp_path / "run" / "curve.csv").open() as stream:
        curve = list(csv.DictReader(stream))
    for row in curve[1:] or curve:
        before = rows["env_steps"] <= float(row["env_steps"])
        ended = rows["episodes"][before]
        assert 0 < ended.sum() <= trainer.RECENT
        share = np.nansum(rows["success_rate"][before] * ended) / ended.sum()
        assert float(row["training_success_rate"]) == pytest.approx(share, abs=1e-5)


@pytest.mark.slow
def test_sac_learns(tmp_path: Path):
    learner = SACConfig(
        batch=64, updates_per_step=1 / 8, warmup=500, critic_only=50, n_step=3, prior=0.0, log_std_max=-0.4,
        learning_rate=2e-3, learning_rate_actor=2e-3, hidden=(64, 64), capacity=20_000,
    )  # fmt: skip
    config = dataclasses.replace(
        BASE, agent="sac", guidance="none", total_steps=10_500, eval_every=3_500, learner=learner
    )
    result = run(tmp_path / "run", config)
    assert result["success_rate"] > 0.9
    assert result["zero_success_rate"] is None


@pytest.mark.parametrize("agent", ["ppo", "sac"])
def test_resuming_goes_on_exactly(tmp_path: Path, agent: str):
    """Episodes end with the rollout and all start alike, so a restart of the environments changes nothing."""
    learner = (
        SMALL_PPO if agent == "ppo" else SACConfig(rollout=16, batch=64, warmup=100, critic_only=2, hidden=(16, 16))
    )
    config = dataclasses.replace(BASE, agent=agent, learner=learner, total_steps=4 * 256, eval_every=512, stagger=False)
    make = functools.partial(PointMass, deterministic=True)
    run(tmp_path / "straight", config, make)
    run(tmp_path / "halves", dataclasses.replace(config, total_steps=2 * 256), make)
    run(tmp_path / "halves", config, make, resume=True)
    straight, halves = weights(tmp_path / "straight"), weights(tmp_path / "halves")
    assert straight.keys() == halves.keys()
    for name, value in straight.items():
        assert torch.equal(value, halves[name]), name
    curves = [(tmp_path / name / "curve.csv").read_text().splitlines() for name in ("straight", "halves")]
    assert [line.split(",")[2] for line in curves[0]] == [line.split(",")[2] for line in curves[1]]


def test_same_seed_same_run_and_other_seed_another(tmp_path: Path):
    config = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=1024, eval_every=512)
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        run(tmp_path / name, dataclasses.replace(config, seed=seed))
    a, b, c = (weights(tmp_path / name)["actor/mean.0.weight"] for name in "abc")
    assert torch.equal(a, b)
    assert not torch.equal(a, c)


@pytest.mark.parametrize(("total", "evaluated"), [(1024, [512, 1024]), (1280, [512, 1024, 1280]), (256, [])])
def test_the_end_of_a_budget_is_evaluated_if_anything_was(tmp_path: Path, total: int, evaluated: list[int]):
    run(tmp_path / "run", dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=total, eval_every=512))
    curve = tmp_path / "run" / "curve.csv"
    lines = curve.read_text().splitlines()[1:] if curve.exists() else []
    assert [int(line.partition(",")[0]) for line in lines] == evaluated


def test_without_samples_of_a_normaliser_observations_are_learned_from_as_they_are(tmp_path: Path):
    for steps in (256, 512):
        config = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=steps, normaliser_samples=0)
        run(tmp_path / str(steps), config)
    first, second = (weights(tmp_path / str(steps)) for steps in (256, 512))
    assert float(second["normaliser/count"]) == 0.0
    assert not torch.equal(first["actor/mean.0.weight"], second["actor/mean.0.weight"])


def test_resume_refuses_other_settings(tmp_path: Path):
    config = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=512)
    run(tmp_path / "run", config)
    with pytest.raises(InputError, match="digest"):
        run(tmp_path / "run", dataclasses.replace(config, num_envs=8), resume=True)
    with pytest.raises(InputError, match="holds a run already"):
        run(tmp_path / "run", config)


def test_stop_success_needs_two_evaluations_in_a_row(tmp_path: Path):
    config = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=9999, eval_every=512, stop_success=0.0)
    assert run(tmp_path / "run", config)["env_steps"] == 1024


@pytest.mark.parametrize(
    ("agent", "learner"), [("ppo", SMALL_PPO), pytest.param("sac", SMALL_SAC, marks=pytest.mark.slow)]
)
def test_worker_processes_learn_repeat_and_leave_nothing_behind(tmp_path: Path, agent: str, learner: Any):
    config = dataclasses.replace(BASE, agent=agent, workers=2, num_envs=8, learner=learner, total_steps=2048)
    before = children()
    results = [run(tmp_path / name, config) for name in "ab"]
    assert results[0]["env_steps"] == 2048
    name = "actor/mean.0.weight" if agent == "ppo" else "actor/net.0.weight"
    a, b = (weights(tmp_path / run_name)[name] for run_name in "ab")
    assert torch.equal(a, b)
    assert children() == before


class Slow(PointMass):
    """A task that takes its time."""

    def step(self, action: Tensor) -> Any:
        time.sleep(0.02)
        return super().step(action)


def test_the_rate_that_is_shown_is_steps_over_time(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    run(tmp_path / "run", dataclasses.replace(BASE, total_steps=2_000))
    shown = [float(rate.replace(",", "")) for rate in re.findall(r"([\d,]+) steps/s", capfd.readouterr().err)]
    assert shown
    assert all(0 < rate < 1e8 for rate in shown)


def test_time_spent_with_saving_is_time_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """So are the moments in which other programs are looked at, of which the share is one of the same time."""
    saved, save = [], Trainer.save

    def slowly(trainer: Trainer) -> None:
        time.sleep(0.2)
        saved.append(save(trainer))

    monkeypatch.setattr(Trainer, "save", slowly)
    start = time.perf_counter()
    result = run(tmp_path / "run", dataclasses.replace(BASE, total_steps=2_000, checkpoint_seconds=0.0))
    passed = time.perf_counter() - start
    assert len(saved) > 2
    assert 0.2 * len(saved) < result["wall_seconds"] < passed


def test_time_of_the_start_and_of_an_evaluation_that_is_interrupted_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(*_: Any) -> Any:
        time.sleep(0.5)
        raise KeyboardInterrupt

    make = trainer.make_learner

    def slowly(*arguments: Any) -> Any:
        time.sleep(0.5)
        return make(*arguments)

    monkeypatch.setattr(Evaluators, "run", interrupted)
    monkeypatch.setattr(trainer, "make_learner", slowly)
    result = run(tmp_path / "run", dataclasses.replace(BASE, total_steps=500, eval_every=10_000))
    assert not result["finished"]
    assert result["wall_seconds"] > 1.0


@pytest.mark.slow
def test_batches_collected_ahead_are_of_the_policy_before():
    learner = PPO(dataclasses.replace(SMALL_PPO, log_std=-3.0), 4, 2, 1000)
    actor: Any = learner.actor
    rollouts = Rollouts(
        functools.partial(Slow, 4), learner.policy,
        workers=2, num_envs=4, rollout=8, seeds=[0, 1], rules=TrainingRules(), ahead=True,
    )  # fmt: skip
    means: list[float] = []
    with rollouts, torch.no_grad():
        for call in range(4):
            batch = rollouts.collect()
            last_layer(actor.mean).bias.fill_(call + 1.0)  # while the workers are at the next batch
            means.append(float(batch["action"].mean()))
    assert [round(mean) for mean in means] == [0, 0, 1, 2]


def test_workers_are_forked_from_a_server_and_have_the_environment_of_now(monkeypatch: pytest.MonkeyPatch):
    """It has imported what they need; what others start is started as before."""
    warm_up(Rollouts)  # without the variable, unless it runs already
    monkeypatch.setenv("DORA_TEST", "now")
    before, policy = multiprocessing.get_start_method(allow_none=True), PPO(SMALL_PPO, 4, 2, 1000).policy
    make, rules = functools.partial(Placed, 4), TrainingRules()
    with Rollouts(make, policy, workers=1, num_envs=4, rollout=8, seeds=[0], rules=rules) as rollouts:
        assert rollouts.collect().shape == (4, 8)
        (worker,) = (psutil.Process(process.pid) for process in rollouts._processes)
        server = worker.parent()
        assert server is not None
        assert server.ppid() == os.getpid()
        assert worker.cmdline() == server.cmdline()
    assert multiprocessing.get_start_method(allow_none=True) == before


@pytest.mark.parametrize("ahead", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_message_of_a_failing_worker_arrives(ahead: bool):
    learner = PPO(SMALL_PPO, 4, 2, 1000)
    rollouts = Rollouts(
        functools.partial(Drifting, 4), learner.policy,
        workers=1, num_envs=4, rollout=8, seeds=[0], rules=TrainingRules(), ahead=ahead,
    )  # fmt: skip
    with rollouts, pytest.raises(InputError, match="environment 3 is NaN"):
        rollouts.collect()


def children() -> set[str]:
    """Python processes started by this one, directly or from its server, but for the interpreter's own, which end with
    it: those that keep track of resources, and the server."""
    this, found = psutil.Process(), set()
    for process in this.children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has just ended
            words, server = " ".join(process.cmdline()), process.ppid() == this.pid
            own = "resource_tracker" in words or (server and "multiprocessing.forkserver" in words)
            if "python" in words and not own and process.status() != psutil.STATUS_ZOMBIE:
                found.add(f"{process.pid} {words}")
    return found


SCRIPT = """
import dataclasses, sys
from pathlib import Path
from fake_task import PointMass
from short_runs import BASE, SMALL_PPO, run
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.trainer import Trainer
from test_agents_train import BASE, SMALL_PPO
if __name__ == "__main__":
    resume, total = sys.argv[2] == "resume", int(sys.argv[3])
    config = dataclasses.replace(
        BASE, workers=1, learner=SMALL_PPO, total_steps=total, eval_every=10**9, checkpoint_seconds=0.2
    )
    folder = RunFolder(Path(sys.argv[1]))
    if not resume:
        folder.create(config)
    result = Trainer(config, PointMass, folder, resume=resume).run()
    sys.exit(0 if result["finished"] else 130)
"""


def start(tmp_path: Path, mode: str, total: int) -> subprocess.Popen[bytes]:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    root = Path(__file__).parent
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), str(root.parent)]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(script), str(tmp_path / "run"), mode, str(total)]
    return subprocess.Popen(command, env=env, stderr=subprocess.PIPE, start_new_session=True)


def wait_for_checkpoint(process: subprocess.Popen[bytes], path: Path, newer_than: float) -> None:
    deadline = time.monotonic() + 40
    while not path.exists() or path.stat().st_mtime <= newer_than:
        assert process.poll() is None, process.stderr and process.stderr.read().decode()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def session_empties(session: int, within: float = 10.0) -> bool:
    """Whether every process of the session ends; workers and trackers outlive their parent for a moment."""
    deadline = time.monotonic() + within
    while time.monotonic() < deadline:
        out = subprocess.run(["ps", "-s", str(session), "-o", "pid=,stat="], capture_output=True, text=True).stdout
        if all("Z" in line.split()[1] for line in out.splitlines() if line.strip()):
            return True
        time.sleep(0.1)
    return False


@pytest.mark.slow
def test_kill_then_resume_then_ctrl_c(tmp_path: Path):
    folder = RunFolder(tmp_path / "run")
    process = start(tmp_path, "new", 10**9)
    wait_for_checkpoint(process, folder.latest, 0.0)
    process.kill()
    process.communicate()
    killed = read_checkpoint(folder.latest).progress["env_steps"]
    assert killed > 0
    assert session_empties(process.pid)

    process = start(tmp_path, "resume", 10**9)
    wait_for_checkpoint(process, folder.latest, folder.latest.stat().st_mtime)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 130, errors.decode()
    assert "Traceback" not in errors.decode()
    result = json.loads((folder.path / "result.json").read_text())
    assert not result["finished"]
    assert result["env_steps"] > killed
    steps = read_progress(folder.progress)["env_steps"]
    assert (np.diff(steps) == np.diff(steps)[0]).all()  # none is missing and none is there twice
    assert steps[-1] == result["env_steps"]
    assert list(result)[: len(RESULT_KEYS)] == RESULT_KEYS
    assert session_empties(process.pid)
