"""Collectors on a Ray cluster: the same batches as those of processes, and a sentence when one fails or dies."""

import functools
import os
import signal
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from fake_task import PointMass
from torch import Tensor

from dora.agents.collecting.rollouts import Rollouts
from dora.agents.collecting.task_env import TrainingRules
from dora.agents.config import PPOConfig
from dora.agents.learners.networks import Policy, last_layer
from dora.agents.learners.ppo import PPO
from dora.errors import InputError, WorkerFailure

ray: Any = pytest.importorskip("ray")
pytestmark = pytest.mark.slow


class Drifting(PointMass):
    """A task that refuses its actions after some steps."""

    def step(self, action: Tensor) -> Any:
        if int(self.elapsed_steps.max()) == 5:
            raise InputError("The action of environment 3 is NaN: send finite numbers.")
        return super().step(action)


class Dying(PointMass):
    """A task whose process dies after some steps."""

    def step(self, action: Tensor) -> Any:
        if int(self.elapsed_steps.max()) == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # workers import these modules, too
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield
    ray.shutdown()
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


def rollouts(policy: Policy, make: Any = PointMass, workers: int = 2, **options: Any) -> Rollouts:
    return Rollouts(
        functools.partial(make, 4), policy, workers=workers, num_envs=4, rollout=8, seeds=list(range(workers)),
        rules=TrainingRules(), **options,
    )  # fmt: skip


def learner() -> PPO:
    return PPO(PPOConfig(rollout=16, minibatch=128, hidden=(32, 32)), 4, 2, 1000)


@pytest.mark.parametrize("ahead", [False, True])
def test_batches_are_those_of_processes(ahead: bool):
    ppo = learner()
    found: list[list[Tensor]] = []
    for cluster in (False, True):
        last_layer(ppo.actor.mean).bias.data.zero_()
        batches = []
        with rollouts(ppo.policy, cluster=cluster, ahead=ahead) as source, torch.no_grad():
            for call in range(3):
                batch = source.collect()
                assert batch.shape == (8, 8)
                batches.append(torch.cat([batch["observation"], batch["action"]], -1).clone())
                last_layer(ppo.actor.mean).bias.fill_(call + 1.0)
        found.append(batches)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    assert not torch.equal(found[0][0][..., 4:], found[0][2][..., 4:])


def test_what_a_worker_says_arrives():
    with (
        rollouts(learner().policy, Drifting, cluster=True) as source,
        pytest.raises(InputError, match="3 is NaN") as caught,
    ):
        source.collect()
    assert "\n" not in str(caught.value)


def test_a_worker_that_dies_is_told():
    with (
        rollouts(learner().policy, Dying, cluster=True) as source,
        pytest.raises(WorkerFailure, match=r"A worker of the cluster died"),
    ):
        source.collect()


def test_more_workers_than_cores_are_refused():
    with pytest.raises(InputError, match=r"has 2 cores, and --workers is 3: use at most 2\."):
        rollouts(learner().policy, workers=3, cluster=True)
