"""What a long command shows while it works: a bar per phase on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

LINE_SECONDS = 10.0
"""Time between two plain lines [s]."""


class PhaseProgress:
    """Progress of the phases of a command, each with its rate and the time left; a context manager.

    Args:
        console: where to draw (default: standard error).
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self._next_line = 0.0
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
        )

    def __enter__(self) -> PhaseProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.stop()

    def phase(self, name: str, unit: str, scale: float = 1.0) -> Callable[[int, int], None]:
        """A new bar; returns what is to be called with (done, total) now and then.

        Args:
            name: what is being done.
            unit: what is counted, in the plural.
            scale: units per step of `done`.
        """
        task = self._bar.add_task(name, total=None, rate="")
        start = time.monotonic()

        def update(done: int, total: int) -> None:
            rate = done / max(time.monotonic() - start, 1e-9)
            text = f"{scale * rate:,.3g} {unit}/s"
            self._bar.update(task, completed=done, total=total, rate=text)
            left = f"{(total - done) / rate:.0f} s" if rate > 0 else "unknown"
            self._line(f"{name}: {done}/{total}, {text}, ETA {left}")

        return update

    def _line(self, text: str) -> None:
        now = time.monotonic()
        if not self.console.is_terminal and now >= self._next_line:
            self._next_line = now + LINE_SECONDS
            self.console.print(text, highlight=False, soft_wrap=True)
