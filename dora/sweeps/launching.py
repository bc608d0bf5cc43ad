"""How a run of a sweep is begun, gone on with and watched: a folder, a process of `dora run`, a lock."""

import abc
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from dora.agents.config import RunConfig
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.stored_results import read_result
from dora.errors import InputError
from dora.sweeps.plan import Row

LOG = "output.log"
"""What a run of a sweep has printed, in its folder."""
TAIL = 4096
"""Characters at the end of a file that are looked at [bytes]."""
NOT_THE_RUN = "it has ended, and is not the run that is wanted"
"""Complaint about a finished run whose settings or budget are others."""

Command = Callable[[Path, bool], Sequence[str]]
"""Words of the process that begins or goes on with the run in a folder, which evaluates zero correction at its end or
not."""


class Launcher(abc.ABC):
    """Where the runs of a sweep are trained."""

    @abc.abstractmethod
    def start(self, row: Row, folder: Path, zero: bool) -> None:
        """Begin a run, or go on with it; `zero` says whether it evaluates zero correction, too."""

    @abc.abstractmethod
    def ended(self) -> list[tuple[Row, str | None]]:
        """The runs that have ended since the last call, with what went wrong or None."""

    @abc.abstractmethod
    def stop(self) -> None:
        """Ask all runs to save and end, and wait for that."""


def resuming(folder: Path, zero: bool = True) -> list[str]:
    """The process that trains in a folder which holds settings."""
    words = [sys.executable, "-m", "dora", "run", "--resume", str(folder)]
    return words if zero else [*words, "--no-zero-correction"]


def check_folder(row: Row, folder: Path) -> RunConfig | None:
    """The settings of the run that a folder holds; None if there is none yet.

    Raises:
        InputError: they are damaged, or others than those of the run.
    """
    if not (folder / "config.yaml").exists():
        return None
    stored = RunFolder(folder).read_config()
    if stored.digest() != row.config.digest():
        raise InputError(
            f"{folder} holds a run with other settings (of another version of the task or of the learner): "
            "move it away, or choose another --out."
        )
    if stored.total_steps > row.config.total_steps:
        raise InputError(
            f"{folder} holds a run of {stored.total_steps:,} steps, and {row.config.total_steps:,} are asked for: give "
            f"--total-steps {stored.total_steps}, move it away, or choose another --out."
        )
    return stored


def prepare(row: Row, folder: Path) -> None:
    """Make the folder of a run with its settings, unless it is there; one of a smaller budget gets the larger one.

    Raises:
        InputError: the folder holds a run with other settings, or cannot be written.
    """
    run, stored = RunFolder(folder), check_folder(row, folder)
    if stored is None:
        run.create(row.config)
    elif stored.total_steps < row.config.total_steps:
        run.write_config(replace(stored, total_steps=row.config.total_steps))


def is_finished(folder: Path) -> bool:
    """Whether the run in a folder has reached its end."""
    path = folder / "result.json"
    return path.is_file() and read_result(path) is not None


def is_locked(folder: Path) -> bool:
    """Whether a process on this machine trains in a folder."""
    path = folder / ".lock"
    if not path.exists():
        return False
    descriptor = os.open(path, os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def last_words(folder: Path) -> str:
    """The last line that a run has printed."""
    path = folder / LOG
    if not path.is_file():
        return "it printed nothing"
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - TAIL, 0))
        lines = file.read().decode(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "it printed nothing")


DIGITS = 12
"""Longest number of steps [digits]."""


def steps_of(folder: Path) -> int:
    """Environment steps that a run has taken, from the last whole row of its progress.csv."""
    path = folder / "progress.csv"
    if not path.is_file():
        return 0
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - TAIL, 0))
        lines = file.read().decode(errors="replace").split("\n")[:-1]
    for line in reversed(lines):
        cell = line.split(",")[0]
        if cell.isascii() and cell.isdigit() and len(cell) <= DIGITS:
            return int(cell)
    return 0


def complaint(folder: Path, status: int) -> str | None:
    """What went wrong in a run whose process has ended; None if that ended well and left a result.

    A result alone says little: it may be that of a smaller budget, with which the process has failed to go on.
    """
    try:
        finished = is_finished(folder)
    except InputError as error:
        return str(error)
    return None if status == 0 and finished else f"status {status}: {last_words(folder)}"


@dataclass
class LocalLauncher(Launcher):
    """Runs as processes of this machine. They have sessions of their own: a signal reaches them through `stop` alone,
    and they go on if this process is killed.

    Attributes:
        command: words of the process that trains in a folder.
    """

    command: Command = resuming
    _running: dict[Path, tuple[Row, subprocess.Popen[bytes]]] = field(default_factory=dict)

    def start(self, row: Row, folder: Path, zero: bool) -> None:
        """Begin a run, or go on with it; its output is appended to `output.log`."""
        with (folder / LOG).open("ab") as log:
            process = subprocess.Popen(
                list(self.command(folder, zero)),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._running[folder] = row, process

    def ended(self) -> list[tuple[Row, str | None]]:
        """The runs that have ended since the last call, with what went wrong or None."""
        over = [
            (folder, row, process) for folder, (row, process) in self._running.items() if process.poll() is not None
        ]
        for folder, _, _ in over:
            del self._running[folder]
        return [(row, complaint(folder, process.returncode)) for folder, row, process in over]

    def stop(self) -> None:
        """Ask all runs to save and end, and wait for that."""
        for _, process in self._running.values():
            process.send_signal(signal.SIGINT)
        for _, process in self._running.values():
            process.wait()
        self._running.clear()
