"""Rollouts by TorchRL collectors, in this process or in workers that each hold a task batch: processes of this machine,
or actors of a Ray cluster."""

import copy
import functools
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from multiprocessing import active_children, connection
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Bool
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector, MultiSyncCollector

from dora.agents.collecting.ray_collector import explained, ray_collector, whole_batch
from dora.agents.collecting.task_env import Task, TaskEnv, TaskFactory, TrainingRules
from dora.agents.learners.networks import Policy
from dora.errors import InputError, RunFailure, WorkerFailure, said
from dora.parallel import name_leftovers, name_of_process, signals_blocked, started_as_ours, take_environment

Result = TypeVar("Result")
SHUTDOWN_SECONDS = 10.0
"""Workers that have not ended after this time are killed [s]."""
POLL_SECONDS = 0.2
"""Longest time between two calls of `check` while workers collect [s]."""
GRACE = 0.5
"""Time that a process has for its end after its pipe was closed [s]."""
PATIENCE = 180.0
"""Time without a batch after which workers count as hung [s]."""
LESS_URGENT = 5
"""Niceness of workers that collect while the learner is busy: the learner has priority."""


class OwnTaskEnv(TaskEnv):
    """`TaskEnv` of the main process: calls `check` before every control step, which may raise."""

    check: Callable[[], None] = staticmethod(lambda: None)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check()
        return super()._step(tensordict)


class WorkerTaskEnv(TaskEnv):
    """`TaskEnv` of a worker process: leaves the message of an exception in a file for the main process.

    TorchRL itself tells the main process only that a worker ended.
    """

    def __init__(self, task: Task, report: Path, *, seed: int, rules: TrainingRules):
        self.report = report
        super().__init__(task, seed=seed, rules=rules)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with _reported(self.report):
            return super()._step(tensordict)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        with _reported(self.report):
            return super()._reset(tensordict, **kwargs)

    def _restart_rows(self, rows: Bool[Tensor, " n"]) -> TensorDictBase:
        with _reported(self.report):
            return super()._restart_rows(rows)


@contextmanager
def _reported(report: Path) -> Iterator[None]:
    """Ends this process after an exception; what it was is in the report, and nothing is printed."""
    try:
        yield
    except Exception as error:
        kind = "InputError" if isinstance(error, InputError) else type(error).__name__
        report.write_text(f"{kind}\n{error}")
        raise SystemExit(1) from None


def _make_worker_env(
    make_task: TaskFactory, report: Path, seed: int, rules: TrainingRules, nice: int, environment: dict[str, str]
) -> WorkerTaskEnv:
    take_environment(environment)
    torch.set_num_threads(1)
    os.nice(nice)
    torch.manual_seed(seed)
    with _reported(report):
        return WorkerTaskEnv(make_task(), report, seed=seed, rules=rules)


