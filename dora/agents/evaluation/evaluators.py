"""Evaluation on several cores: batches of episodes are dealt out to this process and to helper processes."""

import functools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from dora.agents.collecting.task_env import TaskEnv, TaskFactory
from dora.agents.config import RunConfig
from dora.agents.evaluation.evaluate import FINAL_SEED, Evaluation, no_correction, run_batch
from dora.agents.learners.learner import make_learner
from dora.agents.learners.networks import Policy
from dora.parallel import WorkerPool

Weights = dict[str, np.ndarray]
"""A policy's parameters and buffers; torch would send tensors as shared files."""
Batch = tuple[Weights | None, int]
"""What a batch of episodes depends on: the weights, None for no correction, and the seed of its first episode."""


class Evaluators:
    """Evaluates policies in this process and in helpers, which start when there is something to do for them.

    A batch of `config.eval_envs` episodes gives the same rows in whatever process it runs.

    Args:
        make_task: makes a batch of `config.eval_envs` tasks; picklable.
        config: settings of the run; up to `workers` processes evaluate, this one included.
    """

    def __init__(self, make_task: TaskFactory, config: RunConfig):
        self._own, self._config = _Evaluator(make_task, config), config
        self._helpers = WorkerPool(_Evaluator, (make_task, config), max(config.workers, 1) - 1)
        self.env, self.sizes = self._own.env, self._own.sizes

    def run(
        self, policy: Policy | None, episodes: int, first_seed: int, check: Callable[[], None] = lambda: None
    ) -> Evaluation:
        """Run `episodes` episodes with seeds first_seed, first_seed + 1, ...

        Args:
            policy: acts without exploring; None for no correction.
            episodes: number of episodes.
            first_seed: seed of the first one.
            check: called every control step; what it raises ends the evaluation, and the helpers.

        Raises:
            RuntimeError: a helper process died.
            Exception: what a task raised first, here or in a helper.
        """
        weights = None if policy is None else {k: v.numpy(force=True) for k, v in policy.state_dict().items()}
        starts = range(0, episodes, self.env.batch_size[0])
        batches = [(weights, first_seed + start) for start in starts]
        tables = self._helpers.map(batches, functools.partial(self._own, check=check), check=check)
        return Evaluation(self.env.columns, torch.from_numpy(np.concatenate(tables)[:episodes]))

    def final(self, policy: Policy, check: Callable[[], None] = lambda: None) -> tuple[Evaluation, Evaluation | None]:
        """Evaluate a policy, and no correction if there is a prior, on `config.final_episodes` episodes whose seeds
        no training or periodic evaluation uses; arguments and errors as for `run`."""
        episodes = self._config.final_episodes
        evaluation = self.run(policy, episodes, FINAL_SEED, check)
        return evaluation, self.run(None, episodes, FINAL_SEED, check) if self._config.has_prior else None

    def close(self) -> None:
        """End the helpers and close the environments."""
        self._helpers.close()
        self.env.close()


class _Evaluator:
    """Tasks and a policy whose weights come with each batch; arguments as for `Evaluators`."""

    def __init__(self, make_task: TaskFactory, config: RunConfig):
        self.env = TaskEnv(make_task())
        self.sizes = (self.env.observation_spec["observation"].shape[-1], self.env.action_spec.shape[-1])
        with torch.random.fork_rng(devices=[]):
            self._policy = make_learner(config, *self.sizes).policy

    def __call__(self, batch: Batch, check: Callable[[], None] = lambda: None) -> np.ndarray:
        """Rows (n, k) of an evaluation's table; `check` is called every control step."""
        weights, seed = batch
        act = no_correction(self.sizes[1])
        if weights is not None:
            self._policy.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
            act = self._policy.greedy

        def checked(observation: Tensor) -> Tensor:
            check()
            return act(observation)

        with torch.random.fork_rng(devices=[]):
            return run_batch(self.env, checked, seed).numpy(force=True)
