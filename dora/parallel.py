"""Worker processes: many independent cases on all cores, one task object per process; the count of cores."""

import contextlib
import functools
import math
import os
import platform
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import (
    Pipe,
    current_process,
    forkserver,
    get_all_start_methods,
    get_context,
    get_start_method,
    parent_process,
    resource_tracker,
    set_start_method,
)
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch

from dora.errors import InputError, WorkerFailure

Case = TypeVar("Case")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
"""Called now and then with the number of cases done and of all cases."""

CHUNK = 4
"""Cases that a process takes at once, where they are short."""
PATIENCE = 600.0
"""Time without any finished case after which the workers of an evaluation count as hung [s]."""
PATIENCE_OF_CASES = 1800.0
"""The same for the cases of `run_cases`, which are longer: batches of episodes, with the making of their task [s]."""
POLL_SECONDS = 0.2
"""Longest time between two calls of `check` while workers are busy [s]."""
SHARED = Path("/dev/shm")
"""Where the system keeps semaphores by name."""
LEFT = re.compile(r"(?:sem\.mp-)?dora-(?P<space>\d+)-(?P<process>\d+)-(?P<start>\d+)-.*")
"""Name of a semaphore or temporary folder with the process that made it, see `name_of_process`."""
LONGEST_SOCKET = 103 if sys.platform == "darwin" else 107
"""Bytes of the longest path of a socket."""
BESIDE = 50
"""Characters of a target's name in that of the folder beside it; names have at most 255 bytes."""
DIED = "A worker process died (a crash in native code, or too little memory): run with one process to see why."
"""Message of the error after the death of a worker."""


def available_cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread, as a context or a decorator; small tensors take longer on several, above all busy ones."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class WorkerPool(Generic[Case, Result]):
    """A `ProcessPoolExecutor` whose processes each hold one task; a context manager.

    Processes start when there are cases for them and stay until `close`. They see neither Ctrl-C nor SIGTERM, and end
    with this process, also when that is killed.

    Args:
        factory: makes the task from `arguments`; called once per process, with the first case. Must be importable by
            name.
        arguments: of the factory; they, the cases and the results must be picklable.
        processes: at most so many.
    """

    def __init__(self, factory: Callable[..., Callable[[Case], Result]], arguments: tuple[Any, ...], processes: int):
        self._task, self.processes = functools.partial(factory, *arguments), processes
        self._executor: ProcessPoolExecutor | None = None
        self._alive: Connection | None = None

    def map(
        self,
        cases: Sequence[Case],
        here: Callable[[Case], Result] | None = None,
        progress: Progress = lambda done, total: None,
        check: Callable[[], None] = lambda: None,
        chunk: int = 1,
        patience: float = math.inf,
    ) -> list[Result]:
        """Results of all cases, in their order; whatever is raised ends the processes.

        Args:
            cases: what the task is called with, one after the other.
            here: task of this process, which then does its share of the cases, too.
            progress: told about cases that are done.
            check: called now and then while this process waits; may raise.
            chunk: cases that a process takes at once.
            patience: longest time without a result of the other processes [s].

        Raises:
            WorkerFailure: a process died, or all hang.
            Exception: what the task raised first.
        """
        parts = [range(start, min(start + chunk, len(cases))) for start in range(0, len(cases), chunk)]
        takers = self.processes + (here is not None)
        own = parts[::takers] if here is not None else []
        others = [part for i, part in enumerate(parts) if here is None or i % takers]
        found: dict[int, Result] = {}

        def add(part: range, results: list[Result]) -> None:
            found.update(zip(part, results, strict=True))
            progress(len(found), len(cases))

        try:
            pending = {self._submit([cases[i] for i in part]): part for part in others}
            for part in own:
                add(part, [here(cases[i]) for i in part])  # pyright: ignore[reportOptionalCall]
            last = time.monotonic()
            while pending:
                for future in wait(pending, POLL_SECONDS, FIRST_COMPLETED).done:
                    add(pending.pop(future), future.result())
                    last = time.monotonic()
                check()
                if time.monotonic() - last > patience:
                    raise WorkerFailure(f"The worker processes hang: none has finished anything for {patience:.0f} s.")
        except BrokenProcessPool as error:
            self.close()
            raise WorkerFailure(DIED) from error
        except BaseException:
            self.close()
            raise
        return [found[i] for i in range(len(cases))]

    def warm_up(self) -> None:
        """Begin to import, beside other work, what the processes will need; returns at once."""
        if self.processes > 0:
            warm_up(self._task.func)

    def close(self) -> None:
        """End the processes, whatever they are doing; `map` may start new ones."""
        if self._executor is not None and self._alive is not None:
            self._alive.close()
            for process in list((self._executor._processes or {}).values()):
                process.kill()  # also those that hang
            self._executor.shutdown(cancel_futures=True)
            self._executor = None

    def __enter__(self) -> "WorkerPool[Case, Result]":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _submit(self, cases: list[Case]) -> Future[list[Result]]:
        with signals_blocked():
            if self._executor is None:
                theirs, self._alive = Pipe(duplex=False)
                context = _context(self._task.func.__module__)
                arguments = theirs, dict(os.environ), self._task
                self._executor = ProcessPoolExecutor(self.processes, context, _begin, arguments)
            return self._executor.submit(_work, cases)


