"""Sweeps: which runs, which are finished already, and that none is lost or trained twice, whatever happens."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import call, refusal
from fake_run import PARENT, STARTS, fake_words
from rich.console import Console

import dora.sweeps.sweep
from dora.affordance.bundled_sets import bundled_path
from dora.commands import run
from dora.commands import sweep as command
from dora.errors import InputError
from dora.sweeps.board import Board, _news, duration, summary
from dora.sweeps.launching import LOG, LocalLauncher, is_locked, resuming, steps_of
from dora.sweeps.plan import MECHANISM, Row, rows_of
from dora.sweeps.sweep import Entry, State, Sweep
from dora.tasks import find_task


def fake(mode: str) -> LocalLauncher:
    """Trains with the process that stands in for a run."""
    return LocalLauncher(lambda folder, zero: fake_words(folder, mode))


def few(count: int = 3) -> list[Row]:
    return rows_of("paper", envs=["DoraCube-v1"], agents=["ppo"], guidance=["affordance"], seeds=range(count))


def result(row: Row, folder: Path, **other: object) -> None:
    """Writes the result of a finished run."""
    content = {
        "env": row.config.env, "agent": row.config.agent, "guidance": row.config.guidance, "wall_seconds": 600.0,
        "env_steps": row.config.total_steps, "success_rate": 0.75, "zero_success_rate": None,
        "penetration_p95_mm": None, "config_digest": row.config.digest(), "total_steps": row.config.total_steps,
        "finished": True,
    } | other  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps(content))


def states(sweep: Sweep) -> list[State]:
    return [entry.state for entry in sweep.entries]


def starts(sweep: Sweep) -> list[int]:
    """How often each run was begun."""
    return [len((sweep.out / entry.row.name / STARTS).read_text()) for entry in sweep.entries]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(dora.sweeps.sweep, "POLL_SECONDS", 0.05)


def nothing(*_: object) -> None:
    pass


# ------------------------------------------------------------------- the plan


def test_the_papers_tables_and_the_ladder_are_planned():
    rows = rows_of("paper")
    parts = {title: sum(row.title == title for row in rows) for title in {row.title for row in rows}}
    assert parts == {"Table I": 36, "Table IV": 12, "ladder": 15}
    assert len({row.name for row in rows}) == len({row.config.digest() for row in rows}) == 63
    assert [row.config.seed for row in rows] == sorted(row.config.seed for row in rows)
    assert {row.config.guidance_parts for row in rows} == {None, MECHANISM}
    assert all(row.config.final_episodes == 500 for row in rows)
    for row in rows:
        for arm in find_task(row.config.env).ARMS.values():
            assert bundled_path(arm.object, region=row.config.guidance != "grasps").exists(), row.name


@pytest.mark.parametrize("index", [0, 9, 13, 19])
def test_the_settings_of_a_row_are_those_of_the_command(index: int):
    row = rows_of("paper")[index]
    c = row.config
    words = ["--env", c.env, "--agent", c.agent, "--guidance", c.guidance, "--seed", str(c.seed), "--episodes", "500",
             "--workers", "2", "--total-steps", str(c.total_steps)]  # fmt: skip
    words += ["--guidance-parts", *c.guidance_parts] if c.guidance_parts else []
    assert run.parse(words).run == c


def test_only_some_rows_may_be_asked_for():
    rows = rows_of("paper", envs=["DoraMicrowave-v1"], agents=["happo"], guidance=["none"], seeds=[7], total_steps=9)
    assert [(row.config.env, row.config.seed, row.config.total_steps) for row in rows] == [("DoraMicrowave-v1", 7, 9)]
    with pytest.raises(InputError, match="--agent 'ddpg' is not in the sweep paper: there are happo, mappo, ppo, sac"):
        rows_of("paper", agents=["ddpg"])
    with pytest.raises(InputError, match="fits all of"):
        rows_of("paper", envs=["DoraCube-v1"], agents=["happo"])


# -------------------------------------------------------- what is finished already


def test_a_finished_run_counts_whichever_command_made_it(tmp_path: Path):
    rows = few(4)
    result(rows[0], tmp_path / "known" / "any" / "name")
    result(rows[1], tmp_path / "known" / "short", total_steps=rows[1].config.total_steps - 1)
    result(rows[2], tmp_path / "known" / "half", finished=False)
    result(rows[3], tmp_path / "known" / "judged-again", checkpoint="somewhere")
    sweep = Sweep(rows, tmp_path / "out", [tmp_path / "known"])
    assert states(sweep) == [State.DONE, State.WAITING, State.WAITING, State.WAITING]
    assert (sweep.entries[0].success_rate, sweep.entries[0].seconds) == (0.75, 600.0)
    assert not (tmp_path / "out").exists()


def test_zero_correction_is_evaluated_once_for_all_seeds_and_learners(tmp_path: Path):
    rows = rows_of("paper", envs=["DoraCube-v1"], seeds=[10, 11])
    asked: dict[Path, bool] = {}

    class Noting(LocalLauncher):
        def start(self, row: Row, folder: Path, zero: bool) -> None:
            asked[row.name] = zero
            if zero and row.config.has_prior:
                (folder / "zero.csv").touch()
            super().start(row, folder, zero)

    sweep = Sweep(rows, tmp_path / "out", [])
    sweep.run(Noting(lambda folder, zero: fake_words(folder, "well")), nothing, nothing)
    assert set(states(sweep)) == {State.DONE}
    guided = [row for row in rows if row.config.has_prior]
    assert [row.name.name for row in guided if asked[row.name]] == ["ppo-affordance-s10", "sac-grasps-s10"]
    assert len(guided) == 6
    assert resuming(tmp_path, zero=False) == [*resuming(tmp_path), "--no-zero-correction"]


def test_a_run_that_leaves_zero_correction_out_does_not_count_for_another_one(tmp_path: Path):
    """The first run evaluates it, and fails; while it is repeated, the second one is trained without."""
    rows = rows_of("paper", envs=["DoraCube-v1"], agents=["ppo"], guidance=["affordance"], seeds=[10, 11])
    asked: list[tuple[int, bool]] = []

    class Noting(LocalLauncher):
        def start(self, row: Row, folder: Path, zero: bool) -> None:
            asked.append((row.config.seed, zero))
            super().start(row, folder, zero)

    modes = {10: "fails-once", 11: "slow"}
    by_seed = {str(tmp_path / row.name): modes[row.config.seed] for row in rows}
    sweep = Sweep(rows, tmp_path, jobs=2)
    sweep.run(Noting(lambda folder, zero: fake_words(folder, by_seed[str(folder)])), nothing, nothing)
    assert asked == [(10, True), (11, False), (10, True)]


def test_a_run_that_was_good_enough_early_shows_the_steps_that_it_took(tmp_path: Path):
    (row,) = few(1)
    result(row, tmp_path / "known" / "early", env_steps=1234)
    (entry,) = Sweep([row], tmp_path / "out", [tmp_path / "known"]).entries
    assert (entry.state, entry.env_steps, entry.seconds_left) == (State.DONE, 1234, 0.0)


def test_time_that_is_left_is_that_of_runs_of_the_same_kind(tmp_path: Path):
    rows = few(3)
    result(rows[0], tmp_path / "known" / "one")  # ten minutes
    sweep = Sweep(rows, tmp_path / "out", [tmp_path / "known"])
    assert sweep.seconds_left == pytest.approx(1200)
    sweep.jobs = 2
    assert sweep.seconds_left == pytest.approx(600)
    assert summary(sweep) == "1 of 3 runs done, 0 running, 2 waiting; about 10 min left"
    assert duration(3 * 3600.0) == "3.0 h"


def test_a_damaged_result_is_named(tmp_path: Path):
    result(few(1)[0], tmp_path / "known" / "one", success_rate="high")
    with pytest.raises(InputError, match=r"known/one/result\.json is damaged"):
        Sweep(few(1), tmp_path / "out", [tmp_path / "known"])


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
