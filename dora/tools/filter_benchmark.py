"""How well f_reach tells what can be carried out: outcomes of candidates that it accepts and that it rejects.

Episodes follow candidates whether f_reach accepts them or not: those that the task would choose without the filter
("nearest"), or random ones, half of them rejected ("random"). What is rejected has to fail at least twice as often as
what is accepted, or the filter does not pay. `dora bench filter DoraJug-v1` prints both.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isnan
from typing import Any, Literal

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from dora.affordance.reach.approach_paths import OK, REASONS
from dora.errors import InputError
from dora.parallel import one_thread
from dora.progress import ProgressDisplay
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


@dataclass(frozen=True)
class Outcomes:
    """Of e episodes: `reason`, an index into `REASONS`, of the candidate that was followed, and `success`."""

    reason: Int[Tensor, " e"]
    success: Bool[Tensor, " e"]

    def failure_rates(self) -> tuple[float, float]:
        """Share of accepted and of rejected candidates that failed; NaN without any."""
        accepted, failed = self.reason == OK, (~self.success).float()
        return failed[accepted].mean().item(), failed[~accepted].mean().item()

    def summary(self) -> dict[str, int | float | None]:
        """Numbers of accepted and of rejected candidates, and the shares that failed; None without any."""
        accepted, rejected = (None if isnan(rate) else rate for rate in self.failure_rates())
        count = int((self.reason == OK).sum())
        return {
            "accepted": count,
            "rejected": len(self.reason) - count,
            "accepted_failed": accepted,
            "rejected_failed": rejected,
        }


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


@one_thread()
def outcomes(
    env_id: str,
    episodes: int,
    preset: str,
    choice: Choice,
    config: dict[str, Any] | None = None,
    act: Callable[[Tensor], Tensor] | None = None,
) -> Outcomes:
    """Runs episodes without the filter; on one thread, since products of `act` are rounded otherwise on many.

    Args:
        env_id: of a task of one arm with a table of f_reach.
        episodes: how many, rounded up to batches of 64.
        preset: how much they are randomised.
        choice: how candidates are chosen.
        config: numbers of the task, as for `make_task`.
        act: gives actions (64, a) for observations (64, o); zero correction if it is left out.

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
            obs, _ = task.reset(seed=SEED + batch)
            reasons.append(_followed(task))
            won.append(play_out(task, act or (lambda _: torch.zeros(BATCH, task.action_size)), obs)[0].cpu())
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
