"""Worker processes: results in order, errors that reach the caller, and no process left behind."""

import inspect
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dora.errors import FAILED, WorkerFailure, command
from dora.parallel import DIED, WorkerPool, run_cases

CASES = list(range(11))


def make_square(offset: int) -> Callable[[int], tuple[int, int]]:
    """A task that squares, and names its process."""
    return lambda case: (case * case + offset, os.getpid())


def make_deadly() -> Callable[[int], int]:
    """A task that ends its process."""
    return lambda case: os._exit(3)


def make_reading(variable: str) -> Callable[[int], str | None]:
    """A task that tells a variable of the environment."""
    return lambda case: os.environ.get(variable)


def make_counting() -> Callable[[int], int]:
    """A task that tells the number of threads."""
    return lambda case: torch.get_num_threads()


def test_processes_have_the_environment_of_when_they_start(monkeypatch: pytest.MonkeyPatch):
    """Their server has that of when it started."""
    for value in ("a", "b", None):
        monkeypatch.setenv("DORA_TEST", value) if value else monkeypatch.delenv("DORA_TEST")
        with WorkerPool(make_reading, ("DORA_TEST",), 1) as pool:
            assert pool.map([0]) == [value]


@pytest.mark.parametrize("processes", [1, 2, 3])
def test_results_come_in_the_order_of_the_cases_whoever_does_them(processes: int):
    told = []
    found = run_cases(make_square, (7,), CASES, processes, lambda *state: told.append(state), chunk=2)
    assert [value for value, _ in found] == [case * case + 7 for case in CASES]
    assert told[-1] == (len(CASES), len(CASES))
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert len({process for _, process in found}) <= processes
    assert (os.getpid() in {process for _, process in found}) == (processes == 1)


@pytest.mark.parametrize("processes", [1, 2])
def test_cases_are_done_on_one_thread_wherever_they_are_done(processes: int):
    """Products of matrices are rounded by the number of threads, and chaos makes of that another result."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert run_cases(make_counting, (), CASES, processes) == [1] * len(CASES)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_this_process_does_its_share_and_the_others_keep_their_task():
    with WorkerPool(make_square, (0,), 1) as pool:
        for _ in range(2):
            found = pool.map(CASES, make_square(0))
            assert [value for value, _ in found] == [case * case for case in CASES]
            assert [process == os.getpid() for _, process in found] == [case % 2 == 0 for case in CASES]


def test_a_process_that_dies_is_told_in_one_sentence():
    with pytest.raises(RuntimeError, match="A worker process died"):
        run_cases(make_deadly, (), CASES, processes=2)


def make_endless() -> Callable[[int], None]:
    """A task that does not end."""
    return lambda case: time.sleep(1000)


def test_processes_that_hang_are_ended_and_told_of():
    start = time.monotonic()
    with pytest.raises(WorkerFailure, match=r"The worker processes hang: none has finished anything for 1 s\."):
        run_cases(make_endless, (), CASES, processes=2, patience=1.0)
    assert time.monotonic() - start < 30
    assert math.isfinite(inspect.signature(run_cases).parameters["patience"].default)


@command
def work() -> None:
    """A command whose workers die."""
    run_cases(make_deadly, (), CASES, processes=2)


def test_a_command_whose_workers_die_says_so_in_one_line(capfd: pytest.CaptureFixture[str]):
    assert work() == FAILED
    assert capfd.readouterr().err == f"{DIED}\n"


SCRIPT = """
import time
from dora.parallel import run_cases

def make():
    def task(seconds):
        print("busy", flush=True)
        time.sleep(seconds)
    return task

if __name__ == "__main__":
    run_cases(make, (), [100.0] * 6, processes=2, chunk=1)
"""


@pytest.mark.parametrize("kill", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_workers_end_with_the_process_that_started_them(tmp_path: Path, kill: signal.Signals):
    (tmp_path / "script.py").write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "script.py")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    assert process.stdout is not None
    assert [process.stdout.readline() for _ in range(2)] == ["busy\n"] * 2
    if kill is signal.SIGINT:
        os.killpg(process.pid, kill)  # as a terminal does
    else:
        process.kill()
    started = time.monotonic()
    _, errors = process.communicate(timeout=20)  # until all who write there have ended
    assert time.monotonic() - started < 5
    assert process.returncode == -kill
    assert errors.count("Traceback") == (kill is signal.SIGINT), errors
