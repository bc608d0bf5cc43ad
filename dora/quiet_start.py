"""Ctrl-C and SIGTERM end a command with one line, also while what does its work is still being imported.

A reader of its output that goes away, as `head` does, ends it without any.
"""

import io
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import TextIO

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a command."""
GRACE = 20.0
"""Time that a command has for its end after a signal [s]."""
UNREAD = 128 + signal.SIGPIPE
"""Exit status when nobody reads what a command prints."""
UNWRITTEN = 1
"""Exit status when what a command prints cannot be written."""
_saying, _said = threading.RLock(), False
"""Held while the line about a signal is printed, in a handler that another signal may interrupt; whether it was."""


def _end(number: int, frame: object) -> None:
    os.write(2, b"Interrupted: ending at once, nothing was begun.\n")
    os._exit(128 + number)


def _interrupt(number: int, frame: object) -> None:
    _say()
    raise KeyboardInterrupt


def _terminate(number: int, frame: object) -> None:
    _say()
    raise SystemExit(128 + number)


def _say() -> None:
    """Tell of the first signal, whichever thread comes to it first; the line stands there when this returns."""
    global _said
    with _saying:
        if not _said:
            os.write(2, b"Interrupted.\n")
            _said = True


def begin() -> None:
    """Lets the signals end this process at once, with a line and without a traceback, until `call`."""
    for number in SIGNALS:
        signal.signal(number, _end)


def call(main: Callable[[], int]) -> int:
    """Exit status of a command: Ctrl-C raises `KeyboardInterrupt` in it, SIGTERM ends it, neither shows a traceback.

    A line says so at once, also during a call of native code, which delays all that Python does after a signal. A
    command that has not ended `GRACE` later, because that call takes so long, is ended without it.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    threading.Thread(target=_watch, args=(reading,), name="signals", daemon=True).start()
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _terminate)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)  # it gets the number of a signal when that arrives
    try:
        return main()
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    finally:
        for number in SIGNALS:  # the command is done, the interpreter only cleans up
            signal.signal(number, signal.SIG_IGN)


def _watch(reading: int) -> None:
    """In a thread: answers the first signal that the command leaves to this module."""
    while number := os.read(reading, 1):
        if number[0] in SIGNALS and signal.getsignal(number[0]) in (_interrupt, _terminate):
            _say()
            time.sleep(GRACE)
            os._exit(128 + number[0])


def show_any_script() -> None:
    """Let standard output and error print names in any script: letters that they lack are shown as escapes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def printing(main: Callable[[], int]) -> int:
    """Exit status of a command that prints; without a traceback where nobody reads it any more, where the disk is full
    to which it goes, or where a terminal lacks letters, which are shown as escapes."""
    show_any_script()
    try:
        try:
            return main()
        finally:
            if sys.stdout is not None:  # as after >&-
                sys.stdout.flush()
    except BrokenPipeError:
        if sys.stdout is None or _is_read(sys.stdout):
            raise  # another pipe has broken
        _discard(sys.stdout)
        return UNREAD
    except OSError as error:
        if sys.stdout is None or _is_written(sys.stdout):
            raise  # something else could not be written
        _discard(sys.stdout)
        os.write(2, f"What is printed cannot be written ({error.strerror}): make room, or print elsewhere.\n".encode())
        return UNWRITTEN


def _discard(output: TextIO) -> None:
    """Forget what is left to print."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())


def _is_written(output: TextIO) -> bool:
    """Whether what was printed has arrived, and one more line does."""
    try:
        output.flush()
        os.write(output.fileno(), b"\n")
    except OSError:
        return False
    return True


def _is_read(output: TextIO) -> bool:
    """Whether what is written there still has a reader."""
    state = select.poll()
    state.register(output.fileno(), 0)
    return not any(event & (select.POLLERR | select.POLLHUP) for _, event in state.poll(0))
