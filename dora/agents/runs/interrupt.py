"""Ctrl-C and SIGTERM: at once while nothing is begun, otherwise as a request that the training loop checks."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

from dora.parallel import remove_own

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that ask a run to end."""
STATUS = 128
"""Exit status of a process that a signal ended, less the signal's number."""
IMPATIENT = 1.0
"""Time after which a second signal ends at once [s]; some senders repeat the first one immediately."""
SAVING = "Interrupted: saving, then ending within seconds (a second time: ending at once)."
"""What is said when a run is asked to end."""
NOTHING = "Interrupted: ending at once, nothing had to be saved."
"""What is said while a run is being prepared or its end reported."""


class Interrupt:
    """Turns the first signal into a request and the second into `KeyboardInterrupt`; a context manager.

    Attributes:
        number: of the signal, None before.
        at_once: whether there was a second one, which may have come at any place of the program.
        closing: set when nothing is left but to write the result, which no further signal prevents.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.at_once = self.closing = False
        self._since, self._before = 0.0, {}

    @property
    def requested(self) -> bool:
        """Whether there was a signal."""
        return self.number is not None

    def __enter__(self) -> "Interrupt":
        self._before = {number: signal.signal(number, self._handle) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        _restore(self._before)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number, self._since = number, time.monotonic()
            _say(SAVING)
        elif time.monotonic() - self._since > IMPATIENT and not self.closing:
            self.at_once = True
            raise KeyboardInterrupt

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if there was a signal."""
        if self.requested:
            raise KeyboardInterrupt


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Signals end this process with one line and their exit status, unless an `Interrupt` is in force."""
    before = {number: signal.signal(number, _end) for number in SIGNALS}
    try:
        yield
    finally:
        _restore(before)


def _end(number: int, frame: FrameType | None) -> NoReturn:
    _say(NOTHING)
    remove_own()
    os._exit(STATUS + number)


def _say(text: str) -> None:
    with suppress(OSError):
        os.write(2, f"{text}\n".encode())


def _restore(before: dict[Any, Any]) -> None:
    for number, handler in before.items():
        signal.signal(number, handler)
