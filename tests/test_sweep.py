"""Sweeps: none is lost or trained twice, whatever happens."""

import dataclasses
import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import call, refusal
from fake_run import PARENT, fake_words
from fake_sweep import fake, few, nothing, starts, states
from rich.console import Console

import dora.sweeps.sweep
from dora.commands import sweep as command
from dora.errors import InputError
from dora.sweeps.board import Board, _news, summary
from dora.sweeps.launching import LOG, is_locked, steps_of
from dora.sweeps.plan import Row, rows_of
from dora.sweeps.sweep import Entry, State, Sweep


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(dora.sweeps.sweep, "POLL_SECONDS", 0.05)


# ------------------------------------------------------------------ the loop


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_run_is_trained_once(tmp_path: Path, jobs: int):
    sweep, most = Sweep(few(), tmp_path, jobs=jobs), []
    sweep.run(fake("slow" if jobs == 2 else "well"), lambda s: most.append(s.count(State.RUNNING)), nothing)
    assert states(sweep) == [State.DONE] * 3
    assert starts(sweep) == [1, 1, 1]
    assert max(most) == jobs
    again = Sweep(few(), tmp_path)
    again.run(fake("fails"), nothing, nothing)  # nothing is left to begin
    assert starts(again) == [1, 1, 1]


def test_what_becomes_of_a_run_is_said_in_a_line(tmp_path: Path):
    (row,) = few(1)
    entry = Entry(row, tmp_path / "run")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / LOG).write_text("no")
    said = []
    for state, others in (
        (State.WAITING, {}), (State.RUNNING, {}), (State.WAITING, {"complaint": "status 1: no"}),
        (State.FAILED, {}), (State.DONE, {"success_rate": 0.5}), (State.ELSEWHERE, {"complaint": ""}),
    ):  # fmt: skip
        entry.state = state
        vars(entry).update(others)
        said.append(_news(entry))
    assert said == [
        "waiting", "begins", "will be tried again (status 1: no)",
        f"failed (status 1: no); what it printed is in {tmp_path / 'run'}/output.log", "done, success 0.500",
        "running (another process)",
    ]  # fmt: skip
    entry.state = State.RUNNING
    (tmp_path / "run" / "progress.csv").write_text("env_steps,seconds\n7,1\n")
    assert _news(entry) == "goes on"


def test_the_summary_counts_runs_of_other_processes_as_running(tmp_path: Path):
    sweep = Sweep(few(6), tmp_path)
    states = State.DONE, State.FAILED, State.RUNNING, State.ELSEWHERE, State.ELSEWHERE, State.WAITING
    for entry, state in zip(sweep.entries, states, strict=True):
        entry.state = state
    assert summary(sweep).startswith("1 of 6 runs done, 3 running, 1 waiting, 1 failed; about ")
    sweep.entries[1].state = State.WAITING
    assert summary(sweep).startswith("1 of 6 runs done, 3 running, 2 waiting; about ")


def test_why_a_run_could_not_be_begun_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It has failed before the first look at it."""

    def full(row: Row, folder: Path) -> None:
        raise InputError("the disk is full.")

    monkeypatch.setattr(dora.sweeps.sweep, "prepare", full)
    (row,), said = few(1), io.StringIO()
    sweep = Sweep([row], tmp_path)
    with Board(Console(file=said, width=1000)) as board:
        sweep.run(fake("well"), board, nothing)
    assert states(sweep) == [State.FAILED]
    assert f"{row.name}: failed (the disk is full.)\n" in said.getvalue()


def test_a_run_that_fails_is_gone_on_with_and_the_others_are_not_held_up(tmp_path: Path):
    sweep = Sweep(few(), tmp_path)
    sweep.run(fake("fails-once"), nothing, nothing)
    assert states(sweep) == [State.DONE] * 3
    assert starts(sweep) == [2, 2, 2]
    sweep, text = Sweep(few(), tmp_path / "other", retries=2), io.StringIO()
    sweep.run(fake("fails"), Board(Console(file=text, width=200)), nothing)
    assert states(sweep) == [State.FAILED] * 3
    assert starts(sweep) == [3, 3, 3]
    assert "failed (status 1: the disk is full)" in text.getvalue()
    assert (sweep.entries[0].folder / LOG).read_text() == "the disk is full\n" * 3


def test_ctrl_c_lets_runs_save_and_the_same_call_goes_on(tmp_path: Path):
    sweep, turns = Sweep(few(1), tmp_path), []

    def check() -> None:
        turns.append(steps_of(sweep.entries[0].folder))
        if turns[-1] > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep.run(fake("slow"), nothing, check)
    assert not (sweep.entries[0].folder / "result.json").exists()
    assert not is_locked(sweep.entries[0].folder)
    again = Sweep(few(1), tmp_path)
    again.run(fake("well"), nothing, nothing)
    assert states(again) == [State.DONE]
    assert starts(again) == [2]


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import test_sweep as t
sweep = t.Sweep(t.few(), Path(sys.argv[2]))
sweep.run(t.fake("slow"), t.nothing, t.nothing)
"""


def test_a_sweep_that_is_killed_loses_nothing(tmp_path: Path):
    """What it has begun goes on, and the next call waits for it instead of beginning it again."""
    first = few(1)[0]
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, str(Path(__file__).parent), str(tmp_path)])
    deadline = time.monotonic() + 60
    while steps_of(tmp_path / first.name) == 0 and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert is_locked(tmp_path / first.name)
    sweep, seen = Sweep(few(), tmp_path), []
    sweep.run(fake("well"), lambda s: seen.append(states(s)), nothing)
    assert seen[0] == [State.ELSEWHERE, State.WAITING, State.WAITING]  # one at a time
    assert states(sweep) == [State.DONE] * 3
    assert starts(sweep) == [1, 1, 1]


