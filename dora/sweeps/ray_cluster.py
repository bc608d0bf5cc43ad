"""Runs of a sweep as tasks of a Ray cluster: Ray decides where, and repeats those whose worker died.

A machine that sees the folder of the sweep trains in it. One that does not trains in its cache and sends the files back
that a report and an evaluation need, without the state of the learner.
"""

import contextlib
import importlib
import os
import signal
import subprocess
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dora.affordance.objects.decomposition import cache_folder
from dora.agents.config import config_from_dict
from dora.configs import plain
from dora.errors import InputError
from dora.files import write_bytes
from dora.sweeps.finished import finished_runs, result_of
from dora.sweeps.launching import LOG, NOT_THE_RUN, Command, Launcher, complaint, is_locked, prepare, resuming
from dora.sweeps.plan import WORKERS, Row

SENT = (
    "config.yaml", "versions.txt", "result.json", "curve.csv", "progress.csv", "eval.csv", "zero.csv", LOG,
    "checkpoints/best.safetensors",
)  # fmt: skip
"""Files of a finished run that are sent back."""
RETRIES = 3
"""How often Ray repeats a task whose worker died."""
LOCK_SECONDS = 1.0
"""Time between two looks at a folder in which another process trains [s]."""


class RayLauncher(Launcher):
    """Runs as tasks of a Ray cluster.

    Args:
        address: of the cluster; without one, that of the environment variable RAY_ADDRESS, else the one that `ray
            start` has started on this machine, else a new one of this machine alone.
        cores: that a run takes.
        command: words of the process that trains in a folder.

    Attributes:
        room: number of runs that fit into the cluster at the same time.

    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """

    def __init__(self, address: str | None = None, cores: int = WORKERS, command: Command = resuming):
        try:
            self._ray: Any = importlib.import_module("ray")
        except ImportError as error:
            raise InputError("--launcher ray needs Ray: pip install ray.") from error
        try:
            self._ray.init(address=address, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, ValueError, RuntimeError) as error:
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            start = "start one by `ray start --head`, or correct --address (RAY_ADDRESS)"
            where = address or "this machine"
            raise InputError(f"No Ray cluster answers at {where} ({reason}): {start}.") from error
        nodes = [node["Resources"].get("CPU", 0) for node in self._ray.nodes() if node["Alive"]]
        self.room = sum(int(cpus // cores) for cpus in nodes)
        if self.room == 0:
            self._ray.shutdown()
            raise InputError(f"A run takes {cores} cores, and no machine of the Ray cluster has so many.")
        self._train = self._ray.remote(num_cpus=cores, max_retries=RETRIES)(train_there)
        self._command = command
        self._running: dict[Any, tuple[Row, Path]] = {}

    def start(self, row: Row, folder: Path, zero: bool) -> None:
        """Begin a run, or go on with it, wherever there is room."""
        marker = folder / f".seen-{uuid.uuid4().hex}"
        marker.touch()
        task = self._train.remote(str(folder.absolute()), marker.name, plain(row.config), self._command, zero)
        self._running[task] = row, folder

    def ended(self) -> list[tuple[Row, str | None]]:
        """The runs that have ended since the last call, with what went wrong or None."""
        if not self._running:
            return []
        ready, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        return [self._end(task) for task in ready]

    def _end(self, task: Any) -> tuple[Row, str | None]:
        row, folder = self._running.pop(task)
        _remove_markers(folder)
        try:
            receive(folder, self._ray.get(task))
        except self._ray.exceptions.RayTaskError as error:
            return row, str(error.cause)
        except self._ray.exceptions.RayError as error:
            return row, f"{type(error).__name__}: {error}".splitlines()[0]
        except (InputError, OSError) as error:
            return row, str(error)
        return row, None

    def stop(self) -> None:
        """Ask all runs to save and end, wait for that, and leave the cluster."""
        for task in self._running:
            self._ray.cancel(task)
        if self._running:
            self._ray.wait(list(self._running), num_returns=len(self._running), timeout=60)
        for _, folder in self._running.values():
            _remove_markers(folder)
        self._running.clear()
        self._ray.shutdown()


def _remove_markers(folder: Path) -> None:
    for path in folder.glob(".seen-*"):
        path.unlink(missing_ok=True)


def train_there(
    folder: str, marker: str, settings: Mapping[str, Any], command: Command, zero: bool = True
) -> dict[str, bytes]:
    """Trains on a machine of the cluster; returns files of the run if they are not in the folder of the sweep already.

    Args:
        folder: of the run.
        marker: name of a file in it, by which a machine knows that it sees the folder.
        settings: of the run.
        command: words of the process that trains in a folder.
        zero: it evaluates zero correction, too.

    Raises:
        RuntimeError: the run has ended and is not finished.
    """
    shared = (Path(folder) / marker).exists()
    row = Row("", config_from_dict(dict(settings)))
    place = Path(folder) if shared else cache_folder() / "sweeps" / row.config.digest()
    prepare(row, place)
    while is_locked(place):  # the process of a worker that died goes on with the run
        time.sleep(LOCK_SECONDS)
    if _is_missing(row, place):
        status = _trained(place, command(place, zero))
        if _is_missing(row, place):
            raise RuntimeError(complaint(place, status) or NOT_THE_RUN)
    return {} if shared else {name: (place / name).read_bytes() for name in SENT if (place / name).is_file()}


def _is_missing(row: Row, place: Path) -> bool:
    """Whether a folder has no result of a run with its whole budget."""
    return result_of(row, finished_runs([place], strict=False)) is None


def _trained(place: Path, words: Sequence[str]) -> int:
    """Exit status of the process that trains; if this task is cancelled, it is asked to save first."""
    with (place / LOG).open("ab") as log:
        process = subprocess.Popen(
            list(words), stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
        )
    try:
        return process.wait()
    except KeyboardInterrupt:
        os.kill(process.pid, signal.SIGINT)
        process.wait()
        raise


def receive(folder: Path, files: Mapping[str, bytes]) -> None:
    """Puts the files of a run into its folder, the result last, so that it is there only when all others are.

    Raises:
        InputError: they cannot be written.
    """
    if files:  # else the machine has written into this very folder
        with contextlib.suppress(OSError):
            (folder / "result.json").unlink()  # that of a smaller budget, whose tables are replaced now
    for name in sorted(files, key="result.json".__eq__):
        if name in SENT:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_bytes(folder / name, files[name])
