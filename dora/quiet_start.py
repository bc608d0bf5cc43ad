"""Ctrl-C and SIGTERM end a command with one line, also while what does its work is still being imported."""

import os
import signal
from collections.abc import Callable

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a command."""


def _end(number: int, frame: object) -> None:
    os.write(2, b"Interrupted: ending at once, nothing was begun.\n")
    os._exit(128 + number)


def _terminate(number: int, frame: object) -> None:
    os.write(2, b"Interrupted.\n")
    raise SystemExit(128 + number)


def begin() -> None:
    """Lets the signals end this process at once, with a line and without a traceback, until `call`."""
    for number in SIGNALS:
        signal.signal(number, _end)


def call(main: Callable[[], int]) -> int:
    """Exit status of a command: Ctrl-C raises in it as usual, SIGTERM ends it, and neither shows a traceback."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminate)
    try:
        return main()
    except KeyboardInterrupt:
        os.write(2, b"Interrupted.\n")
        return 128 + signal.SIGINT
    finally:
        for number in SIGNALS:  # the command is done, the interpreter only cleans up
            signal.signal(number, signal.SIG_IGN)
