"""Rollouts by TorchRL collectors, in this process or in worker processes that each hold a task batch."""

import copy
import functools
import os
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiSyncCollector

from dora.agents.collecting.task_env import Task, TaskEnv, TaskFactory
from dora.agents.learners.networks import Policy
from dora.errors import InputError
from dora.parallel import sigint_blocked

SHUTDOWN_SECONDS = 10.0
"""Workers that have not ended after this time are killed [s]."""
LESS_URGENT = 5
"""Niceness of workers that collect while the learner is busy: the learner has priority."""


class WorkerTaskEnv(TaskEnv):
    """`TaskEnv` of a worker process: leaves the message of an exception in a file for the main process.

    TorchRL itself tells the main process only that a worker ended.
    """

    def __init__(self, task: Task, report: Path, *, seed: int, stagger: bool):
        self.report = report
        super().__init__(task, seed=seed, stagger=stagger)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with _reported(self.report):
            return super()._step(tensordict)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        with _reported(self.report):
            return super()._reset(tensordict, **kwargs)


@contextmanager
def _reported(report: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        kind = "InputError" if isinstance(error, InputError) else type(error).__name__
        report.write_text(f"{kind}\n{error}")
        raise


def _make_worker_env(make_task: TaskFactory, report: Path, seed: int, stagger: bool, nice: int) -> WorkerTaskEnv:
    torch.set_num_threads(1)
    os.nice(nice)
    torch.manual_seed(seed)
    with _reported(report):
        return WorkerTaskEnv(make_task(), report, seed=seed, stagger=stagger)


class Rollouts:
    """Endless source of batches (workers * num_envs, rollout) of transitions of a policy.

    Args:
        make_task: makes one task batch; called once in each worker.
        policy: acts; the workers use copies, which get its weights before each batch.
        workers: worker processes, or 0 to collect in this process.
        rollout: control steps per environment and batch.
        seeds: one per worker (one if `workers` is 0), for its tasks and its exploration.
        stagger: see `TaskEnv`.
        ahead: workers go on with the next batch while the caller learns from this one, so that all cores are busy;
            a batch then comes from the policy as it was one call of `collect` earlier. Without workers it changes
            nothing.
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
        stagger: bool,
        ahead: bool = False,
    ):
        self._policy = policy
        self._acting = copy.deepcopy(policy) if workers > 0 else policy  # the workers share its memory
        self._waiting = ThreadPoolExecutor(1) if ahead and workers > 0 else None
        self._next: Future[TensorDictBase] | None = None
        self._scratch = tempfile.TemporaryDirectory(prefix="dora-workers-")
        self._reports = [Path(self._scratch.name) / str(i) for i in range(max(workers, 1))]
        if workers == 0:
            env = TaskEnv(make_task(), seed=seeds[0], stagger=stagger)
            self._collector = Collector(
                env,
                policy,
                frames_per_batch=num_envs * rollout,
                total_frames=-1,
                trust_policy=True,
                auto_register_policy_transforms=False,
            )
        else:
            factories = [
                functools.partial(_make_worker_env, make_task, report, seed, stagger, LESS_URGENT if ahead else 0)
                for report, seed in zip(self._reports, seeds, strict=True)
            ]
            with sigint_blocked(), self._explained():
                self._collector = MultiSyncCollector(
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
                )
        self._iterator = iter(self._collector)

    def collect(self) -> TensorDictBase:
        """The next batch; its memory is reused by the following call.

        Raises:
            InputError: with the message of a worker that raised one.
            RuntimeError: if a worker failed otherwise.
        """
        with self._explained():
            if self._waiting is None:
                self._push()
                return next(self._iterator)
            batch = (self._next or self._begin(self._waiting)).result().clone()
            self._next = self._begin(self._waiting)
            return batch

    def _begin(self, waiting: ThreadPoolExecutor) -> Future[TensorDictBase]:
        """Start a batch with the present policy; a thread waits for it."""
        self._push()
        return waiting.submit(next, self._iterator)

    def _push(self) -> None:
        """Give the workers the present weights and normaliser of the policy."""
        if isinstance(self._collector, MultiSyncCollector):
            self._acting.load_state_dict(self._policy.state_dict())
            self._collector.update_policy_weights_()

    def close(self) -> None:
        """End the workers."""
        if self._waiting is not None:
            self._waiting.shutdown()  # the batch that is under way
        self._collector.shutdown(timeout=SHUTDOWN_SECONDS)
        self._scratch.cleanup()

    def __enter__(self) -> "Rollouts":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Replace TorchRL's "a process failed" by what the worker said."""
        try:
            yield
        except Exception as error:
            for index, report in enumerate(self._reports):
                if report.exists():
                    kind, _, message = report.read_text().partition("\n")
                    if kind == "InputError":
                        raise InputError(message) from None
                    raise RuntimeError(f"worker {index} failed with {kind}: {message}") from error
            raise
