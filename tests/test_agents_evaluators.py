"""Evaluation on several cores: the same rows as on one, and no process left behind."""

import dataclasses
import functools
import multiprocessing
import os
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from typing import Any

import pytest
import torch
from fake_task import PointMass
from torch import Tensor

from dora.agents.config import PPOConfig, RunConfig
from dora.agents.evaluation.evaluators import Evaluators
from dora.agents.learners.learner import make_learner
from dora.errors import InputError

EPISODES = 30
"""Three batches and a part of one."""
CONFIG = RunConfig("Fake-v1", "ppo", "affordance", workers=2, eval_envs=8, learner=PPOConfig(hidden=(16,)))


FAILURES: dict[str, Callable[[], Any]] = {
    "ends": lambda: os._exit(3),
    "fails": lambda: {}["no step here"],
    "refuses": lambda: (_ for _ in ()).throw(InputError("The action is NaN.")),
}
"""What a step does in a helper."""


class FailsElsewhere(PointMass):
    """A task that breaks in every process but the one named."""

    def __init__(self, num_envs: int, home: int, failure: str):
        super().__init__(num_envs)
        self.home, self.failure = home, failure

    def step(self, action: Tensor) -> Any:
        if os.getpid() != self.home:
            FAILURES[self.failure]()
        return super().step(action)


def helpers() -> list[BaseProcess]:
    """Helper processes of this one that have not ended."""
    return multiprocessing.active_children()


def test_processes_give_the_rows_of_one_process():
    alone, shared = (Evaluators(PointMass, dataclasses.replace(CONFIG, workers=workers)) for workers in (1, 2))
    torch.manual_seed(0)
    policy = make_learner(CONFIG, *alone.sizes).policy
    for acting in (policy, None):
        one, two = (evaluators.run(acting, EPISODES, 100) for evaluators in (alone, shared))
        assert len(one.table) == EPISODES
        assert torch.equal(one.table, two.table)
    policy.normaliser.shift.add_(1.0)  # another policy, whose weights have to arrive
    one, two = (evaluators.run(policy, EPISODES, 100) for evaluators in (alone, shared))
    assert torch.equal(one.table, two.table)
    assert len(helpers()) == 1
    alone.close()
    shared.close()
    assert not helpers()


@pytest.mark.parametrize(
    ("failure", "error", "message"),
    [
        ("ends", RuntimeError, "a worker process died"),
        ("fails", KeyError, "no step here"),
        ("refuses", InputError, "^The action is NaN.$"),
    ],
)
def test_a_failing_helper_is_reported_and_ended(failure: str, error: type[Exception], message: str):
    make = functools.partial(FailsElsewhere, home=os.getpid(), failure=failure)
    evaluators = Evaluators(make, CONFIG)
    with pytest.raises(error, match=message):
        evaluators.run(None, EPISODES, 0)
    assert not helpers()
    evaluators.close()


def test_an_interrupt_ends_the_helpers():
    def interrupted() -> None:
        raise KeyboardInterrupt

    evaluators = Evaluators(PointMass, CONFIG)
    with pytest.raises(KeyboardInterrupt):
        evaluators.run(None, EPISODES, 0, interrupted)
    assert not helpers()
    evaluators.close()


def test_a_helper_that_is_gone_is_reported():
    evaluators = Evaluators(PointMass, CONFIG)
    evaluators.run(None, EPISODES, 0)
    [helper] = helpers()
    helper.kill()
    helper.join()
    with pytest.raises(RuntimeError, match="a worker process died"):
        evaluators.run(None, EPISODES, 0)
    assert not helpers()
    evaluators.close()