def run_cases(
    factory: Callable[..., Callable[[Case], Result]],
    arguments: tuple[Any, ...],
    cases: Sequence[Case],
    processes: int | None = None,
    progress: Progress | None = None,
    chunk: int = CHUNK,
    patience: float = PATIENCE_OF_CASES,
) -> list[Result]:
    """Results of all cases, in their order, by processes that end with the call.

    Args and errors as for `WorkerPool`, besides:
        processes: number of processes; one per core by default. With 1 everything runs in this process.
    """
    count = min(processes or available_cores(), -(-len(cases) // chunk))
    report = progress or (lambda done, total: None)
    if count <= 1:
        with one_thread():  # as in the processes: products on more threads are rounded otherwise
            return WorkerPool(factory, arguments, 0).map(cases, factory(*arguments), report)
    with WorkerPool(factory, arguments, count) as pool:
        return pool.map(cases, progress=report, chunk=chunk, patience=patience)


def name_of_process() -> str:
    """Beginning of the names of temporary folders of this process: they can be recognised when it is gone.

    It has the process's namespace, its number, and its start in ticks of the system's clock.
    """
    return f"dora-{_namespace()}-{os.getpid()}-{_start(os.getpid())}-"


@functools.cache
def name_leftovers() -> None:
    """Name the semaphores and temporary folders of worker processes after this process, and remove those that
    processes of the same user left, which are gone; Python removes its own unless it is killed with all its processes.
    """
    if parent_process() is not None:
        return  # a worker uses the names of the process that started it
    settings: dict[str, str] = current_process()._config  # pyright: ignore[reportAttributeAccessIssue]
    settings["semprefix"] = f"/mp-{name_of_process().rstrip('-')}"
    settings["tempdir"] = folder = tempfile.mkdtemp(prefix=name_of_process(), dir=_place_of_sockets())
    Finalize(None, shutil.rmtree, (folder,), {"ignore_errors": True}, exitpriority=-100)
    for place in {SHARED, Path(tempfile.gettempdir()), Path(folder).parent}:
        for path in place.glob("*dora-*-*"):
            if _is_left(path):
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def remove_own() -> None:
    """Remove the temporary folder of this process, where it ends without what Python does at the end."""
    folder: Any = current_process()._config.get("tempdir")  # pyright: ignore[reportAttributeAccessIssue]
    if folder and parent_process() is None and Path(folder).name.startswith(name_of_process()):
        shutil.rmtree(folder, ignore_errors=True)


def _place_of_sockets() -> str:
    """Where this process may have a folder with the sockets of its workers, whose paths must not be long."""
    places = [os.path.abspath(tempfile.gettempdir()), "/tmp", "/var/tmp", "/dev/shm"]
    room = LONGEST_SOCKET - len(name_of_process()) - len("/xxxxxxxx/listener-xxxxxxxx")
    for place in places:
        if len(os.fsencode(place)) <= room and os.access(place, os.W_OK | os.X_OK):
            return place
    raise InputError(f"the path of temporary files, {places[0]}, is too long for sockets: set TMPDIR to a shorter one.")


def folder_beside(target: Path) -> Path:
    """Make a folder beside a target for what will get its name when it is whole, and remove those that processes of
    this user and machine left there for the same target, which are gone. Another process's stays.

    Raises:
        OSError: it cannot be made.
    """
    machine = zlib.crc32(platform.node().encode())  # another one may write on the same disk, with the same numbers
    place, beginning = target.absolute().parent, f".{target.name[:BESIDE]}.{machine:08x}."
    for path in place.iterdir():
        if path.name.startswith(beginning) and _is_left(path, beginning):
            shutil.rmtree(path, ignore_errors=True)
    return Path(tempfile.mkdtemp(dir=place, prefix=beginning + name_of_process()))


def _is_left(path: Path, beginning: str = "") -> bool:
    """Whether a file was made by a process of this user that is gone; False for what may belong to anything else.

    Args:
        path: of the file.
        beginning: of its name, before that of the process.
    """
    found = LEFT.fullmatch(path.name.removeprefix(beginning))
    try:
        if found is None or int(found["space"]) != _namespace() or path.stat().st_uid != os.getuid():
            return False
        return _start(int(found["process"])) != int(found["start"])
    except OSError:
        return False


def _namespace() -> int:
    """The namespace of process numbers; 0 where the system does not tell."""
    try:
        return os.stat("/proc/self/ns/pid").st_ino
    except OSError:
        return 0


def _start(process: int) -> int:
    """When a process started, in ticks since the system did; 0 if it is gone, or where the system does not tell."""
    try:
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19])
    except (OSError, IndexError):
        return 0


