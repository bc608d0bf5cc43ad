"""How well f_reach tells what the scripted solution can carry out: outcomes of accepted and of rejected candidates.

    python -m dora.tools.filter_benchmark DoraJug-v1 --episodes 1000

Episodes follow candidates whether f_reach accepts them or not, with zero correction: those that the task would choose
without the filter ("nearest"), and random ones, half of them rejected ("random"). What is rejected has to fail at least
twice as often as what is accepted, or the filter does not pay.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
import tyro
from jaxtyping import Bool, Int
from torch import Tensor

from dora.affordance.reach.approach_paths import OK, REASONS
from dora.errors import InputError, command
from dora.progress import ProgressDisplay
from dora.tables import text_table
from dora.tasks import check_task_id, find_task, make_task, task_ids
from dora.tasks.env.env import DoraEnv
from dora.tasks.mdp.guidance_parts import FILTER, PARTS
from dora.tools.episodes import play_out

BATCH = 64
"""Episodes that run together."""
SEED = 90_000
"""First seed; training, evaluation and ranking use none of these."""
REJECTED = 0.5
"""Share of the random candidates that are drawn among the rejected ones, where there are any."""

HEAD = ("f_reach says", "episodes", "success")
"""Head of the table of outcomes."""

Choice = Literal["nearest", "random"]
"""How candidates are chosen."""


@dataclass
class Args:
    """Compare outcomes of candidates that f_reach accepts and rejects."""

    env: tyro.conf.Positional[str]
    """Task with a table of f_reach, for example DoraJug-v1."""
    episodes: int = 1000
    """Episodes of each way of choosing, rounded up to batches of 64."""
    preset: Literal["none", "standard", "hard"] = "standard"
    """How much episodes are randomised."""


@dataclass(frozen=True)
class Outcomes:
    """Of e episodes: `reason`, an index into `REASONS`, of the candidate that was followed, and `success`."""

    reason: Int[Tensor, " e"]
    success: Bool[Tensor, " e"]

    def failure_rates(self) -> tuple[float, float]:
        """Share of accepted and of rejected candidates that failed; NaN without any."""
        accepted, failed = self.reason == OK, (~self.success).float()
        return failed[accepted].mean().item(), failed[~accepted].mean().item()


class _Drawn:
    """Leaves one random candidate for each new episode, accepted by f_reach or not."""

    def __init__(self, task: DoraEnv):
        self._task, self._random = task, torch.Generator().manual_seed(SEED)

    def __call__(self, possible: Bool[Tensor, "b c"]) -> Bool[Tensor, "b c"]:
        accepted = _reasons(self._task) == OK
        share = torch.rand(len(accepted), 1, generator=self._random)
        wanted = torch.where(share < REJECTED, ~accepted, accepted)
        wanted |= ~wanted.any(-1, keepdim=True)
        one = torch.multinomial(wanted.float(), 1, generator=self._random)
        return torch.zeros_like(possible).scatter_(1, one, True)


def _reasons(task: DoraEnv) -> Int[Tensor, "n c"]:
    """What f_reach says of each candidate at the present place of the object; indices into `REASONS`."""
    table, pose = task.arm.reach_table, task.target_object.pose
    assert table is not None
    node, _ = table.grid.nearest(table.places(pose.p, pose.q)[0])
    return table.reason[node].long()


def tabulated_ids() -> list[str]:
    """Ids of the tasks of one arm with a table of f_reach: their object stands on the table at the start."""
    tasks = {env_id: find_task(env_id) for env_id in task_ids()}
    alone = {env_id: task for env_id, task in tasks.items() if len(task.ARMS) == 1}
    return [env_id for env_id, task in alone.items() if task(task.CONFIG()).start_grid(*task.ARMS) is not None]


def outcomes(env_id: str, episodes: int, preset: str, choice: Choice, config: dict[str, Any] | None = None) -> Outcomes:
    """Runs episodes with zero correction and without the filter; `config` as for `make_task`.

    Raises:
        InputError: there is no such task, or it has several arms or no table of f_reach.
    """
    parts = tuple(part for part in PARTS if part != FILTER)
    check_task_id(env_id)
    if env_id not in (able := tabulated_ids()):
        raise InputError(f"{env_id} is no task of one arm with a table of f_reach: choose one of {', '.join(able)}.")
    task = make_task(env_id, BATCH, preset=preset, guidance_parts=parts, config=config)
    task.narrow = {task.arm.name: _Drawn(task)} if choice == "random" else {}
    reasons, won = [], []
    with ProgressDisplay() as phases:
        report, batches = phases.phase(f"{choice} candidates", "episodes"), -(-episodes // BATCH)
        for batch in range(batches):
            task.reset(seed=SEED + batch)
            reasons.append(_followed(task))
            won.append(play_out(task, lambda: torch.zeros(BATCH, task.action_size))[0].cpu())
            report((batch + 1) * BATCH, batches * BATCH)
    task.close()
    return Outcomes(torch.cat(reasons), torch.cat(won))


def _followed(task: DoraEnv) -> Int[Tensor, " n"]:
    """What f_reach says of the candidate that each environment follows."""
    return _reasons(task).gather(1, task.guide.choice.buffers.chosen.long()[:, None])[:, 0].cpu()


def outcome_rows(found: Outcomes) -> list[Sequence[str]]:
    """Outcomes by what f_reach says."""
    rows: list[Sequence[str]] = []
    for index, name in enumerate(REASONS):
        if (found.reason == index).any():
            wins = found.success[found.reason == index].float()
            rows.append((name, str(len(wins)), f"{wins.mean():.3f}"))
    return rows


@command
def main() -> None:
    """Print both comparisons."""
    args = tyro.cli(Args, description=__doc__)
    for choice in ("nearest", "random"):
        found = outcomes(args.env, args.episodes, args.preset, choice)
        accepted, rejected = found.failure_rates()
        print(f"\n{args.env}, {args.preset}, {choice} candidates:\n{text_table(HEAD, outcome_rows(found))}")
        print(f"accepted candidates fail in {accepted:.3f}, rejected ones in {rejected:.3f}")


if __name__ == "__main__":
    sys.exit(main())
