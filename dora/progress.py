"""Progress of a long command: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

LINE_SECONDS = 10.0
"""Time between two plain lines [s]."""
SILENT_SECONDS = 5.0
"""Time after which something that is mostly quick begins to tell how far it is [s]."""


class ProgressDisplay:
    """Bars with status and time left, one for each thing that is being done; a context manager.

    Args:
        console: where to draw (default: standard error).
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self._next_line = 0.0
        self._bars = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[status]}", markup=False),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
        )

    def __enter__(self) -> ProgressDisplay:
        self._bars.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bars.stop()

    def bar(self, name: str) -> Callable[[int, int, float, str], None]:
        """A new bar; returns what is to be called with (done, total, done per second, status) now and then."""
        task = self._bars.add_task(name, total=None, status="")

        def update(done: int, total: int, rate: float, status: str) -> None:
            self._bars.update(task, completed=done, total=total, status=status)
            now = time.monotonic()
            if not self.console.is_terminal and now >= self._next_line:
                self._next_line = now + LINE_SECONDS
                left = f"{max(total - done, 0) / rate:.0f} s" if rate > 0 else "unknown"
                self.say(f"{name}: {done:,}/{total:,}, {status}, ETA {left}")

        return update

    def phase(self, name: str, unit: str, scale: float = 1.0) -> Callable[[int, int], None]:
        """A new bar whose status is the rate since now; returns what is to be called with (done, total) now and then.

        Args:
            name: what is being done.
            unit: what is counted, in the plural.
            scale: units per step of `done`.
        """
        update, start = self.bar(name), time.monotonic()

        def report(done: int, total: int) -> None:
            rate = done / max(time.monotonic() - start, 1e-9)
            update(done, total, rate, f"{scale * rate:,.3g} {unit}/s")

        return report

    def say(self, text: str) -> None:
        """Print one line above the bars."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)


def slow_phase(name: str, unit: str) -> Callable[[int, int], None]:
    """Plain lines about something that is mostly quick, from the time on when it is not; beside bars of others, too.

    Args:
        name: what is being done.
        unit: what is counted, in the plural.

    Returns:
        What is to be called with (done, total) now and then.
    """
    report = ProgressDisplay(Console(stderr=True, force_terminal=False)).phase(name, unit)
    start = time.monotonic()
    return lambda done, total: report(done, total) if time.monotonic() - start > SILENT_SECONDS else None
