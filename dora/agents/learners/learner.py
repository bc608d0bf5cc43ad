"""What the training loop needs of an algorithm, and which algorithm a run's settings ask for."""

from typing import Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from torch import nn

from dora.agents.agent_columns import Agents
from dora.agents.config import HAPPOConfig, MAPPOConfig, RunConfig, SACConfig
from dora.agents.learners.multi_agent import MultiAgentPPO
from dora.agents.learners.networks import Policy
from dora.agents.learners.ppo import PPO
from dora.agents.learners.replay import Replay
from dora.agents.learners.sac import SAC
from dora.agents.learners.stopping import Stop, never


@runtime_checkable
class Learner(Protocol):
    """What the training loop needs of an algorithm."""

    policy: Policy
    """Acts while transitions are collected, and greedily in evaluations."""
    rollout: int
    """Control steps per environment and batch."""

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

    def update(self, batch: TensorDictBase, stop: Stop = never) -> dict[str, float]:
        """Learn from a batch (N, T) of fresh transitions; losses and other values by name.

        `stop` is asked before every gradient step: once it says yes, no further one is taken. The batch counts as
        learned from, and what a checkpoint would hold is whole.
        """
        ...

    def counters(self) -> dict[str, float]:
        """Numbers besides the modules' that a checkpoint has to keep."""
        ...

    def set_counters(self, counters: dict[str, float]) -> None:
        """Restore `counters`."""
        ...


def agents_of(config: RunConfig, agents: Agents) -> Agents:
    """The agents of a task that the learner of a run tells apart; none where one sees and commands everything."""
    return agents if isinstance(config.learner, MAPPOConfig | HAPPOConfig) and len(agents) > 1 else {}


def make_learner(config: RunConfig, observation: int, action: int, agents: Agents | None = None) -> Learner:
    """The learner of a run, with weights drawn from torch's global generator.

    Args:
        config: settings of the run.
        observation: number of observation components.
        action: number of action components.
        agents: of the task. MAPPO and HAPPO with less than two are PPO.
    """
    settings, several = config.learner, agents_of(config, agents or {})
    sizes = observation, action, config.normaliser_samples
    if isinstance(settings, SACConfig):
        return SAC(settings, *sizes)
    if several:
        return MultiAgentPPO(settings, *sizes, several)
    return PPO(settings, *sizes)
