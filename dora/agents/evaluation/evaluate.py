"""Evaluation: statistics of episodes on fixed seeds, with a policy that does not explore."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor

from dora.agents.collecting.task_env import EpisodeColumns, TaskEnv
from dora.agents.seeds import STARTS
from dora.errors import InputError
from dora.tables import share_text, wilson

PERIODIC_SEED = 1_000_000_000
"""Seed of the first episode of evaluations during training; all training seeds are smaller."""
FINAL_SEED = 1_500_000_000
"""Seed of the first episode of the evaluation at the end of training."""
MOST_SEEDS = 200_000
"""Values of `--seed` whose starts have seeds that NumPy takes [1]: all are below 2^32."""
ROUNDING = 1e-9
"""Of a share times a number of episodes [1]."""

Act = Callable[[Float[Tensor, "n o"]], Float[Tensor, "n a"]]


def first_seed(seed: int, episodes: int) -> int:
    """Seed of the first episode of an evaluation on the starts of `seed`; no start belongs to two values of `seed`, to
    training, or to an evaluation during or at the end of it.

    Raises:
        InputError: if there are no such starts, or fewer than `episodes`.
    """
    if not 0 <= seed < MOST_SEEDS:
        raise InputError(f"--seed is {seed}; evaluation has starts for seeds from 0 to {MOST_SEEDS - 1}.")
    if episodes > STARTS:
        raise InputError(f"--episodes is {episodes}; a --seed of evaluation has {STARTS} starts: choose fewer.")
    return FINAL_SEED + STARTS * (seed + 1)


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
    first_seed: seed of the first episode; those of the others follow.
    ranking_steps: simulated steps that ranking the task's candidates took; None if the task does not say.
    starts: (E,) numbers by name that say how each episode began, as far as the task does.
    """

    columns: EpisodeColumns
    table: Float[Tensor, "e k"]
    first_seed: int = FINAL_SEED
    ranking_steps: int | None = None
    starts: Mapping[str, Float[Tensor, " e"]] = field(default_factory=dict)

    def values(self, name: str) -> Float[Tensor, " e"]:
        """One column, sums of logged terms as means per step."""
        return self.columns.column(self.table, name)

    @property
    def success_rate(self) -> float:
        """Share of episodes that count as successes when they end."""
        return float(self.values("success").mean())

    def reaches(self, share: float) -> bool:
        """Whether at least this share of the episodes succeeded. Counts tell: 95 of 100 in float32 is less than .95."""
        return int(self.values("success").sum()) >= share * len(self.table) - ROUNDING

    @property
    def success_interval(self) -> tuple[float, float]:
        """Wilson's interval of the success rate."""
        return wilson(round(float(self.values("success").sum())), len(self.table))

    @property
    def success_text(self) -> str:
        """The success rate with its interval."""
        return share_text(self.success_rate, len(self.table))

    @property
    def raw_success_rate(self) -> float | None:
        """The same, overlap not counted; None if the task reports no overlap."""
        return float(self.values("raw_success").mean()) if "raw_success" in self.columns.last else None

    @property
    def success_at_end_rate(self) -> float:
        """Share of episodes that succeed and hold in the last step what was reached, as far as the task says."""
        name = "success_at_end" if "success_at_end" in self.columns.last else "success"
        return float(self.values(name).mean())

    @property
    def nonfinite_episodes(self) -> int:
        """Episodes in which the simulator gave NaN or infinity, as far as the task says."""
        return int(self.values("nonfinite").sum()) if "nonfinite" in self.columns.highest else 0

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
        """Header and rows of `eval.csv`: episode number, every column, and how the episode began as `start/<name>`."""
        names = tuple(n for n in self.columns.names if n != "whole")
        values = torch.stack([self.values(n) for n in names] + list(self.starts.values()), 1).tolist()
        starts = (f"start/{name}" for name in self.starts)
        return ("episode", *names, *starts), [[i, *row] for i, row in enumerate(values)]


@torch.no_grad()
def run_batch(env: TaskEnv, act: Act, first_seed: int) -> Float[Tensor, "n k"]:
    """One episode per environment, with seeds first_seed, first_seed + 1, ...; their rows of an evaluation's table, to
    the right of them the numbers of how they began.

    Environments whose episode has ended go on stepping, uncounted, until all have ended.
    """
    n = env.batch_size[0]
    data = env.restart([first_seed + row for row in range(n)])
    starts = [value[:, None].clone() for value in env.start_numbers.values()]
    table = torch.zeros_like(data["statistics"])
    running = torch.ones(n, dtype=torch.bool)
    while running.any():
        action = act(data["observation"])
        data = env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]
        ended = running & data["done"][:, 0]
        table[ended] = data["statistics"][ended]
        running &= ~ended
    return torch.cat([table, *starts], 1)


def outcome(evaluation: Evaluation, zero: Evaluation | None) -> str:
    """One line about the last evaluation of a policy and, if there is a prior, of zero correction."""
    text = f"success {evaluation.success_text}"
    if zero is not None:
        text += f", without any correction {zero.success_text}"
    depth = evaluation.penetration_p95_mm
    return text + (f", penetration p95 {depth:.1f} mm" if depth is not None else "")
