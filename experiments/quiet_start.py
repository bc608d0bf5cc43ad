"""Importing this lets Ctrl-C and SIGTERM end a command with one line, also while all else is still being imported."""

import os
import signal
from collections.abc import Callable

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def _end(number: int, frame: object) -> None:
    os.write(2, b"Interrupted: ending at once, nothing was begun.\n")
    os._exit(128 + number)


def _terminate(number: int, frame: object) -> None:
    os.write(2, b"Interrupted.\n")
    raise SystemExit(128 + number)


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


for _number in SIGNALS:
    signal.signal(_number, _end)