class _Workers(MultiSyncCollector):
    """TorchRL's collector of worker processes; one whose making fails lets go of what it had made.

    Else its queues are closed only when the interpreter ends, where that waits forever for a thread that cannot start.

    Raises:
        WorkerFailure: a worker died while it started.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        try:
            super().__init__(*args, **kwargs)
        except BaseException as error:
            ended = _ended(getattr(self, "procs", ()))
            for scheme in (getattr(self, "_weight_sync_schemes", None) or {}).values():
                scheme.shutdown()
            if ended:
                raise WorkerFailure(f"A worker process died while it started: worker {ended}.") from error
            raise


class Rollouts:
    """Endless source of batches (workers * num_envs, rollout) of transitions of a policy.

    Args:
        make_task: makes one task batch; called once in each worker.
        policy: acts; the workers use copies, which get its weights before each batch.
        workers: worker processes, or 0 to collect in this process.
        rollout: control steps per environment and batch.
        seeds: one per worker (one if `workers` is 0), for its tasks and its exploration.
        rules: see `TaskEnv`.
        ahead: workers go on with the next batch while the caller learns from this one, so that all cores are busy;
            a batch then comes from the policy as it was one call of `collect` earlier. Without workers it changes
            nothing.
        check: called now and then while workers start; may raise.
        cluster: the workers are actors of a Ray cluster.

    Raises:
        InputError: with the message of a worker that raised one, or there is no cluster.
        WorkerFailure: if a worker failed otherwise or died.
    """

    def __init__(
        self,
        make_task: TaskFactory,
        policy: Policy,
        *,
        workers: int,
        num_envs: int,
        rollout: int,
        seeds: Sequence[int],
        rules: TrainingRules,
        ahead: bool = False,
        check: Callable[[], None] = lambda: None,
        cluster: bool = False,
    ):
        self._policy = policy
        self._cluster = cluster and workers > 0
        self._acting = copy.deepcopy(policy) if workers > 0 else policy  # the workers share its memory
        self._ahead = ahead
        self._next: Future[TensorDictBase] | None = None
        name_leftovers()
        self._scratch = tempfile.TemporaryDirectory(prefix=name_of_process())
        self._reports = [Path(self._scratch.name) / str(i) for i in range(max(workers, 1))]
        self._processes: Sequence[Any] = ()
        self._own: OwnTaskEnv | None = None
        if self._cluster:
            frames = workers * num_envs * rollout
            self._collector: Any = ray_collector(make_task, self._acting, frames=frames, seeds=seeds, rules=rules)
        elif workers == 0:
            self._own = OwnTaskEnv(make_task(), seed=seeds[0], rules=rules)
            self._collector = Collector(
                self._own,
                policy,
                frames_per_batch=num_envs * rollout,
                total_frames=-1,
                trust_policy=True,
                auto_register_policy_transforms=False,
            )
        else:
            settings = rules, LESS_URGENT if ahead else 0, dict(os.environ)
            each = zip(self._reports, seeds, strict=True)
            factories = [functools.partial(_make_worker_env, make_task, *own, *settings) for own in each]
            self._collector = self._started(
                functools.partial(
                    _Workers,
                    factories,
                    self._acting,
                    frames_per_batch=workers * num_envs * rollout,
                    total_frames=-1,
                    cat_results=0,
                    use_buffers=True,
                    num_threads=torch.get_num_threads(),
                    num_sub_threads=1,
                    trust_policy=True,
                    auto_register_policy_transforms=False,
                ),
                check,
            )
            self._processes = self._collector.procs
        self._iterator = iter(self._collector)

    def _started(self, make: Callable[[], MultiSyncCollector], check: Callable[[], None]) -> MultiSyncCollector:
        """The collector of worker processes, made in a thread that blocks signals for them, while this one does not."""

        def make_quietly() -> MultiSyncCollector:
            with signals_blocked(), started_as_ours(__name__):
                return make()

        before = set(active_children())
        with self._scratch_removed_by_failure(), self._explained():
            future = _in_thread(make_quietly)
            try:
                while not wait([future], POLL_SECONDS).done:
                    check()
                return future.result()
            except BaseException:
                self._processes = list(set(active_children()) - before)
                end = time.monotonic() + SHUTDOWN_SECONDS
                while not future.done() and time.monotonic() < end:  # it may be about to start another one
                    _kill(set(active_children()) - before)
                    wait([future], POLL_SECONDS)
                _kill(set(active_children()) - before)
                raise

    def collect(self, check: Callable[[], None] = lambda: None) -> TensorDictBase:
        """The next batch; its memory is reused by the following call.

        Args:
            check: called now and then while workers collect, and without them before every control step; may raise, and
                without workers nothing more can be collected then.

        Raises:
            InputError: with the message of a worker that raised one.
            WorkerFailure: if a worker failed otherwise, died, or hangs.
        """
        if self._own is not None:
            self._own.check = check
            return next(self._iterator)
        with self._explained():
            future = self._next or self._begin()
            self._next = future  # still under way if the wait is interrupted
            start = time.monotonic()
            while not wait([future], POLL_SECONDS).done:
                check()
                if time.monotonic() - start > PATIENCE:
                    raise WorkerFailure(f"The workers hang: they have collected nothing for {PATIENCE:.0f} s.")
            self._next, batch = None, future.result()
            if self._ahead:
                batch = batch.clone()
                self._next = self._begin()
            return batch

    def _begin(self) -> "Future[TensorDictBase]":
        """Start a batch with the present policy; a thread waits for it, which does not keep the process alive."""
        self._acting.load_state_dict(self._policy.state_dict())
        self._collector.update_policy_weights_(self._acting if self._cluster else None)
        return _in_thread(lambda: whole_batch(next(self._iterator)))

    def close(self, at_once: bool) -> None:
        """End the workers; `at_once` without waiting for what they are doing."""
        if at_once:
            _kill(self._processes)
        if self._next is not None:
            wait([self._next], SHUTDOWN_SECONDS)  # the batch that is under way
        if self._cluster:
            self._collector.shutdown(timeout=SHUTDOWN_SECONDS)
        else:
            self._collector.shutdown(timeout=SHUTDOWN_SECONDS, raise_on_error=not at_once)
        self._scratch.cleanup()

    def __enter__(self) -> "Rollouts":
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self.close(at_once=kind is not None)

    @contextmanager
    def _scratch_removed_by_failure(self) -> Iterator[None]:
        """Remove the folder of the reports if starting fails, after they were read."""
        try:
            yield
        except BaseException:
            self._scratch.cleanup()
            raise

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Replace TorchRL's "a process failed" by what the worker said, or by how it ended."""
        try:
            yield
        except Exception as error:
            if (failure := explained(error)) is not None:  # Ray's errors are of the worker's class, too
                raise failure from error
            for index, report in enumerate(self._reports):
                if report.exists():
                    kind, _, message = report.read_text().partition("\n")
                    if kind == "InputError":
                        raise InputError(message) from None
                    raise WorkerFailure(f"Worker {index} failed with {said(kind, message)}") from error
            if isinstance(error, RunFailure | InputError):
                raise
            if ended := _ended(self._processes):
                raise WorkerFailure(f"A worker process died: worker {ended}.") from error
            raise WorkerFailure(f"The workers failed with {said(type(error).__name__, error)}") from error


def _in_thread(function: "Callable[[], Result]") -> "Future[Result]":
    """The result of a function that a thread calls, which does not keep the process alive."""
    future: Future[Result] = Future()

    def call() -> None:
        try:
            future.set_result(function())
        except BaseException as error:  # whoever waits for the result raises it
            future.set_exception(error)

    threading.Thread(target=call, daemon=True).start()
    return future


def _kill(processes: Iterable[Any]) -> None:
    """End processes at once, also those that hang."""
    for process in processes:
        if process.is_alive():
            process.kill()


def _ended(processes: Sequence[Any]) -> str:
    """Those of the processes that have ended, as a message names them; waits a little for one whose pipe is closed."""
    if not processes:
        return ""
    for process in processes:
        if connection.wait([process.sentinel], GRACE / len(processes)):
            process.join(GRACE)
    return ", ".join(f"{k} ({_how(p.exitcode)})" for k, p in enumerate(processes) if not p.is_alive())


def _how(status: int | None) -> str:
    """How a process with this exit status ended."""
    if status is not None and status < 0:
        return f"ended by {signal.Signals(-status).name}"
    return f"exit status {status}"