def test_a_folder_with_other_settings_is_refused_before_anything_is_trained(tmp_path: Path):
    Sweep(few(1), tmp_path).run(fake("well"), nothing, nothing)
    other = rows_of("paper", envs=["DoraCube-v1"], agents=["ppo"], guidance=["affordance"], seeds=[0], episodes=7)
    with pytest.raises(InputError, match="holds a run with other settings"):
        Sweep(other, tmp_path).run(fake("well"), nothing, nothing)


def test_a_run_of_a_larger_budget_is_refused_and_one_of_a_smaller_one_goes_on(tmp_path: Path):
    """It would go on to its own end, and be no run of the table."""
    rows = few(1)
    Sweep(rows, tmp_path).run(fake("well"), nothing, nothing)
    less, more = (
        [dataclasses.replace(row, config=dataclasses.replace(row.config, total_steps=steps)) for row in rows]
        for steps in (rows[0].config.total_steps // 2, 2 * rows[0].config.total_steps)
    )
    with pytest.raises(InputError, match=f"holds a run of {rows[0].config.total_steps:,} steps, and"):
        Sweep(less, tmp_path).run(fake("well"), nothing, nothing)
    sweep = Sweep(more, tmp_path)
    sweep.run(fake("well"), nothing, nothing)
    assert states(sweep) == [State.DONE]


# --------------------------------------------------------------- the command


def test_the_dry_run_shows_every_run_and_trains_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    assert call(command, monkeypatch, "--dry-run", "--env", "DoraCube-v1", "--seeds", "3", "4") == 0
    out = capsys.readouterr().out
    assert "DoraCube-v1/sac-affordance-observation-reward-filter-s4" in out
    assert "0 of 12 runs done, 0 running, 12 waiting; about" in out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--jobs 0", "--jobs is 0, but has to be at least 1"),
        ("--retries -1", "--retries is -1"),
        ("--seeds -3", "--seeds has -3"),
        ("--known nowhere", "--known nowhere is not a folder"),
        ("--env DoraDoor-v1", "--env 'DoraDoor-v1' is not in the sweep paper"),
        ("--total-steps 0", "--total-steps is 0"),
        (f"--jobs {10**400}", "--jobs is larger than 4096"),
    ],
)
def test_what_makes_no_sense_is_refused(
    words: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert message in refusal(command, monkeypatch, capsys, f"--dry-run {words}")


def test_a_file_in_the_place_of_its_folder_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "file").write_text("")
    for words in ("", "--dry-run"):
        assert "is not a folder" in refusal(command, monkeypatch, capsys, f"--out {tmp_path / 'file'} {words}")
    assert "Cannot make the folder" in refusal(command, monkeypatch, capsys, f"--out {tmp_path / 'file' / 'below'}")


@pytest.mark.parametrize("mode", ["well", "fails"])
def test_the_exit_status_of_a_sweep_says_whether_a_run_failed(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(command, "_launcher", lambda args, sweep: fake(mode))
    words = ("--env", "DoraCube-v1", "--agent", "ppo", "--guidance", "none", "--seeds", "3", "--retries", "0")
    assert call(command, monkeypatch, *words, "--out", str(tmp_path)) == (command.FAILED if mode == "fails" else 0)
    assert capsys.readouterr().out.endswith(f"{tmp_path}\n")


def test_a_sweep_that_is_interrupted_ends_as_by_that_signal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Sweep, "run", interrupted)
    words = ("--env", "DoraCube-v1", "--seeds", "3", "--out", str(tmp_path))
    assert call(command, monkeypatch, *words) == 128 + signal.SIGINT
    assert "The same command goes on" in capsys.readouterr().err


# ------------------------------------------------------------------- a cluster


@pytest.mark.slow
def test_a_run_whose_worker_dies_is_repeated_and_nothing_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # workers import `fake_run`, too
    from dora.sweeps.ray_cluster import RayLauncher

    launcher = RayLauncher(cores=1, command=lambda folder, zero: fake_words(folder, "slow"))
    sweep, killed = Sweep(few(4), tmp_path, jobs=2), []

    def check() -> None:
        parents = [entry.folder / PARENT for entry in sweep.entries if (entry.folder / PARENT).exists()]
        if not killed and parents:
            killed.append(int(parents[0].read_text()))
            os.kill(killed[0], signal.SIGKILL)

    sweep.run(launcher, nothing, check)
    assert killed
    assert states(sweep) == [State.DONE] * 4
    assert starts(sweep) == [1] * 4  # the process of the worker that died went on; its repetition waited for it
    assert not list(tmp_path.rglob(".seen-*"))


@pytest.mark.slow
def test_a_machine_that_does_not_see_the_folder_sends_the_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from dora.sweeps import ray_cluster

    monkeypatch.setattr(ray_cluster, "cache_folder", lambda: tmp_path / "there")
    (row,) = few(1)
    here = tmp_path / "here"
    settings = ray_cluster.plain(row.config)
    files = ray_cluster.train_there(str(here), "no-marker", settings, lambda folder, zero: fake_words(folder, "well"))
    assert set(files) == {"config.yaml", "versions.txt", "result.json", "progress.csv", "eval.csv", "zero.csv", LOG}
    here.mkdir()
    ray_cluster.receive(here, files)
    assert states(Sweep([row], tmp_path, [here])) == [State.DONE]
    other = few(2)[1]
    with pytest.raises(RuntimeError, match="status 1: the disk is full"):
        ray_cluster.train_there(
            str(here), "x", ray_cluster.plain(other.config), lambda folder, zero: fake_words(folder, "fails")
        )
