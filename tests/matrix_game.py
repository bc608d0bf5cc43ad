"""A game in which each of two agents gains by what both together lose by; `python tests/matrix_game.py` measures it.

The reward is REWARD[a_left, a_right], and both policies begin with action 0 most of the time. Learners are those of
`dora.agents.learners.multi_agent`, with categorical in the place of Gaussian actors.
"""

import itertools
import statistics
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical

from dora.agents.config import PPOConfig
from dora.agents.learners.multi_agent import AgentUpdate, learn_in_order
from dora.agents.learners.ppo import standardised

REWARD = torch.tensor([[0.0, 1.0], [1.0, -4.0]])
LOGITS = [2.0, -2.0]  # of actions 0 and 1 at the beginning
BATCH, ITERATIONS, SEEDS = 2048, 12, 6
SETTINGS: dict[str, Any] = {"epochs": 30, "minibatch": BATCH, "entropy": 0.0, "grad_norm": 1e9}
CLIPS, RATE = (0.2, 0.5), 0.3


class Logits(nn.Module):
    """A policy without observation, by its logits."""

    def __init__(self):
        super().__init__()
        self.logits = nn.Parameter(torch.tensor(LOGITS))

    def forward(self, features: Tensor) -> Tensor:
        return self.logits.expand(*features.shape[:-1], 2)


class Game:
    """Both agents and their learning; `compound` as in `learn_in_order`, the learning rate stays as it is."""

    def __init__(self, seed: int, compound: bool, clip: float, rate: float = RATE):
        self.compound = compound
        self.generator = torch.Generator().manual_seed(seed)
        config = PPOConfig(clip=clip, learning_rate=rate, learning_rate_min=rate, learning_rate_max=rate, **SETTINGS)
        self.actors = [Logits(), Logits()]
        self.updates = [AgentUpdate(str(k), categorical(actor), config) for k, actor in enumerate(self.actors)]

    def value(self) -> float:
        """Expected reward of the present policies."""
        left, right = (actor.logits.detach().softmax(-1) for actor in self.actors)
        return float(left @ REWARD @ right)

    def iterate(self) -> list[dict[str, float]]:
        """One iteration: a batch of rounds, and what `learn_in_order` makes of it."""
        parts = []
        for actor in self.actors:
            log = actor.logits.detach().log_softmax(-1)
            action = torch.multinomial(log.exp(), BATCH, True, generator=self.generator)
            content = {"features": torch.zeros(BATCH, 1), "action": action, "action_log_prob": log[action]}
            parts.append(TensorDict(content, [BATCH]))
        advantage = standardised(REWARD[parts[0]["action"], parts[1]["action"]][:, None])
        order = torch.randperm(2, generator=self.generator).tolist()
        passes = [torch.arange(BATCH)] * SETTINGS["epochs"]
        return learn_in_order(self.updates, parts, advantage, order, passes, compound=self.compound)

    def run(self, iterations: int = ITERATIONS) -> list[float]:
        """Expected reward at the beginning and after each iteration."""
        return [self.value(), *(self.value() for _ in range(iterations) if self.iterate())]


def categorical(actor: Logits) -> ProbabilisticTensorDictSequential:
    """The actor as TorchRL's losses want it."""
    sample = ProbabilisticTensorDictModule(
        in_keys=["logits"], out_keys=["action"], distribution_class=Categorical, return_log_prob=True
    )
    parameters = TensorDictModule(actor, in_keys=["features"], out_keys=["logits"])
    return ProbabilisticTensorDictSequential(parameters, sample)  # pyright: ignore[reportCallIssue,reportArgumentType]


def table() -> str:
    """What each way of learning does, as a Markdown table."""
    rows = [
        "| clip | learner | reward at the end, median (lowest) | iterations that lose more than .02 | largest loss |"
    ]
    rows.append("|---|---|---|---|---|")
    for clip in CLIPS:
        for name, compound in (("MAPPO", False), ("HAPPO", True)):
            runs = [Game(seed, compound, clip).run() for seed in range(SEEDS)]
            changes = [after - before for run in runs for before, after in itertools.pairwise(run)]
            ends, falls = [run[-1] for run in runs], sum(change < -0.02 for change in changes)
            rows.append(
                f"| {clip} | {name} | {statistics.median(ends):.2f} ({min(ends):.2f}) | {falls} of {len(changes)} | "
                f"{max(0.0, -min(changes)):.2f} |"
            )
    return "\n".join(rows)


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(table())
