"""Signals while a command is at something long: a line comes at once, and the end soon."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

import dora

GRACE = 1.5
"""Time for the end in these tests [s]."""
COMMAND = f"""
import ctypes, sys, time
import quiet_start

quiet_start.GRACE = {GRACE}

def native():
    library, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(64)
    library.pthread_mutex_lock(mutex)
    library.pthread_mutex_lock(mutex)  # waits for good, whatever signals come

def cleaning():
    try:
        time.sleep(60)
    finally:
        print("begun", file=sys.stderr, flush=True)
        time.sleep(0.5)
        print("cleaned", file=sys.stderr, flush=True)

def endless():
    try:
        time.sleep(60)
    finally:
        time.sleep(60)

def quick():
    time.sleep(60)

def own():
    import signal
    def save(number, frame):
        print("saving", file=sys.stderr, flush=True)
        time.sleep({GRACE} + 0.5)
        sys.exit(3)
    signal.signal(signal.SIGINT, save)
    signal.signal(signal.SIGTERM, save)
    print("ready", flush=True)
    time.sleep(60)

print("ready", flush=True)
quiet_start.begin()
sys.exit(quiet_start.call({{name}}))
"""


def ended(name: str, number: int) -> tuple[float, float, int, list[str]]:
    """Seconds to the first line after a signal and to the end, exit status, and all lines."""
    words = [sys.executable, "-c", COMMAND.format(name=name)]
    place = os.environ | {"PYTHONPATH": os.path.dirname(dora.__file__)}  # the module alone, which is imported quickly
    process = subprocess.Popen(words, env=place, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    limit = threading.Timer(20.0, process.kill)
    limit.start()
    assert process.stdout is not None
    assert process.stderr is not None
    for _ in range(2 if name == "own" else 1):
        process.stdout.readline()
    time.sleep(0.3)
    sent = time.monotonic()
    process.send_signal(number)
    lines = [process.stderr.readline().strip()]
    first = time.monotonic() - sent
    lines += process.stderr.read().split("\n")
    limit.cancel()
    return first, time.monotonic() - sent, process.wait(), [line for line in lines if line]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("name", "lines", "longest"),
    [
        ("quick", ["Interrupted."], 1.2),
        ("native", ["Interrupted."], GRACE + 1),
        ("endless", ["Interrupted."], GRACE + 1),
        ("cleaning", ["Interrupted.", "begun", "cleaned"], GRACE),
    ],
)
def test_a_line_comes_at_once_and_the_end_soon(name: str, lines: list[str], longest: float, number: int):
    first, end, status, said = ended(name, number)
    assert said == lines
    assert status == 128 + number
    assert first < 1.0
    assert end < longest


def test_a_command_that_answers_signals_itself_is_left_alone():
    _, end, status, said = ended("own", signal.SIGINT)
    assert (said, status) == (["saving"], 3)
    assert end > GRACE
