"""Which runs of a folder are finished, how long others will take, and what a run's folder tells of it."""

import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from fake_sweep import few, result

from dora.errors import InputError
from dora.sweeps.finished import EXPECTED, UNKNOWN, Finished, finished_runs, result_of, seconds_per_step
from dora.sweeps.launching import DIGITS, LOG, TAIL, LocalLauncher, last_words, steps_of
from dora.sweeps.plan import Row


def finished(env: str, agent: str, seconds: float) -> Finished:
    """A finished run of a thousand steps."""
    return Finished(Path("run"), env, agent, "digest", 1000, 1000, seconds, 0.5)


def test_the_time_of_a_step_is_that_of_the_task_and_learner_or_of_the_task_or_a_guess():
    (row,) = few(1)
    found = [finished("DoraCube-v1", "ppo", 100.0), finished("DoraCube-v1", "ppo", 300.0),
             finished("DoraCube-v1", "sac", 800.0), finished("DoraJug-v1", "ppo", 5000.0)]  # fmt: skip

    def seconds(of: list[Finished], **change: str) -> float:
        return seconds_per_step(Row("", replace(row.config, **change)), of)

    assert seconds(found) == pytest.approx(0.2)
    assert seconds(found, agent="sac") == pytest.approx(0.8)
    assert seconds(found, agent="happo") == pytest.approx(0.4)
    assert seconds(found, env="DoraHammer-v1") == EXPECTED["DoraHammer-v1"]
    assert seconds(found, env="Mine-v1") == UNKNOWN
    assert seconds([]) == EXPECTED["DoraCube-v1"]


def test_a_result_counts_once_and_a_damaged_one_is_refused_unless_that_is_not_wanted(tmp_path: Path):
    first, second = few(2)
    result(first, tmp_path / "a" / "first", env_steps=500)
    result(second, tmp_path / "a" / "second", total_steps=None)
    content = (tmp_path / "a" / "second" / "result.json").read_text().replace('"total_steps": null, ', "")
    (tmp_path / "a" / "second" / "result.json").write_text(content)
    found = finished_runs([tmp_path / "a", tmp_path])
    assert [(one.folder.name, one.budget, one.env_steps) for one in found] == [
        ("first", first.config.total_steps, 500), ("second", second.config.total_steps, second.config.total_steps)
    ]  # fmt: skip
    assert result_of(first, found) == found[0]
    assert result_of(second, found) == found[1]
    assert result_of(first, found[1:]) is None
    (tmp_path / "a" / "first" / "result.json").write_text("{")
    assert finished_runs([tmp_path], strict=False) == found[1:]
    with pytest.raises(InputError, match=r"first/result\.json"):
        finished_runs([tmp_path])


@pytest.mark.parametrize(
    ("table", "steps"),
    [
        ("env_steps,seconds\n120,1\n240,2\n360", 240),  # it is being written
        ("120,1\n", 120),
        (f"120,1\n{'9' * DIGITS},2\n", 10**DIGITS - 1),
        (f"120,1\n{'9' * (DIGITS + 1)},2\n", 120),
        ("120,1\n\u0663\u0660,2\n\u00b2,3\n", 120),  # digits of other scripts
        ("env_steps,seconds\n" + "12345678,1\n" * TAIL + "87654321,2\n", 87_654_321),
        ("1,1\n" + "x" * TAIL, 0),
        ("env_steps,seconds\n", 0),
        ("", 0),
    ],
)
def test_the_steps_of_a_run_are_those_of_the_last_whole_row(tmp_path: Path, table: str, steps: int):
    (tmp_path / "progress.csv").write_text(table)
    assert steps_of(tmp_path) == steps


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (None, "it printed nothing"),
        ("", "it printed nothing"),
        (" \n\n", "it printed nothing"),
        ("x\n", "x"),
        ("first\n  second \n \n", "second"),
        ("first\n" * TAIL + "the last one\n", "the last one"),
    ],
)
def test_the_last_words_of_a_run_are_its_last_line_with_any(tmp_path: Path, log: str | None, words: str):
    if log is not None:
        (tmp_path / LOG).write_text(log)
    assert last_words(tmp_path) == words


def test_a_run_has_a_session_of_its_own_so_that_ctrl_c_does_not_reach_it_twice(tmp_path: Path):
    (row,) = few(1)
    words = [sys.executable, "-S", "-c", "import os; print(os.getsid(0) == os.getpid())"]
    launcher = LocalLauncher(lambda folder, zero: words)
    assert launcher.ended() == []
    launcher.start(row, tmp_path, True)
    ended, deadline = launcher.ended(), time.monotonic() + 20
    while not ended and time.monotonic() < deadline:
        time.sleep(0.01)
        ended = launcher.ended()
    assert ended == [(row, "status 0: True")], "it has left no result"
    assert launcher.ended() == []
