"""Many independent cases on all cores: one task object per process, cases handed out in small chunks."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver, get_all_start_methods, get_context
from typing import Any, TypeVar

import torch

Case = TypeVar("Case")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
"""Called now and then with the number of cases done and of all cases."""

CHUNK = 4
"""Cases that a process takes at once, where they are short."""
PRELOADED = ["dora.sim.grasp_tests.shake_test", "dora.sim.grasp_tests.lift_test"]
"""Modules that are imported once for all processes, where the system can fork them from a clean server."""


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_cases(
    factory: Callable[..., Callable[[Case], Result]],
    arguments: tuple[Any, ...],
    cases: Sequence[Case],
    processes: int | None = None,
    progress: Progress | None = None,
    chunk: int = CHUNK,
) -> list[Result]:
    """Results of all cases, in their order.

    Args:
        factory: makes the task from `arguments`; called once per process. Must be importable by name.
        arguments: of the factory; they and cases and results must be picklable.
        cases: what the task is called with, one after the other.
        processes: number of processes; one per core by default. With 1 everything runs in this process.
        progress: told about cases that are done.
        chunk: cases that a process takes at once.

    Raises:
        RuntimeError: a process died (a crash in native code, or too little memory).
        Exception: whatever the task raised first; nothing goes on running then.
    """
    count = min(processes or available_cores(), -(-len(cases) // chunk))
    report = progress or (lambda done, total: None)
    if count <= 1:
        task, results = factory(*arguments), []
        for case in cases:
            results.append(task(case))
            report(len(results), len(cases))
        return results
    chunks = [range(start, min(start + chunk, len(cases))) for start in range(0, len(cases), chunk)]
    found: dict[int, Result] = {}
    with ProcessPoolExecutor(count, _context(), _remember, (factory, arguments)) as pool:
        pending = {pool.submit(_work, [cases[i] for i in part]): part for part in chunks}
        try:
            for future in as_completed(pending):
                found.update(zip(pending[future], future.result(), strict=True))
                report(len(found), len(cases))
        except BrokenProcessPool as error:
            raise RuntimeError("a simulating process died; run with one process to see why.") from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    return [found[i] for i in range(len(cases))]


def warm_up() -> None:
    """Begin to import, beside other work, what the processes of `run_cases` will need; returns at once."""
    if "forkserver" in get_all_start_methods() and available_cores() > 1:
        _context()
        forkserver.ensure_running()


def _context() -> Any:
    """Processes that inherit neither threads nor a renderer of this one."""
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


_recipe: tuple[Callable[..., Any], tuple[Any, ...]] | None = None
_task: Callable[[Any], Any] | None = None


def _remember(factory: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Start of a process: the task is made with the first chunk, where an exception reaches the caller."""
    global _recipe
    _recipe = factory, arguments
    torch.set_num_threads(1)


def _work(cases: list[Any]) -> list[Any]:
    global _task
    assert _recipe is not None
    task = _task or _recipe[0](*_recipe[1])
    _task = task
    return [task(case) for case in cases]
