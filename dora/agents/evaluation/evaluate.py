"""Evaluation: statistics of episodes on fixed seeds, with a policy that does not explore."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor

from dora.agents.collecting.task_env import EpisodeColumns, TaskEnv

PERIODIC_SEED = 1_000_000_000
"""Seed of the first episode of evaluations during training; all training seeds are smaller."""
FINAL_SEED = 1_500_000_000
"""Seed of the first episode of the evaluation that `result.json` reports."""

Act = Callable[[Float[Tensor, "n o"]], Float[Tensor, "n a"]]


def no_correction(action_size: int) -> Act:
    """A policy whose action is always zero: with guidance, the uncorrected reference."""

    def act(observation: Float[Tensor, "n o"]) -> Float[Tensor, "n a"]:
        return torch.zeros(len(observation), action_size)

    return act


@dataclass(frozen=True)
class Evaluation:
    """Statistics of evaluation episodes, one row each.

    columns: names of the columns of `table`.
    table: (E, K) values at the end of each episode.
    """

    columns: EpisodeColumns
    table: Float[Tensor, "e k"]

    def values(self, name: str) -> Float[Tensor, " e"]:
        """One column, sums of logged terms as means per step."""
        return self.columns.column(self.table, name)

    @property
    def success_rate(self) -> float:
        """Share of episodes that end in success."""
        return float(self.values("success").mean())

    @property
    def return_mean(self) -> float:
        """Mean sum of rewards."""
        return float(self.values("return").mean())

    @property
    def stage_rates(self) -> dict[str, float]:
        """Share of episodes that reached each stage."""
        prefix = "stage/"
        return {
            name.removeprefix(prefix): float(self.values(name).mean())
            for name in self.columns.highest
            if name.startswith(prefix)
        }

    def penetration_mm(self, quantile: float = 1.0) -> float | None:
        """Quantile over the episodes of their largest penetration [mm]; None if the task reports none."""
        if "penetration_mm" not in self.columns.highest:
            return None
        return float(self.values("penetration_mm").quantile(quantile))

    @property
    def penetration_p95_mm(self) -> float | None:
        """95th percentile over the episodes of their largest penetration [mm]; None if the task reports none."""
        return self.penetration_mm(0.95)

    def rows(self) -> tuple[tuple[str, ...], list[list[Any]]]:
        """Header and rows of `eval.csv`: episode number, then every column."""
        names = tuple(n for n in self.columns.names if n != "whole")
        values = torch.stack([self.values(n) for n in names], 1).tolist()
        return ("episode", *names), [[i, *row] for i, row in enumerate(values)]


@torch.no_grad()
def run_batch(env: TaskEnv, act: Act, first_seed: int) -> Float[Tensor, "n k"]:
    """One episode per environment, with seeds first_seed, first_seed + 1, ...; their rows of an evaluation's table.

    Environments whose episode has ended go on stepping, uncounted, until all have ended.
    """
    n = env.batch_size[0]
    data = env.restart([first_seed + row for row in range(n)])
    table = torch.zeros_like(data["statistics"])
    running = torch.ones(n, dtype=torch.bool)
    while running.any():
        action = act(data["observation"])
        data = env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]
        ended = running & data["done"][:, 0]
        table[ended] = data["statistics"][ended]
        running &= ~ended
    return table


def outcome(evaluation: Evaluation, zero: Evaluation | None) -> str:
    """One line about the last evaluation of a policy and, if there is a prior, of zero correction."""
    text = f"success {evaluation.success_rate:.3f}"
    if zero is not None:
        text += f", without any correction {zero.success_rate:.3f}"
    depth = evaluation.penetration_p95_mm
    return text + (f", penetration p95 {depth:.1f} mm" if depth is not None else "")
