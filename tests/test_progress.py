"""What a command shows while it works: plain lines, not too many of them, where there is no terminal."""

import io

import pytest
from rich.console import Console

from dora import progress
from dora.progress import ProgressDisplay, slow_phase


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Its last entry is the time [s]."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[-1])
    return now


def test_without_a_terminal_there_is_a_line_every_ten_seconds(clock: list[float]):
    text = io.StringIO()
    with ProgressDisplay(Console(file=text)) as display:
        report = display.phase("search", "candidates", scale=0.5)
        for seconds, done in ((2.0, 10), (8.0, 40), (11.0, 55)):
            clock.append(100.0 + seconds)
            report(done, 120)
        show = display.bar("training")
        for seconds in (11.9, 12.0, 21.9):
            clock.append(100.0 + seconds)
            show(1000, 4000, 500.0, "500 steps/s")
        display.say("done")
    assert text.getvalue().splitlines() == [
        "search: 10/120, 2.5 candidates/s, ETA 22 s",
        "training: 1,000/4,000, 500 steps/s, ETA 6 s",
        "done",
    ]


def test_on_a_terminal_there_is_a_bar_instead():
    text = io.StringIO()
    with ProgressDisplay(Console(file=text, force_terminal=True, width=100)) as display:
        display.phase("search", "candidates")(120, 120)
    assert "search" in text.getvalue()
    assert "100%" in text.getvalue()
    assert "120/120" not in text.getvalue()


def test_what_is_quick_is_not_told(clock: list[float], capsys: pytest.CaptureFixture[str]):
    report = slow_phase("a table", "places")
    for seconds, done in ((0.1, 10), (4.9, 40), (6.0, 60), (7.0, 70), (16.5, 90)):
        clock.append(100.0 + seconds)
        report(done, 100)
    assert capsys.readouterr().err.splitlines() == [
        "a table: 60/100, 10 places/s, ETA 4 s",
        "a table: 90/100, 5.45 places/s, ETA 2 s",
    ]


def test_what_is_slow_is_told_beside_a_bar_of_something_else(clock: list[float], capsys: pytest.CaptureFixture[str]):
    with ProgressDisplay(Console(file=io.StringIO(), force_terminal=True)):
        report = slow_phase("a table", "places")
        clock.append(106.0)
        report(60, 100)
    assert "a table: 60/100" in capsys.readouterr().err
