"""A task's Markov decision process as data: stages, reward terms, observations, failure and success."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic

import torch
from jaxtyping import Bool
from torch import Tensor

from dora.tasks.mdp.memory import EpisodeMemory
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.rewards import Terms
from dora.tasks.mdp.snapshot import ObjectState, S, Snapshot
from dora.tasks.mdp.stages import Stage

BELOW_TABLE = -0.05
"""Height below which an object has left the table [m]."""
KNOCKED_AWAY = 0.6
"""Horizontal distance from its start at which an object has been knocked out of reach [m]."""


def left_table(s: Snapshot, memory: EpisodeMemory) -> Bool[Tensor, " n"]:
    """An object has left the table or the robot's reach; nothing can mend the episode."""
    return torch.stack([gone(o, KNOCKED_AWAY) for o in s.objects.values()]).any(0)


def gone(o: ObjectState, reach: float) -> Bool[Tensor, " n"]:
    """Whether an object has fallen off the table, or is farther from its start than `reach` [m], seen from above."""
    away = (o.p[:, :2] - o.start_p[:, :2]).norm(dim=-1)
    return (o.p[:, 2] < BELOW_TABLE) | (away > reach)


@dataclass(frozen=True)
class Mdp(Generic[S]):
    """What a task asks for; everything is a pure function of a snapshot and of what the episode remembers.

    Attributes:
        stages: the sub-tasks, in order; or those of each arm, by its name, which are done side by side.
        terms: the reward's terms.
        paper_terms: the printed reward, corrected (`reward_mode="paper"`).
        penetration_limit: largest overlap in an episode that counts as a success [m].
        observations: entries beyond those of every task.
        failed: snapshot, memory -> (n,) bool: nothing can mend the episode.
        failure: what has happened then, in words.
    """

    stages: Sequence[Stage[Any]] | Mapping[str, Sequence[Stage[Any]]]
    terms: Terms[Any]
    paper_terms: Terms[Any]
    penetration_limit: float
    observations: Mapping[str, Entry] = field(default_factory=dict)
    failed: Callable[[Any, EpisodeMemory], Bool[Tensor, " n"]] = left_table
    failure: str = "an object has left the table or the reach of the arm"

    def verdict(
        self, finished: Bool[Tensor, " n"], unreachable: Bool[Tensor, " n"], s: S, memory: EpisodeMemory
    ) -> dict[str, Bool[Tensor, " n"]]:
        """What the episodes count as now.

        Args:
            finished: all stages are done, now or earlier.
            unreachable: no candidate could be reached, which fails the episode at once.
            s: the present state.
            memory: what is remembered of the episodes.

        Returns:
            `fail`: nothing can mend the episode, such as that of a jug that was dropped, now or earlier. `raw_success`:
            finished and not failed. `success`: besides, no overlap of the episode was above the limit.
            `success_at_end`: besides, this very state passes the test of the last stage (of every arm), without
            its hold.
        """
        failed = self.failed(s, memory) | memory.episode.failed.bool() | unreachable
        raw = finished & ~failed
        success = raw & (memory.max_penetration <= self.penetration_limit)
        if isinstance(self.stages, Mapping):
            now = success & torch.stack([ladder[-1].done(s.of(arm)) for arm, ladder in self.stages.items()]).all(0)
        else:
            now = success & self.stages[-1].done(s)
        return {"success": success, "raw_success": raw, "success_at_end": now, "fail": failed}
