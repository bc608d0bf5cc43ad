"""Gradient steps per second of a learner, against the same update in plain torch."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict

from dora.agents.config import RunConfig, SACConfig
from dora.agents.learners.learner import make_learner
from dora.agents.learners.plain_torch import PlainPPO, PlainSAC, plain_batch
from dora.agents.learners.ppo import PPO
from dora.agents.learners.sac import SAC
from dora.errors import InputError

REFERENCES = ("ppo", "sac")
"""Learners whose update is there in plain torch."""
WARM_UP = 2
"""Updates before the time is taken."""
TURNS = 3
"""Turns of both, so that what else the machine does falls on both; each figure is that of its best turn."""
EPISODE = 100
"""Mean length of the episodes that are made up [control steps]."""


@dataclass(frozen=True)
class LearnerSpeed:
    """How fast a learner learns.

    Attributes:
        agent: its name.
        updates_per_second: gradient steps of it.
        samples_per_second: transitions that these steps use.
        reference_updates_per_second: gradient steps of the same update in plain torch.
        ratio: of ours to the reference.
        observation, action: numbers of components.
        transitions: of a batch that is learned from.
        threads: of torch.
    """

    agent: str
    updates_per_second: float
    samples_per_second: float
    reference_updates_per_second: float
    ratio: float
    observation: int
    action: int
    transitions: int
    threads: int


def made_up_batch(config: RunConfig, observation: int, action: int, seed: int = 0) -> TensorDict:
    """A batch (environments, control steps) as a collector gives it, of numbers that mean nothing."""
    generator = torch.Generator().manual_seed(seed)
    n, t = config.num_envs * max(config.workers, 1), config.learner.rollout

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator)

    done = torch.rand(n, t, 1, generator=generator) < 1 / EPISODE
    following = {"observation": normal(n, t, observation), "reward": normal(n, t, 1), "done": done,
                 "terminated": torch.zeros_like(done)}  # fmt: skip
    acted = (0.3 * normal(n, t, action)).clamp(-0.99, 0.99)
    log_prob = torch.distributions.Normal(0.0, 0.3).log_prob(acted).sum(-1)
    return TensorDict(
        {"observation": normal(n, t, observation), "action": acted, "action_log_prob": log_prob, "next": following},
        [n, t],
    )


def measure(config: RunConfig, observation: int, action: int, seconds: float) -> LearnerSpeed:
    """Times the updates of a run's learner and those of the same in plain torch, in turn.

    SAC learns from its first batch on, and its actor from the first gradient step, so that every update that is counted
    takes the steps of one in the middle of a run.

    Args:
        config: settings of the run; its learner is PPO or SAC.
        observation, action: numbers of components of the task.
        seconds: length of each turn [s].

    Raises:
        InputError: there is no reference of this learner.
    """
    if config.agent not in REFERENCES:
        raise InputError(f"There is no reference of {config.agent}: use --agent with one of {', '.join(REFERENCES)}.")
    torch.set_num_threads(config.learner_threads)
    torch.manual_seed(0)
    if isinstance(config.learner, SACConfig):
        config = replace(config, learner=replace(config.learner, warmup=0, critic_only=0))
    learner = make_learner(config, observation, action)
    batch = made_up_batch(config, observation, action)
    if isinstance(learner, SAC):
        plain, each = PlainSAC(learner, observation, action), config.learner.batch
        steps = batch.numel() * config.learner.updates_per_step
    else:
        assert isinstance(learner, PPO)
        learner.update(batch)  # the first one only sets the normaliser
        plain, each = PlainPPO(learner), min(config.learner.minibatch, batch.numel())
        steps = config.learner.epochs * -(-batch.numel() // config.learner.minibatch)
    tensors = plain_batch(batch)
    sides: list[Callable[[], object]] = [lambda: learner.update(batch), lambda: plain.update(tensors)]
    best = [0.0, 0.0]
    for turn in range(TURNS):
        for k, update in enumerate(sides):
            best[k] = max(best[k], steps * _updates_per_second(update, seconds, 0 if turn else WARM_UP))
    ours, theirs = best
    return LearnerSpeed(
        config.agent, ours, ours * each, theirs, ours / theirs, observation, action, batch.numel(),
        torch.get_num_threads(),
    )  # fmt: skip


def _updates_per_second(update: Callable[[], object], seconds: float, before: int) -> float:
    """Rate at which an update can be repeated.

    Args:
        update: is called again and again.
        seconds: for which [s].
        before: calls that are not counted.
    """
    for _ in range(before):
        update()
    count, start = 0, time.perf_counter()
    while (passed := time.perf_counter() - start) < seconds:
        update()
        count += 1
    return count / passed
