"""Collectors on the machines of a Ray cluster, by TorchRL's `RayCollector`."""

import functools
import importlib
import os
import warnings
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from dora.agents.collecting.task_env import TaskEnv, TaskFactory, TrainingRules
from dora.agents.learners.networks import Policy
from dora.errors import InputError, WorkerFailure, said

FOREVER = 2**62
"""Number of transitions after which collectors would stop."""


class ActorCollector(Collector):
    """A `Collector` that is an actor of Ray, which asks for its truth value when it has raised something. Without end,
    its length is infinite, and Python refuses that as a truth value."""

    def __bool__(self) -> bool:
        return True


def ray_collector(
    make_task: TaskFactory, policy: Policy, *, frames: int, seeds: Sequence[int], rules: TrainingRules
) -> Any:
    """A collector whose workers, one for each seed, are actors of a Ray cluster; each takes one core.

    The cluster is that of the environment variable RAY_ADDRESS, else the one that `ray start` has started on this
    machine, else a new one of this machine alone.

    Args:
        make_task: makes one task batch; called once in each worker.
        policy: whose weights the workers get by `update_policy_weights_`.
        frames: transitions of a batch, of all workers.
        seeds: of their tasks and their exploration.
        rules: see `TaskEnv`.

    Raises:
        InputError: Ray is not installed, or no cluster answers.
    """
    try:
        ray: Any = importlib.import_module("ray")
        from torchrl.collectors.distributed import RayCollector
    except ImportError as error:
        raise InputError("--collector ray needs Ray: pip install ray.") from error
    try:
        if not ray.is_initialized():
            ray.init(include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        start = "start one by `ray start --head`, or correct RAY_ADDRESS"
        raise InputError(f"No Ray cluster answers ({reason}): {start}.") from error
    room = int(ray.cluster_resources().get("CPU", 0))
    if room < len(seeds):
        raise InputError(f"The Ray cluster has {room} cores, and --workers is {len(seeds)}: use at most {room}.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return RayCollector(
            [functools.partial(_worker_env, make_task, seed, rules) for seed in seeds],
            policy,
            collector_class=ActorCollector,  # pyright: ignore[reportArgumentType]
            frames_per_batch=frames,
            total_frames=FOREVER,
            sync=True,
            trust_policy=True,
            remote_configs={"num_cpus": 1, "num_gpus": 0},
            collector_kwargs={"auto_register_policy_transforms": False},
        )


def _worker_env(make_task: TaskFactory, seed: int, rules: TrainingRules) -> TaskEnv:
    """The environment of a worker, in its process."""
    torch.set_num_threads(1)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.manual_seed(seed)
    return TaskEnv(make_task(), seed=seed, rules=rules)


def whole_batch(batch: TensorDictBase) -> TensorDictBase:
    """A batch (workers, n, rollout), as Ray's collector stacks it -> (workers * n, rollout)."""
    return batch.flatten(0, 1) if batch.ndim > 2 else batch


def explained(error: BaseException) -> Exception | None:
    """What a worker of a cluster said, or that it died; None if the error has nothing to do with a cluster."""
    if not type(error).__module__.startswith("ray"):
        return None
    cause = getattr(error, "cause", None)
    if isinstance(cause, InputError):
        return InputError(str(cause))
    if cause is not None:
        return WorkerFailure(f"A worker of the cluster failed with {said(type(cause).__name__, cause)}")
    return WorkerFailure(f"A worker of the cluster died ({type(error).__name__}).")
