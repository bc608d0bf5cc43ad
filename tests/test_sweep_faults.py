"""Sweeps that meet what they cannot use: other budgets, evaluations, broken folders, other processes, full disks."""

import fcntl
import json
import os
import sys
from pathlib import Path

import pytest
from commands import call
from fake_run import fake_words
from fake_sweep import fake, few, nothing, result, starts, states

import dora.sweeps.sweep
from dora.agents.runs.run_folder import RunFolder
from dora.commands import sweep as command
from dora.configs import plain
from dora.errors import InputError
from dora.sweeps import ray_cluster
from dora.sweeps.finished import finished_runs
from dora.sweeps.launching import NOT_THE_RUN, LocalLauncher, prepare, steps_of
from dora.sweeps.plan import rows_of
from dora.sweeps.sweep import State, Sweep


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(dora.sweeps.sweep, "POLL_SECONDS", 0.05)


def short_rows(steps: int):
    return rows_of("paper", envs=["DoraCube-v1"], agents=["ppo"], guidance=["affordance"], seeds=[0], total_steps=steps)


def test_a_run_of_a_smaller_budget_is_gone_on_with_up_to_the_larger_one(tmp_path: Path):
    Sweep(short_rows(1000), tmp_path).run(fake("well"), nothing, nothing)
    sweep = Sweep(short_rows(2000), tmp_path)
    assert states(sweep) == [State.WAITING]
    sweep.run(fake("well"), nothing, nothing)
    assert states(sweep) == [State.DONE]
    assert starts(sweep) == [2]
    assert RunFolder(sweep.entries[0].folder).read_config().total_steps == 2000


def test_a_cluster_goes_on_with_a_run_of_a_smaller_budget_too(tmp_path: Path):
    seen = []

    def command(folder: Path, zero: bool) -> list[str]:
        seen.append(RunFolder(folder).read_config().total_steps)
        return fake_words(folder, "well")

    for steps in (1000, 2000, 2000):
        (row,) = short_rows(steps)
        (tmp_path / row.name).mkdir(parents=True, exist_ok=True)
        (tmp_path / row.name / "seen").touch()
        ray_cluster.train_there(str(tmp_path / row.name), "seen", plain(row.config), command)
    assert seen == [1000, 2000]


def test_a_run_of_a_larger_budget_is_another_one(tmp_path: Path):
    (row,) = short_rows(1000)
    result(row, tmp_path / "known" / "long", total_steps=2000)
    assert states(Sweep([row], tmp_path / "out", [tmp_path / "known"])) == [State.WAITING]


def test_an_evaluation_of_zero_correction_is_no_trained_run(tmp_path: Path):
    (row,) = short_rows(1000)
    result(row, tmp_path / "known" / "zero", agent="zero", env_steps=0, checkpoint=None)
    assert states(Sweep([row], tmp_path / "out", [tmp_path / "known"])) == [State.WAITING]


@pytest.mark.parametrize("status", [0, 1])
def test_a_result_that_a_run_leaves_damaged_fails_that_run_alone(tmp_path: Path, status: int):
    first, second = few(2)

    def command(folder: Path, zero: bool) -> list[str]:
        words = fake_words(folder, "well")
        torn = (
            f"import pathlib, sys; pathlib.Path({str(folder / 'result.json')!r}).write_text('{{'); sys.exit({status})"
        )
        return [sys.executable, "-c", torn] if folder.name == Path(first.name).name else words

    sweep = Sweep([first, second], tmp_path)
    sweep.run(LocalLauncher(command), nothing, nothing)
    assert states(sweep) == [State.FAILED, State.DONE]
    assert "is damaged" in sweep.entries[0].complaint


def test_files_that_arrive_over_an_older_result_take_its_place_at_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An interruption leaves an unfinished run, no result beside tables that are not its own."""
    (tmp_path / "result.json").write_text("{}")
    (tmp_path / "eval.csv").mkdir()
    with pytest.raises(InputError):
        ray_cluster.receive(tmp_path, {"curve.csv": b"new", "eval.csv": b"new", "result.json": b"new"})
    assert not (tmp_path / "result.json").exists()


def test_a_result_stays_where_no_files_arrive(tmp_path: Path):
    """The machine has written into the folder of the sweep itself."""
    (tmp_path / "result.json").write_text("{}")
    ray_cluster.receive(tmp_path, {})
    assert (tmp_path / "result.json").exists()


def test_steps_are_read_from_files_with_sensible_numbers_alone(tmp_path: Path):
    os.mkfifo(tmp_path / "progress.csv")
    assert steps_of(tmp_path) == 0
    (tmp_path / "progress.csv").unlink()
    (tmp_path / "progress.csv").write_text(f"env_steps,x\n120,1\n-5,2\n{'9' * 400},3\n")
    assert steps_of(tmp_path) == 120


def test_a_run_that_ends_as_another_one_has_failed(tmp_path: Path):
    """It must not stay `running` for good."""
    (row,) = short_rows(1000)
    prepare(row, tmp_path / row.name)
    words = fake("well").command(tmp_path / row.name, True)
    wrong = [*words[:-1], words[-1].replace(row.config.digest(), "0" * 12)]
    sweep = Sweep([row], tmp_path)
    sweep.run(LocalLauncher(lambda folder, zero: wrong), nothing, nothing)
    assert states(sweep) == [State.FAILED]
    assert sweep.entries[0].complaint == NOT_THE_RUN


def test_why_a_run_of_a_smaller_budget_could_not_be_gone_on_with_is_told(tmp_path: Path):
    """Its result of before is finished, but not the one that is wanted."""
    (row,) = short_rows(2000)
    prepare(row, tmp_path / row.name)
    words = fake("well").command(tmp_path / row.name, True)
    smaller = json.loads(words[-1]) | {"total_steps": 1000}
    (tmp_path / row.name / "result.json").write_text(json.dumps(smaller))
    sweep = Sweep([row], tmp_path)
    sweep.run(fake("fails"), nothing, nothing)
    assert states(sweep) == [State.FAILED]
    assert sweep.entries[0].complaint == "status 1: the disk is full"


def test_a_folder_behind_a_link_is_found(tmp_path: Path):
    """Such as one on a larger disk."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "DoraCube-v1").symlink_to(tmp_path / "disk")
    sweep = Sweep(few(2), tmp_path / "out", retries=0)
    sweep.run(fake("well"), nothing, nothing)
    assert states(sweep) == [State.DONE] * 2
    assert states(Sweep(few(2), tmp_path / "out")) == [State.DONE] * 2