def warm_up(factory: Callable[..., Any]) -> None:
    """Begin to import, beside other work, what worker processes with this factory will need; returns at once."""
    if available_cores() > 1:
        _context(factory.__module__)


@contextlib.contextmanager
def signals_blocked() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM while processes start: they keep the mask for good, this process gets them later."""
    name_leftovers()
    resource_tracker.ensure_running()  # unblocks both itself when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _context(module: str) -> Any:
    """Processes that inherit neither threads nor a renderer of this one.

    Where the system can, they are forked from a server that has imported Dora and the module of the first factory.
    """
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload(["dora", module])
    with signals_blocked():
        forkserver.ensure_running()
    return context


@contextlib.contextmanager
def started_as_ours(module: str) -> Iterator[None]:
    """Processes that a library starts by Python's default method are forked from the server of ours meanwhile.

    Args:
        module: what they need, which the server imports, too, if it begins now.
    """
    method, before = _context(module).get_start_method(), get_start_method(allow_none=True)
    set_start_method(method, force=True)
    try:
        yield
    finally:
        set_start_method(before, force=True)


_task: Callable[[], Callable[[Any], Any]] | None = None
"""In a worker process: gives its task, which the first call makes."""


def take_environment(variables: Mapping[str, str]) -> None:
    """Give a worker process the environment of the one that wants it; its server may have begun with another."""
    os.environ.clear()
    os.environ.update(variables)


def _begin(alive: Connection, environment: dict[str, str], make_task: Callable[[], Callable[[Any], Any]]) -> None:
    """Start of a worker process; the task is made with the first cases, where an exception reaches the caller."""
    global _task
    take_environment(environment)
    _task = functools.cache(make_task)
    torch.set_num_threads(1)
    threading.Thread(target=_end_with, args=(alive,), daemon=True).start()


def _end_with(alive: Connection) -> None:
    """Ends this process when the other end of a pipe is closed, by `WorkerPool.close` or the end of its process."""
    alive.poll(None)
    os._exit(1)


def _work(cases: list[Any]) -> list[Any]:
    assert _task is not None
    task = _task()
    return [task(case) for case in cases]
