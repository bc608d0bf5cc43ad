"""Evaluation on several cores: the same rows as on one, and no process left behind."""

import dataclasses
import functools
import os
import subprocess
from typing import Any

import pytest
import torch
from fake_task import PointMass
from torch import Tensor

from dora.agents.config import PPOConfig, RunConfig
from dora.agents.evaluators import Evaluators
from dora.agents.learner import make_learner

EPISODES = 30
"""Three batches and a part of one."""
CONFIG = RunConfig("Fake-v1", "ppo", "affordance", workers=2, eval_envs=8, learner=PPOConfig(hidden=(16,)))


class FailsElsewhere(PointMass):
    """A task that breaks in every process but the one named."""

    def __init__(self, num_envs: int, home: int):
        super().__init__(num_envs)
        self.home = home

    def step(self, action: Tensor) -> Any:
        if os.getpid() != self.home:
            raise ValueError("no step here")
        return super().step(action)


def children() -> list[str]:
    """Processes started by this one that evaluate."""
    command = ["ps", "--ppid", str(os.getpid()), "-o", "pid=,args="]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    return [line for line in lines if "spawn_main" in line]


def test_processes_give_the_rows_of_one_process():
    before = children()
    alone, shared = (
        Evaluators(functools.partial(PointMass, CONFIG.eval_envs), dataclasses.replace(CONFIG, workers=workers))
        for workers in (1, 2)
    )
    torch.manual_seed(0)
    policy = make_learner(CONFIG, *alone.sizes).policy
    for acting in (policy, None):
        one, two = (evaluators.run(acting, EPISODES, 100) for evaluators in (alone, shared))
        assert len(one.table) == EPISODES
        assert torch.equal(one.table, two.table)
    policy.normaliser.shift.add_(1.0)  # another policy, whose weights have to arrive
    one, two = (evaluators.run(policy, EPISODES, 100) for evaluators in (alone, shared))
    assert torch.equal(one.table, two.table)
    assert len(children()) == len(before) + 1
    alone.close()
    shared.close()
    assert children() == before


def test_a_failing_helper_is_reported_and_ended():
    evaluators = Evaluators(functools.partial(FailsElsewhere, CONFIG.eval_envs, os.getpid()), CONFIG)
    with pytest.raises(RuntimeError, match="ValueError: no step here"):
        evaluators.run(None, EPISODES, 0)
    assert not children()
    evaluators.close()


def test_an_interrupt_ends_the_helpers():
    def interrupted() -> None:
        raise KeyboardInterrupt

    evaluators = Evaluators(functools.partial(PointMass, CONFIG.eval_envs), CONFIG)
    with pytest.raises(KeyboardInterrupt):
        evaluators.run(None, EPISODES, 0, interrupted)
    assert not children()
    evaluators.close()
