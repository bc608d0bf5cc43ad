"""Batched stage machines: every environment walks the same table of sub-tasks at its own pace, each arm its own."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

S = TypeVar("S")
"""What the functions of a stage look at: a snapshot, or what a reference tracks."""


@dataclass(frozen=True)
class Stage(Generic[S]):
    """One sub-task.

    Attributes:
        name: unique, snake_case; appears in logs as `stage/<name>`.
        done: snapshot -> (n,) bool, the stage's own success test.
        hold: time for which `done` must stay true before the next stage starts [s]; at least one control step.
        lost: snapshot -> (n,) bool, sends the environment back to `back_to`; None if nothing can be lost.
        back_to: name of an earlier stage.
    """

    name: str
    done: Callable[[S], Bool[Tensor, " n"]]
    hold: float = 0.0
    lost: Callable[[S], Bool[Tensor, " n"]] | None = None
    back_to: str | None = None


class StageMachine(Generic[S]):
    """Holds, per environment, the active stage (K when all K are done), the hold count and the furthest stage."""

    def __init__(self, stages: Sequence[Stage[S]], num_envs: int, dt: float, device: torch.device | str = "cpu"):
        """Builds the machine, which advances every `dt` [s]; raises ValueError for repeated names or a `back_to` that
        is no earlier stage."""
        names = [s.name for s in stages]
        if len(set(names)) != len(names):
            raise ValueError(f"stage names repeat: {names}")
        for k, s in enumerate(stages):
            if (s.lost is None) != (s.back_to is None):
                raise ValueError(f"stage {s.name!r} must give both lost and back_to or neither")
            if s.back_to is not None and s.back_to not in names[:k]:
                raise ValueError(f"stage {s.name!r} goes back to {s.back_to!r}, which is not an earlier stage")
        self.stages = tuple(stages)
        self.index = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.hold_count = torch.zeros_like(self.index)
        self.furthest = torch.zeros_like(self.index)
        # Row K stands for "finished": never left, never held.
        self._hold = torch.tensor([max(1, round(s.hold / dt)) for s in stages] + [1], device=device)
        self._back = torch.tensor([names.index(s.back_to) if s.back_to else 0 for s in stages] + [0], device=device)

    def __len__(self) -> int:
        return len(self.stages)

    def reset(self, env_idx: Int[Tensor, " b"]) -> None:
        """Sends the environments in `env_idx` (b,) back to the first stage; the others keep theirs."""
        for buffer in (self.index, self.hold_count, self.furthest):
            buffer[env_idx] = 0

    def advance(self, s: S) -> None:
        """Moves every environment at most one stage. Call exactly once per control step."""
        no = torch.zeros_like(self.index, dtype=torch.bool)
        done = torch.stack([x.done(s) for x in self.stages] + [no])
        lost = torch.stack([x.lost(s) if x.lost else no for x in self.stages] + [no])
        now = self.index[None]
        is_done, is_lost = done.gather(0, now)[0], lost.gather(0, now)[0]
        held = torch.where(is_done, self.hold_count + 1, 0)
        forward = held >= self._hold[self.index]
        forward &= self.index < len(self)
        step = torch.where(is_lost, self._back[self.index], self.index + forward)
        self.hold_count.copy_(torch.where(forward | is_lost, 0, held))
        self.index.copy_(step)
        self.furthest.copy_(torch.maximum(self.furthest, step))

    def get_state(self) -> dict[str, Tensor]:
        """The machine's (n,) buffers by name."""
        return {"stage": self.index.clone(), "hold_count": self.hold_count.clone(), "furthest": self.furthest.clone()}

    def state_ranges(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest value of what `get_state` returns."""
        stages = 0.0, float(len(self))
        return {"stage": stages, "hold_count": (0.0, float(self._hold.max())), "furthest": stages}

    def set_state(self, state: dict[str, Tensor], env_idx: Tensor | slice) -> None:
        """Inverse of `get_state` for the rows `env_idx`; values may be floats, as in flattened states."""
        for name, buffer in (("stage", self.index), ("hold_count", self.hold_count), ("furthest", self.furthest)):
            buffer[env_idx] = state[name].reshape(-1).to(buffer.dtype)

    @property
    def finished(self) -> Bool[Tensor, " n"]:
        """(n,) bool: all stages done."""
        return self.index == len(self)

    def by_arm(self) -> dict[str, Int[Tensor, " n"]]:
        """Active stages by arm, of which this machine knows none."""
        return {}

    def report(self) -> dict[str, Tensor]:
        """(n,) tensors for `info`: whether all stages are done, the active one, and which were completed so far."""
        done = {f"stage/{stage.name}": self.furthest > k for k, stage in enumerate(self.stages)}
        return {"finished": self.finished, "stage": self.index.clone(), **done}


class ParallelStages:
    """One machine per arm, side by side: no arm's stages wait for another's, unless their tests say so.

    All is finished when every machine is at the same time. Names of stages are unique over all arms.

    Args:
        ladders: stages by arm, in order; their functions look at what that arm sees of the snapshot.
        num_envs, dt, device: as of `StageMachine`.
    """

    def __init__(
        self, ladders: Mapping[str, Sequence[Stage[Any]]], num_envs: int, dt: float, device: torch.device | str = "cpu"
    ):
        self.machines = {arm: StageMachine(stages, num_envs, dt, device) for arm, stages in ladders.items()}
        names = [stage.name for stage in self.stages]
        if len(set(names)) != len(names):
            raise ValueError(f"stage names repeat: {names}")

    @property
    def stages(self) -> tuple[Stage[Any], ...]:
        """The stages of all arms."""
        return tuple(stage for machine in self.machines.values() for stage in machine.stages)

    def __len__(self) -> int:
        return len(self.stages)

    @property
    def index(self) -> Int[Tensor, " n"]:
        """(n,) number of stages that are done now, of all arms."""
        return torch.stack([machine.index for machine in self.machines.values()]).sum(0)

    @property
    def furthest(self) -> Tensor:
        """(n,) the same, of those that have been done so far."""
        return torch.stack([machine.furthest for machine in self.machines.values()]).sum(0)

    @property
    def finished(self) -> Bool[Tensor, " n"]:
        """(n,) bool: all stages of all arms done."""
        return torch.stack([machine.finished for machine in self.machines.values()]).all(0)

    def by_arm(self) -> dict[str, Int[Tensor, " n"]]:
        """(n,) index of the active stage of each arm; the number of its stages when all are done."""
        return {arm: machine.index.clone() for arm, machine in self.machines.items()}

    def reset(self, env_idx: Int[Tensor, " b"]) -> None:
        """As `StageMachine.reset`, for all arms."""
        for machine in self.machines.values():
            machine.reset(env_idx)

    def advance(self, s: Any) -> None:
        """Moves every arm of every environment at most one stage. Call exactly once per control step."""
        for arm, machine in self.machines.items():
            machine.advance(s.of(arm))

    def get_state(self) -> dict[str, Tensor]:
        """The buffers (n,) of all machines, by arm and name."""
        return {f"{arm}.{k}": v for arm, machine in self.machines.items() for k, v in machine.get_state().items()}

    def state_ranges(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest value of what `get_state` returns."""
        return {f"{arm}.{k}": v for arm, machine in self.machines.items() for k, v in machine.state_ranges().items()}

    def set_state(self, state: dict[str, Tensor], env_idx: Tensor | slice) -> None:
        """Inverse of `get_state` for the rows `env_idx`."""
        for arm, machine in self.machines.items():
            own = {name: state[f"{arm}.{name}"] for name in machine.get_state()}
            machine.set_state(own, env_idx)

    def report(self) -> dict[str, Tensor]:
        """(n,) tensors for `info`, as `StageMachine.report`."""
        done = {name: v for m in self.machines.values() for name, v in m.report().items() if name.startswith("stage/")}
        return {"finished": self.finished, "stage": self.index, **done}


Stages = StageMachine[Any] | ParallelStages
"""What walks a task's stages."""


def make_stages(
    stages: Sequence[Stage[Any]] | Mapping[str, Sequence[Stage[Any]]],
    num_envs: int,
    dt: float,
    device: torch.device | str = "cpu",
) -> Stages:
    """The machine of one ladder of stages, or of one ladder for each arm."""
    kind = ParallelStages if isinstance(stages, Mapping) else StageMachine
    return kind(stages, num_envs, dt, device)  # pyright: ignore[reportArgumentType]
