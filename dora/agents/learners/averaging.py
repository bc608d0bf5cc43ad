"""The average of the policies of successive iterations, which is evaluated and kept in place of the latest one.

A policy gradient from few episodes moves the policy as much by chance as by what was learned. The average of the
parameters over the last iterations (Polyak and Juditsky 1992) is moved less by chance; it never acts in training.
"""

import copy

import torch
from torch import nn

from dora.agents.learners.networks import Policy


class AveragedPolicy:
    """Parameters p' <- decay p' + (1 - decay) p of the actor of a policy, whose normaliser is shared.

    Args:
        policy: that learns; made just now, with the actor that the average begins with.
        decay: share of the average that an iteration keeps, in [0, 1) [1]; 0: the average is the policy itself.
    """

    def __init__(self, policy: Policy, decay: float):
        self._learning, self._decay = policy, decay
        self.policy = Policy(policy.normaliser, copy.deepcopy(policy.actor)) if decay > 0.0 else policy

    @property
    def modules(self) -> dict[str, nn.Module]:
        """What a checkpoint holds besides the actor that learns, by name."""
        return {} if self.policy is self._learning else {"averaged": self.policy.actor}

    @torch.no_grad()
    def follow(self) -> None:
        """Take in the parameters that an iteration ended with."""
        if self.policy is self._learning:
            return
        pairs = zip(self.policy.actor.parameters(), self._learning.actor.parameters(), strict=True)
        for averaged, latest in pairs:
            averaged.lerp_(latest, 1.0 - self._decay)
