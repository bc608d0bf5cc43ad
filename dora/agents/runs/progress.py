"""What a run shows while it goes on: a bar on a terminal, plain lines elsewhere."""

import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

LINE_SECONDS = 10.0
"""Time between two plain lines of progress [s]."""


class ProgressReport:
    """Progress towards `total` environment steps, with steps/s, success and time left; a context manager."""

    def __init__(self, total: int, console: Console | None = None):
        self.total = total
        self.console = console or Console(stderr=True)
        self._next_line = 0.0
        self._bar = Progress(
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[status]}"),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        self._task = self._bar.add_task("steps", total=total, status="starting")

    def __enter__(self) -> "ProgressReport":
        self._bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.stop()

    def update(self, steps: int, rate: float, training: float | None, evaluated: float | None) -> None:
        """Show the number of steps so far, steps/s and the success rates in training and evaluation."""
        status = f"{steps:,} steps  {rate:,.0f} steps/s  success {_rate(training)} (evaluated {_rate(evaluated)})"
        self._bar.update(self._task, completed=steps, status=status)
        now = time.monotonic()
        if not self.console.is_terminal and now >= self._next_line:
            self._next_line = now + LINE_SECONDS
            left = max(0, self.total - steps) / rate if rate > 0 else 0.0
            self.say(f"{status}  ETA {left:.0f} s")

    def say(self, text: str) -> None:
        """Print one line above the bar."""
        self.console.print(text, highlight=False, soft_wrap=True)


def _rate(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
