"""What a sweep shows: a live table on a terminal, a line at every change otherwise."""

import time
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from dora.sweeps.launching import LOG
from dora.sweeps.sweep import Entry, State, Sweep
from dora.tables import text_table

HEADINGS = ("part", "run", "state", "steps", "success", "minutes")
"""Columns of the table."""
LINE_SECONDS = 60.0
"""Time between two lines about progress where there is no terminal [s]."""
SHOWN = 6
"""Number of finished runs, and of waiting ones, that the live table shows."""


def duration(seconds: float) -> str:
    """A time as people say it."""
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def cells(entry: Entry) -> list[str]:
    """Cells under `HEADINGS`."""
    config = entry.row.config
    success = "" if entry.success_rate is None else f"{entry.success_rate:.3f}"
    minutes = f"{entry.seconds / 60:.0f}" if entry.seconds is not None else ""
    if entry.state in (State.RUNNING, State.ELSEWHERE):
        minutes = f"{duration(entry.seconds_left)} left"
    return [
        entry.row.title, str(entry.row.name), entry.state.value, f"{entry.env_steps:,}/{config.total_steps:,}",
        success, minutes,
    ]  # fmt: skip


def summary(sweep: Sweep) -> str:
    """How all of it stands, in one line."""
    total, done, failed = len(sweep.entries), sweep.count(State.DONE), sweep.count(State.FAILED)
    running = sweep.count(State.RUNNING) + sweep.count(State.ELSEWHERE)
    text = f"{done} of {total} runs done, {running} running, {sweep.count(State.WAITING)} waiting"
    return text + (f", {failed} failed" if failed else "") + f"; about {duration(sweep.seconds_left)} left"


def print_all(sweep: Sweep) -> None:
    """Print every run."""
    print(text_table(HEADINGS, [cells(entry) for entry in sweep.entries]))


class Board:
    """Shows a sweep while it goes on; a context manager whose value is called with the sweep now and then."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._states: dict[int, State] = {}
        self._next_line = 0.0

    def __enter__(self) -> "Board":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def __call__(self, sweep: Sweep) -> None:
        """Show how it stands."""
        for index, entry in enumerate(sweep.entries):
            before = self._states.get(index)
            if before is not entry.state and (before is not None or entry.state is State.FAILED):
                self._say(f"{entry.row.name}: {_news(entry)}")
            self._states[index] = entry.state
        if self._console.is_terminal:
            self._live.update(Group(_table(sweep), Text(summary(sweep))), refresh=True)
        elif time.monotonic() >= self._next_line:
            self._next_line = time.monotonic() + LINE_SECONDS
            running = [e for e in sweep.entries if e.state is State.RUNNING]
            at = "; ".join(f"{e.row.name} {e.env_steps:,}/{e.row.config.total_steps:,}" for e in running)
            self._say(summary(sweep) + (f" ({at})" if at else ""))

    def _say(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def _news(entry: Entry) -> str:
    """What has become of a run, in a few words."""
    if entry.state is State.DONE:
        return f"done, success {entry.success_rate:.3f}"
    if entry.state is State.RUNNING:
        return "goes on" if entry.env_steps else "begins"
    if entry.state is State.FAILED:
        printed = entry.folder / LOG
        return f"failed ({entry.complaint})" + (f"; what it printed is in {printed}" if printed.is_file() else "")
    return f"will be tried again ({entry.complaint})" if entry.complaint else entry.state.value


def _table(sweep: Sweep) -> Table:
    """The runs that go on or failed, and the nearest ones before and after them."""
    table = Table()
    for name in HEADINGS:
        table.add_column(name, overflow="fold")
    done = [e for e in sweep.entries if e.state is State.DONE][-SHOWN:]
    waiting = [e for e in sweep.entries if e.state is State.WAITING][:SHOWN]
    others = [e for e in sweep.entries if e.state not in (State.DONE, State.WAITING)]
    for entry in (*done, *others, *waiting):
        table.add_row(*cells(entry))
    return table
