"""Evaluation on several cores: batches of episodes are dealt out to this process and to helper processes."""

import functools
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.agents.collecting.task_env import MakeTask, TaskEnv
from dora.agents.config import RunConfig
from dora.agents.evaluation.evaluate import FINAL_SEED, Act, Evaluation, no_correction, run_batch
from dora.agents.learners.learner import make_learner
from dora.agents.learners.networks import Policy
from dora.parallel import PATIENCE, WorkerPool, one_thread

FEWEST = 2
"""Environments of the smallest batch [1]: sums over a single one are rounded in another order."""
Weights = dict[str, np.ndarray]
"""A policy's parameters and buffers; torch would send tensors as shared files."""
Batch = tuple[Weights | None, int, int]
"""What a batch of episodes depends on: the weights, None for no correction, the seed of its first episode, and how many
there are."""


class Evaluators:
    """Evaluates policies in this process and in helpers, which start when there is something to do for them.

    Batches have `config.eval_envs` episodes, the last one those that are left. An episode gives the same row in
    whatever process it runs, however many others there are, and however many cores the machine has.

    Args:
        make_task: makes a batch of tasks; picklable.
        config: settings of the run; up to `workers` processes evaluate, this one included.
        episodes: most episodes of an evaluation, if known: fewer than `config.eval_envs` need no more environments.
    """

    def __init__(self, make_task: MakeTask, config: RunConfig, episodes: int | None = None):
        self._own, self._config = _Evaluator(make_task, config), config
        self._helpers = WorkerPool(_Evaluator, (make_task, config), max(config.workers, 1) - 1)
        self._helpers.warm_up()
        self.env = self._own.env(min(episodes or config.eval_envs, config.eval_envs))
        self.sizes, self.agents = self.env.sizes, self.env.agents

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
            WorkerFailure: a helper process died or hangs.
            Exception: what a task raised first, here or in a helper.
        """
        weights = None if policy is None else {k: v.numpy(force=True) for k, v in policy.state_dict().items()}
        size = self._config.eval_envs
        batches = [(weights, first_seed + start, min(size, episodes - start)) for start in range(0, episodes, size)]
        tables = self._helpers.map(batches, functools.partial(self._own, check=check), check=check, patience=PATIENCE)
        table, *starts = torch.from_numpy(np.concatenate(tables)).tensor_split([len(self.env.columns.names)], 1)
        named = dict(zip(self.env.start_numbers, starts[0].T, strict=True))
        return Evaluation(self.env.columns, table, first_seed, getattr(self.env.task, "ranking_steps", None), named)

    def final(
        self,
        policy: Policy,
        check: Callable[[], None] = lambda: None,
        *,
        zero: bool = True,
        first_seed: int = FINAL_SEED,
    ) -> tuple[Evaluation, Evaluation | None]:
        """Evaluate a policy and, with `zero` and if there is a prior, no correction on `config.final_episodes` episodes
        whose seeds no training or periodic evaluation uses; other arguments and errors as for `run`."""
        episodes = self._config.final_episodes
        evaluation = self.run(policy, episodes, first_seed, check)
        zero = zero and self._config.has_prior
        return evaluation, self.run(None, episodes, first_seed, check) if zero else None

    def close(self) -> None:
        """End the helpers and close the environments."""
        self._helpers.close()
        self._own.close()


class _Evaluator:
    """Tasks and a policy whose weights come with each batch; arguments as for `Evaluators`."""

    def __init__(self, make_task: MakeTask, config: RunConfig):
        self._make_task, self._config = make_task, config
        self._envs: dict[int, TaskEnv] = {}
        self._policy: Policy | None = None

    def env(self, episodes: int) -> TaskEnv:
        """The environments of a batch, made when they are first needed."""
        size = min(max(episodes, FEWEST), self._config.eval_envs)
        if size not in self._envs:
            self._envs[size] = TaskEnv(self._make_task(size))
        return self._envs[size]

    def __call__(self, batch: Batch, check: Callable[[], None] = lambda: None) -> np.ndarray:
        """Rows (n, k) of an evaluation's table; `check` is called every control step."""
        weights, seed, episodes = batch
        env = self.env(episodes)
        act = no_correction(env.sizes[1]) if weights is None else self._greedy(weights, env)

        def checked(observation: Tensor) -> Tensor:
            check()
            return act(observation)

        with one_thread(), torch.random.fork_rng(devices=[]):  # products on more threads are rounded otherwise
            return run_batch(env, checked, seed)[:episodes].numpy(force=True)

    def _greedy(self, weights: Weights, env: TaskEnv) -> Act:
        """The policy with these weights. It always computes `eval_envs` rows, because a matrix product of fewer rows
        is rounded otherwise, and contacts make much of it."""
        if self._policy is None:
            with torch.random.fork_rng(devices=[]):
                self._policy = make_learner(self._config, *env.sizes, env.agents).policy
        policy = self._policy
        policy.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})

        def act(observation: Float[Tensor, "n o"]) -> Float[Tensor, "n a"]:
            rows = observation.new_zeros(self._config.eval_envs, observation.shape[1])
            rows[: len(observation)] = observation
            return policy.greedy(rows)[: len(observation)]

        return act

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs.values():
            env.close()
