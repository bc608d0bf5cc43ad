"""What the training loop needs of an algorithm, and which algorithm a run's settings ask for."""

from typing import Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from torch import nn

from dora.agents.config import PPOConfig, RunConfig
from dora.agents.learners.networks import Policy
from dora.agents.learners.ppo import PPO
from dora.agents.learners.replay import Replay
from dora.agents.learners.sac import SAC


@runtime_checkable
class Learner(Protocol):
    """What the training loop needs of an algorithm."""

    policy: Policy
    rollout: int

    @property
    def replay(self) -> Replay | None:
        """Transitions that a checkpoint has to keep, if the algorithm learns from old ones."""
        ...

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Networks and normaliser."""
        ...

    @property
    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimisers."""
        ...

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch (N, T) of fresh transitions; losses and other values by name."""
        ...

    def counters(self) -> dict[str, float]:
        """Numbers besides the modules' that a checkpoint has to keep."""
        ...

    def set_counters(self, counters: dict[str, float]) -> None:
        """Restore `counters`."""
        ...


def make_learner(config: RunConfig, observation: int, action: int) -> Learner:
    """The learner of a run, with weights drawn from torch's global generator."""
    settings = config.learner
    if isinstance(settings, PPOConfig):
        return PPO(settings, observation, action, config.normaliser_samples)
    return SAC(settings, observation, action, config.normaliser_samples)
