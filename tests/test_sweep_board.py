"""What a sweep shows: the time that is left, a line at every change, and a table on a terminal."""

import io
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_sweep import few
from rich.console import Console

from dora.sweeps import board as boards
from dora.sweeps.board import HEADINGS, LINE_SECONDS, Board, cells, duration
from dora.sweeps.sweep import Entry, State, Sweep

BUDGET = 300_000
"""Environment steps of the runs of `few`."""


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A clock that stands where a test puts it."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(boards, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0, "0 min"), (600.0, "10 min"), (5399.0, "90 min"), (5400.0, "1.5 h"), (5430.0, "1.5 h"), (10_800.0, "3.0 h")],
)
def test_a_time_is_said_in_minutes_up_to_an_hour_and_a_half(seconds: float, words: str):
    assert duration(seconds) == words


def test_a_row_of_the_table_says_what_is_known_of_a_run(tmp_path: Path):
    (row,) = few(1)
    start = ["Table II", "DoraCube-v1/ppo-affordance-s0"]
    entry = Entry(row, tmp_path / "run", rate=0.01)
    assert cells(entry) == [*start, "waiting", "0/300,000", "", ""]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "progress.csv").write_text("env_steps,seconds\n60000,1\n")
    for state in (State.RUNNING, State.ELSEWHERE):
        entry.state = state  # 240,000 steps of a hundredth of a second
        assert cells(entry) == [*start, state.value, "60,000/300,000", "", "40 min left"]
    entry.state, entry.success_rate, entry.seconds, entry.taken = State.DONE, 0.5, 600.0, 1234
    assert cells(entry) == [*start, "done", "1,234/300,000", "0.500", "10"]


def test_of_a_run_that_was_trained_beyond_its_budget_no_time_is_left(tmp_path: Path):
    (row,) = few(1)
    (tmp_path / "progress.csv").write_text(f"env_steps\n{BUDGET + 64}\n")
    entry = Entry(row, tmp_path, rate=0.01)
    assert entry.seconds_left == 0
    (tmp_path / "progress.csv").write_text(f"env_steps\n{BUDGET - 100}\n")
    assert entry.seconds_left == pytest.approx(1.0)
    entry.state = State.FAILED
    assert entry.seconds_left == 0


def test_the_time_that_is_left_is_shared_by_runs_at_the_same_time_but_not_below_that_of_the_longest(tmp_path: Path):
    sweep = Sweep(few(3), tmp_path, jobs=2)
    for entry, seconds in zip(sweep.entries, (1000, 100, 100), strict=True):
        entry.rate = seconds / BUDGET
    assert sweep.seconds_left == pytest.approx(1000)
    sweep.entries[1].rate = 1000 / BUDGET
    assert sweep.seconds_left == pytest.approx(1050)
    sweep.jobs = 0  # as many as a cluster that is not asked yet has room for
    assert sweep.seconds_left == pytest.approx(2100)
    assert Sweep([], tmp_path).seconds_left == 0


def test_without_a_terminal_a_line_is_written_at_every_change_and_once_a_minute(tmp_path: Path, clock: SimpleNamespace):
    sweep, said = Sweep(few(3), tmp_path), io.StringIO()
    _, second, third = (entry.row.name for entry in sweep.entries)
    sweep.entries[0].state = State.DONE  # of an earlier sweep: no news
    sweep.entries[1].state = State.RUNNING

    def lines() -> list[str]:
        found = said.getvalue().splitlines()
        said.seek(0)
        said.truncate()
        return found

    with Board(Console(file=said, width=40)) as board:
        board(sweep)
        (line,) = lines()
        assert line.startswith("1 of 3 runs done, 1 running, 1 waiting; about ")
        assert line.endswith(f" left ({second} 0/300,000)")
        clock.now += LINE_SECONDS - 1
        board(sweep)
        assert lines() == []
        sweep.entries[1].state, sweep.entries[1].success_rate = State.DONE, 0.25
        sweep.entries[2].state, sweep.entries[2].complaint = State.FAILED, "[bold]no[/bold]"
        board(sweep)
        assert lines() == [f"{second}: done, success 0.250", f"{third}: failed ([bold]no[/bold])"]
        clock.now += 1
        board(sweep)
        assert lines() == ["2 of 3 runs done, 0 running, 0 waiting, 1 failed; about 0 min left"]
    assert lines() == [], "there is no table to remove"


def test_a_sweep_is_shown_among_errors_where_the_last_line_printed_is_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with Board() as board:
        board(Sweep(few(1), tmp_path))
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("0 of 1 runs done, 0 running, 1 waiting; about ")


def test_on_a_terminal_a_table_is_shown_that_is_gone_at_the_end(tmp_path: Path, clock: SimpleNamespace):
    sweep, said = Sweep(few(1), tmp_path), io.StringIO()
    terminal = Console(file=said, width=120, height=50, force_terminal=True, color_system="truecolor", _environ={})
    threads = threading.active_count()
    with Board(terminal) as board:
        assert threading.active_count() == threads, "it is drawn when it is told to"
        board(sweep)
        assert all(name in said.getvalue() for name in HEADINGS)
        assert "0 of 1 runs done, 0 running, 1 waiting; about" in said.getvalue()
        sweep.entries[0].state, sweep.entries[0].complaint = State.FAILED, "[red] 12 of 13"
        board(sweep)
        assert f"{sweep.entries[0].row.name}: failed ([red] 12 of 13)\n" in said.getvalue()
    assert "\x1b[2K" in said.getvalue()[said.getvalue().rindex("left") :]


def test_the_table_of_a_terminal_has_the_nearest_runs_before_and_after_those_that_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shown = 2
    monkeypatch.setattr(boards, "SHOWN", shown)
    rows = few(2 * shown + 7)
    sweep = Sweep(rows, tmp_path)
    states = [State.DONE] * (shown + 3) + [State.FAILED, State.RUNNING] + [State.WAITING] * (shown + 2)
    for entry, state in zip(sweep.entries, states, strict=True):
        entry.state = state
    assert list(boards._table(sweep).columns[1].cells) == [str(row.name) for row in rows[3:-2]]
