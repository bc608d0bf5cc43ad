"""What a policy observed and did in the last control steps, as a part of its observation."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.tasks.mdp.buffers import Buffers
from dora.tasks.mdp.observations import Entry, columns_by_arm
from dora.tasks.mdp.snapshot import Snapshot

NAME = "history"
"""Name of the entry; with several arms each has one of its own, `<arm>/history`."""


class History:
    """Frames of the last control steps of n environments, newest first: what was observed, and the action after it.

    Where an episode has not had so many steps, its first observation with an action of zero stands for the others.

    Args:
        steps: how many are kept; with 0 there is no entry, and nothing is kept.
        entries: the observation without history.
        actions: number of action components of each arm, by its name.
        num_envs: n.
        device: where the tensors are.

    Attributes:
        entries: what comes to the observation, by name.
        buffers: `count` (n,), steps since the episode began, and `frames` (n, steps, o + a); empty until a first look.
    """

    def __init__(
        self,
        steps: int,
        entries: Mapping[str, Entry],
        actions: Mapping[str, int],
        num_envs: int,
        device: torch.device | str,
    ):
        self.steps, self._observed, self._actions = steps, dict(entries), dict(actions)
        self._num_envs, self._device = num_envs, device
        self.buffers = Buffers(num_envs, device)
        self._columns: dict[str, list[int]] = {}
        self._now: tuple[Snapshot, Tensor] | None = None
        several = len(actions) > 1
        names = {arm: f"{arm}/{NAME}" if several else NAME for arm in actions} if steps else {}
        self.entries = {name: self._entry(arm) for arm, name in names.items()}

    def _entry(self, arm: str) -> Entry:
        about = f"observations and actions of the last {self.steps} control steps, newest first"
        return Entry(lambda s: self._of(s, arm), "of each", about)

    def look(self, s: Snapshot) -> None:
        """Makes the buffers, whose sizes follow from the first observation; `s` is the state as it is observed."""
        if not self.steps or "frames" in self.buffers:
            return
        sizes = {name: entry.value(s).shape[-1] for name, entry in self._observed.items()}
        self._columns, first = columns_by_arm(list(self._actions), sizes), sum(sizes.values())
        for arm, size in self._actions.items():
            self._columns[arm] += range(first, first + size)
            first += size
        self.buffers = Buffers(self._num_envs, self._device, count=(), frames=(self.steps, first))

    def begin(self, rows: Int[Tensor, " b"]) -> None:
        """Forgets the episodes of the environments `rows`."""
        if "count" in self.buffers:
            self.buffers.write(rows, count=0.0)

    def push(self, s: Snapshot, action: Float[Tensor, "n a"] | None) -> None:
        """Takes note of a control step: what was observed before it, and the action; None is zero."""
        if not self.steps:
            return
        self.look(s)
        frames, newest = self._frames(s), self._frame(s, action)
        self.buffers.update(count=self.buffers.count + 1, frames=torch.cat([newest[:, None], frames[:, :-1]], 1))

    def _frame(self, s: Snapshot, action: Tensor | None = None) -> Float[Tensor, "n f"]:
        """Observation and action; of the newest state the observation is worked out once."""
        if self._now is None or self._now[0] is not s:
            self._now = s, torch.cat([entry.value(s) for entry in self._observed.values()], -1)
        present = self._now[1]
        size = self.buffers.frames.shape[-1] - present.shape[-1]
        return torch.cat([present, present.new_zeros(len(present), size) if action is None else action], -1)

    def _frames(self, s: Snapshot) -> Float[Tensor, "n steps f"]:
        """The frames before the state `s`."""
        frames, new = self.buffers.frames, self.buffers.count == 0
        return torch.where(new[:, None, None], self._frame(s)[:, None], frames) if bool(new.any()) else frames

    def _of(self, s: Snapshot, arm: str) -> Float[Tensor, "n h"]:
        self.look(s)
        return self._frames(s)[..., self._columns[arm]].flatten(1)
