"""Interrupts real training runs at chosen moments, and tells how they end and whether they go on.

    python -m dora.commands.interruptions --moments 1 5 20 --signal TERM
    python -m dora.commands.interruptions --moments 2 12 30 --signal KILL --group --training

Prints one line per moment: seconds to the first line after the signal, seconds to the end, exit status, steps in the
checkpoint, names left among shared memory and temporary files at the end and after the run was resumed, and what is
wrong. Exit status 1 if anything is.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from dora.agents.checkpoint import read_checkpoint
from dora.agents.runs.run_folder import RunFolder
from dora.parallel import SHARED

FIRST_LINE = 2.0
"""Time within which a run says that it was interrupted [s]."""
END = 20.0
"""Time within which it ends [s]."""
SHORT = (
    *("--num-envs", "16", "--workers", "1", "--total-steps", "3000", "--eval-every", "1500"),
    *("--eval-episodes", "16", "--eval-envs", "16", "--episodes", "32", "--checkpoint-seconds", "2"),
)
"""Options of a short run: start-up, training, an evaluation, training, the last evaluation."""


@dataclass(frozen=True)
class Outcome:
    """How an interrupted run ended. Times are since the signal [s]; `line` is None if nothing was said.

    problems: what is wrong, in words; left: names that the run left behind.
    """

    moment: float
    line: float | None
    end: float
    status: int
    steps: int | None
    left: frozenset[str] = frozenset()
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        said = "-" if self.line is None else f"{self.line:.1f} s"
        wrong = "; ".join(self.problems) or "good"
        return (
            f"{self.moment:.1f} s: line {said}, end {self.end:.1f} s, status {self.status}, steps {self.steps}, "
            f"left {len(self.left)}: {wrong}"
        )


def left_behind(process: int) -> frozenset[str]:
    """Names in the shared memory and among temporary files that hold the number of a process that made them."""
    places = (SHARED, Path(tempfile.gettempdir()))
    return frozenset(str(path) for place in places for path in place.glob(f"*[-_]{process}[-_]*"))


def nameless() -> frozenset[str]:
    """Semaphores of Python programs whose names do not say which process made them: nobody can ever remove them."""
    return frozenset(str(path) for path in SHARED.glob("sem.mp-*") if not path.name.startswith("sem.mp-dora-"))


def command(*options: str) -> list[str]:
    """The command line of `dora run`."""
    return [sys.executable, "-m", "dora", "run", *options]


def wait_for_rows(path: Path, process: subprocess.Popen[str]) -> None:
    """Wait until a table has a row below its head, or the process that writes it has ended."""
    while not (path.exists() and path.read_bytes().count(b"\n") > 1) and process.poll() is None:
        time.sleep(0.05)


def interrupt(
    words: list[str], number: int, moment: float, group: bool, after: Path | None = None
) -> tuple[float | None, float, int, str, int]:
    """Start a command, send it a signal after `moment` [s], and wait for its end.

    Args:
        words: of the command line.
        number: of the signal.
        moment: since the start, or since the table `after` has a row [s].
        group: send it to all processes of the command.
        after: a table that the command writes.

    Returns:
        Seconds to the first line after the signal, None without one; seconds to the end; exit status; what it said;
        the number of the process.
    """
    process = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
    lines: list[tuple[float, str]] = []

    def listen() -> None:
        assert process.stderr is not None
        lines.extend((time.monotonic(), line) for line in process.stderr)

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    if after is not None:
        wait_for_rows(after, process)
    time.sleep(moment)
    sent = time.monotonic()
    with contextlib.suppress(ProcessLookupError):  # it may have ended
        (os.killpg if group else os.kill)(process.pid, number)
    try:
        process.wait(6 * END)
    finally:
        ended = time.monotonic() - sent
        listener.join(1.0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # workers that are still there
    first = next((at - sent for at, line in lines if at >= sent and "nterrupted" in line), None)
    return first, ended, process.returncode, "".join(line for _, line in lines), process.pid


def judged(
    number: int, moment: float, folder: Path, group: bool, options: tuple[str, ...], training: bool = False
) -> Outcome:
    """Interrupt a new run in `folder` and judge how it ends; a run that had finished before is judged, too."""
    words, after = command(*options, "--out", str(folder)), RunFolder(folder).progress if training else None
    before = nameless()
    line, end, status, said, process = interrupt(words, number, moment, group, after)
    problems, steps = [], None
    if new := nameless() - before:
        problems.append(f"left without the name of a process, unless by another program: {', '.join(sorted(new))}")
    if "Traceback" in said:
        problems.append(f"traceback: {said.strip().splitlines()[-1]}")
    if number != signal.SIGKILL and status != 0:
        if status != 128 + number:
            problems.append(f"exit status {status} instead of {128 + number}")
        if line is None or line > FIRST_LINE:
            problems.append(f"no line within {FIRST_LINE:.0f} s")
        if end > END:
            problems.append(f"not ended within {END:.0f} s")
    run = RunFolder(folder)
    if run.latest.exists():
        steps = int(read_checkpoint(run.latest).progress["env_steps"])
    left = left_behind(process)
    if left and number != signal.SIGKILL:
        problems.append(f"left {', '.join(sorted(left))}")
    return Outcome(moment, line, end, status, steps, left, problems)


def resumed(outcome: Outcome, folder: Path) -> None:
    """Let a run go on to its end, and add what goes wrong to the problems of its outcome."""
    if not (folder / "config.yaml").exists():
        return  # nothing was begun
    done = subprocess.run(command("--resume", str(folder)), capture_output=True, text=True)
    if done.returncode != 0 and "has ended" not in done.stderr:  # it may have come to its end first
        outcome.problems.append(f"cannot be resumed: {done.stderr.strip().splitlines()[-1]}")
    if still := sorted(path for path in outcome.left if Path(path).exists()):
        outcome.problems.append(f"left for good: {', '.join(still)}")


@dataclass(frozen=True)
class Args:
    """Interrupt short runs at several moments."""

    moments: tuple[float, ...] = (1.0, 5.0, 15.0, 30.0)
    """Times after the start of a run, or of its training [s]."""
    env: str = "DoraCube-v1"
    """Task of the runs."""
    agent: str | None = None
    """Their learner; the recommended one by default."""
    training: bool = False
    """Count the moments from the first iteration of training, which start-up delays by more or less."""
    signal: Literal["INT", "TERM", "KILL"] = "INT"
    """What is sent."""
    group: bool = False
    """Send it to all processes of the run, not only to the first one."""
    resume: bool = True
    """Let every run go on to its end afterwards."""


def main() -> int:
    """Run the command; returns the exit status."""
    args, wrong = tyro.cli(Args, description=__doc__), False
    number = getattr(signal, f"SIG{args.signal}")
    options = (*SHORT, "--env", args.env, *(("--agent", args.agent) if args.agent else ()))
    for moment in args.moments:
        place = Path(tempfile.mkdtemp(prefix="interruptions-"))
        outcome = judged(number, moment, place / "run", args.group, options, args.training)
        if args.resume:
            resumed(outcome, place / "run")
        print(outcome, flush=True)
        wrong |= bool(outcome.problems)
        shutil.rmtree(place)
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