def test_runs_that_wait_for_a_larger_budget_are_not_looked_for_everywhere(tmp_path: Path, monkeypatch):
    """Reading all results in every turn would keep a core busy beside the training."""
    seen: list[list[Path]] = []

    def looked(folders, strict=True):
        seen.append(list(folders))
        return finished_runs(seen[-1], strict)

    monkeypatch.setattr(dora.sweeps.sweep, "finished_runs", looked)
    Sweep(short_rows(1000), tmp_path).run(fake("well"), nothing, nothing)
    sweep = Sweep(short_rows(2000), tmp_path)
    seen.clear()
    sweep.run(fake("well"), nothing, nothing)
    assert states(sweep) == [State.DONE]
    assert seen
    assert {folder for folders in seen for folder in folders} == {sweep.entries[0].folder}


def test_a_disk_that_fills_up_fails_one_run_and_not_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rows = few(3)

    def full(row, folder):
        if row is rows[1]:
            raise OSError(28, "No space left on device", str(folder))
        prepare(row, folder)

    monkeypatch.setattr(dora.sweeps.sweep, "prepare", full)
    sweep = Sweep(rows, tmp_path)
    sweep.run(fake("well"), nothing, nothing)
    assert states(sweep) == [State.DONE, State.FAILED, State.DONE]
    assert "No space left" in sweep.entries[1].complaint


def test_a_result_that_is_damaged_meanwhile_does_not_end_the_sweep(tmp_path: Path):
    rows = few(2)
    sweep = Sweep(rows, tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "result.json").write_text("{")
    sweep.run(fake("well"), nothing, nothing)
    assert states(sweep) == [State.DONE, State.DONE]


def test_the_same_seed_twice_is_one_run(tmp_path: Path):
    rows = rows_of("paper", envs=["DoraCube-v1"], agents=["ppo"], guidance=["affordance"], seeds=[10, 10])
    assert len(rows) == 1


def test_who_comes_second_waits_for_the_process_that_trains_in_a_folder(tmp_path: Path):
    (row,) = few(1)
    prepare(row, tmp_path / row.name)
    sweep = Sweep([row], tmp_path, retries=0)
    lock = os.open(tmp_path / row.name / ".lock", os.O_RDWR | os.O_CREAT)
    sweep.entries[0].state, sweep.entries[0].tries = State.RUNNING, 1
    fcntl.flock(lock, fcntl.LOCK_EX)
    sweep._note_end(row, "status 1: another process trains in it")
    assert states(sweep) == [State.ELSEWHERE]
    os.close(lock)
    sweep.run(fake("well"), nothing, nothing)
    assert states(sweep) == [State.DONE]


@pytest.mark.parametrize("evaluated", ["", ".", "zero"])
def test_a_sweep_tells_how_to_get_the_zero_correction_that_a_failed_run_owes(
    evaluated: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Of runs at the same time one evaluates it for all."""
    row, out = few(1)[0], tmp_path / "a sweep"
    result(row, out / row.name)
    if evaluated:
        (out / evaluated / row.name).mkdir(parents=True, exist_ok=True)
        (out / evaluated / row.name / "zero.csv").touch()
    monkeypatch.setattr(command, "_launcher", lambda args, sweep: fake("fails"))
    words = (
        "--env",
        "DoraCube-v1",
        "--agent",
        "ppo",
        "--guidance",
        "affordance",
        "--seeds",
        "0",
        "1",
        "--retries",
        "0",
    )
    assert call(command, monkeypatch, *words, "--out", str(out)) == command.FAILED
    told = capsys.readouterr().err
    expected = f"dora run --eval-only --checkpoint '{out / row.name}' --out '{out / 'zero' / row.name}' --episodes 500"
    assert (f"{expected} --zero-correction" in told) is not bool(evaluated)
