"""Evaluation on several cores: batches of episodes are dealt out to this process and to helper processes."""

import functools
import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np
import torch
from torch import Tensor

from dora.agents.collecting.rollouts import sigint_blocked
from dora.agents.collecting.task_env import TaskEnv, TaskFactory
from dora.agents.config import RunConfig
from dora.agents.evaluation.evaluate import FINAL_SEED, Act, Evaluation, no_correction, run_batch
from dora.agents.learners.learner import make_learner
from dora.agents.learners.networks import Policy
from dora.errors import InputError

POLL_SECONDS = 0.2
"""Time between two looks for Ctrl-C while helpers finish [s]."""
END_SECONDS = 5.0
"""Helpers that have not ended by then are killed [s]."""

HELPER = "dora-evaluator"
"""Name of helper processes."""

Weights = dict[str, np.ndarray]
"""A policy's parameters and buffers; torch would send tensors as shared files."""
Tables = dict[int, np.ndarray]
"""Rows of an evaluation's table by the number of their first episode."""


class Evaluators:
    """Evaluates policies in this process and in helpers, which start when there is something to do for them.

    A batch of `config.eval_envs` episodes gives the same rows in whatever process it runs. Helpers ignore Ctrl-C and
    end with this process, also when that is killed.

    Args:
        make_task: makes a batch of `config.eval_envs` tasks.
        config: settings of the run; up to `workers` processes evaluate, this one included.
    """

    def __init__(self, make_task: TaskFactory, config: RunConfig):
        self.env, self._config = TaskEnv(make_task()), config
        self.sizes = (
            self.env.observation_spec["observation"].shape[-1],
            self.env.action_spec.shape[-1],
        )
        self._start = functools.partial(_Helper, make_task, config, self.sizes)
        self._most = max(config.workers, 1) - 1
        self._helpers: list[_Helper] = []

    def run(
        self, policy: Policy | None, episodes: int, first_seed: int, check: Callable[[], None] = lambda: None
    ) -> Evaluation:
        """Run `episodes` episodes with seeds first_seed, first_seed + 1, ...

        Args:
            policy: acts, greedily; None for no correction.
            episodes: how many.
            first_seed: of the first one.
            check: called every control step; what it raises ends the evaluation, and the helpers.

        Raises:
            InputError: if a task raised one, here or in a helper.
            RuntimeError: if a helper failed otherwise, with its reason.
        """
        starts = range(0, episodes, self.env.batch_size[0])
        while len(self._helpers) < min(self._most, len(starts) - 1):
            self._helpers.append(self._start())
        shares = [starts[i :: len(self._helpers) + 1] for i in range(len(self._helpers) + 1)]
        act = no_correction(self.sizes[1]) if policy is None else policy.greedy
        weights = None if policy is None else {k: v.numpy(force=True) for k, v in policy.state_dict().items()}
        try:
            for helper, share in zip(self._helpers, shares[1:], strict=True):
                helper.begin(weights, share, first_seed)
            tables = _tables(self.env, act, shares[0], first_seed, check)
            for helper in self._helpers:
                tables |= helper.finish(check)
        except BaseException:
            self._end_helpers()
            raise
        return Evaluation(
            self.env.columns, torch.from_numpy(np.concatenate([tables[start] for start in starts])[:episodes])
        )

    def final(self, policy: Policy, check: Callable[[], None] = lambda: None) -> tuple[Evaluation, Evaluation | None]:
        """Evaluate a policy, and no correction if there is a prior, on `config.final_episodes` seeds that chose
        nothing; arguments and errors as for `run`."""
        episodes = self._config.final_episodes
        evaluation = self.run(policy, episodes, FINAL_SEED, check)
        return evaluation, self.run(None, episodes, FINAL_SEED, check) if self._config.has_prior else None

    def close(self) -> None:
        """End the helpers and close the environments."""
        self._end_helpers()
        self.env.close()

    def _end_helpers(self) -> None:
        for helper in self._helpers:
            helper.end()
        self._helpers.clear()


def _tables(env: TaskEnv, act: Act, starts: range, first_seed: int, check: Callable[[], None]) -> Tables:
    def checked(observation: Tensor) -> Tensor:
        check()
        return act(observation)

    with torch.random.fork_rng(devices=[]), torch.no_grad():
        return {start: run_batch(env, checked, first_seed + start).numpy(force=True) for start in starts}


class _Helper:
    """A process with tasks of its own.

    Args:
        make_task, config: as for `Evaluators`.
        sizes: of observation and action.
    """

    def __init__(self, make_task: TaskFactory, config: RunConfig, sizes: tuple[int, int]):
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        arguments = (theirs, make_task, config, sizes)
        self._process = context.Process(target=_serve, args=arguments, name=HELPER, daemon=True)
        with sigint_blocked():
            self._process.start()
        theirs.close()

    def begin(self, weights: Weights | None, starts: range, first_seed: int) -> None:
        """Ask for the batches whose first episodes are `starts`, with these weights; None for no correction.

        Raises:
            RuntimeError: if the process has ended.
        """
        try:
            self._pipe.send((weights, starts, first_seed))
        except BrokenPipeError:
            raise self._ended() from None

    def finish(self, check: Callable[[], None]) -> Tables:
        """Wait for what `begin` asked for, calling `check` now and then.

        Raises:
            InputError: with the message of the process, if it raised one.
            RuntimeError: if the process failed otherwise or ended, with its reason.
        """
        while not self._pipe.poll(POLL_SECONDS):
            check()
        try:
            answer = self._pipe.recv()
        except EOFError:
            raise self._ended() from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _ended(self) -> RuntimeError:
        self._process.join(END_SECONDS)
        return RuntimeError(f"a process that evaluates ended with status {self._process.exitcode}")

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self._pipe.close()
        self._process.terminate()
        self._process.join(END_SECONDS)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(pipe: Connection, make_task: TaskFactory, config: RunConfig, sizes: tuple[int, int]) -> None:
    """Evaluates what comes through the pipe until its other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def check() -> None:
        if not parent.is_alive():
            raise SystemExit

    torch.set_num_threads(1)
    policy = make_learner(config, *sizes).policy
    env = TaskEnv(make_task())
    while True:
        try:
            weights, starts, first_seed = pipe.recv()
        except EOFError:
            return
        try:
            act = no_correction(sizes[1])
            if weights is not None:
                policy.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
                act = policy.greedy
            pipe.send(_tables(env, act, starts, first_seed, check))
        except InputError as error:
            pipe.send(error)
        except Exception as error:
            pipe.send(RuntimeError(f"a process that evaluates failed: {type(error).__name__}: {error}"))
