"""Ctrl-C and SIGTERM end a command with one line, also while what does its work is still being imported.

A reader of its output that goes away, as `head` does, ends it without any.
"""

import os
import select
import signal
import sys
from collections.abc import Callable
from typing import TextIO

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a command."""
UNREAD = 128 + signal.SIGPIPE
"""Exit status when nobody reads what a command prints."""


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


def printing(main: Callable[[], int]) -> int:
    """Exit status of a command that prints; without a traceback where nobody reads it any more."""
    try:
        try:
            return main()
        finally:
            if sys.stdout is not None:  # as after >&-
                sys.stdout.flush()
    except BrokenPipeError:
        if sys.stdout is None or _is_read(sys.stdout):
            raise  # another pipe has broken
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is left to print
        return UNREAD


def _is_read(output: TextIO) -> bool:
    """Whether what is written there still has a reader."""
    state = select.poll()
    state.register(output.fileno(), 0)
    return not any(event & (select.POLLERR | select.POLLHUP) for _, event in state.poll(0))
