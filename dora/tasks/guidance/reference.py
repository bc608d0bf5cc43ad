"""What leads the hand when candidates are a prior of the action: the interface of closed-loop references."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from dora.tasks.guidance.residual_action import Target
from dora.tasks.mdp.buffers import Buffers
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage, StageMachine


class Reference(ABC):
    """Sends wrist and hand where the chosen candidate and the observed object say, phase by phase.

    It sees nothing but the snapshot as one arm observes it, noise included, and counts time in seconds. Whatever it
    remembers of an episode is in `buffers` and `phase`; both are saved and restored with the task's state.

    Args:
        phases: in order.
        num_envs: n.
        dt: duration of a control step [s].
        device: where the buffers are.
        buffers: shapes of the rows of what it remembers.
    """

    descent: float = 0.15
    """Speed at which the standoff shrinks on the approach [m/s]; f_reach counts with it."""
    hover: float = 0.0
    """Height that the wrist keeps above the beginning of the approach for each radian to turn [m/rad]; the same."""

    def __init__(
        self,
        phases: Sequence[Stage[Any]],
        num_envs: int,
        dt: float,
        device: torch.device | str,
        **buffers: tuple[int, ...],
    ):
        self.dt = dt
        self.phase: StageMachine[Any] = StageMachine(phases, num_envs, dt, device)
        self.buffers = Buffers(num_envs, device, **buffers)

    @abstractmethod
    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts anew in the environments `rows`, whose wrists have these world poses."""

    @abstractmethod
    def target(self, s: Snapshot) -> Target:
        """The target for the next control step before the residual action; pure, moves nothing."""

    @abstractmethod
    def advance(self, s: Snapshot) -> None:
        """Moves phases and ramps on, once per control step."""

    def freedom(self) -> Float[Tensor, " n"] | float:
        """Share of the residual action's bounds that is in force in the present phase."""
        return 1.0

    def aim(self, target: Target) -> None:  # noqa: B027 (most references need not know)
        """Is told where wrist and hand are being sent: the target with the residual action."""

    def one_hot(self) -> Float[Tensor, "n p"]:
        """The phase of each environment as a one-hot vector."""
        return F.one_hot(self.phase.index, len(self.phase) + 1)[:, : len(self.phase)].float()

    def get_state(self) -> dict[str, Tensor]:
        """Everything that changes during an episode, each (n, ...), for state dicts."""
        return self.buffers.get_state() | self.phase.get_state()

    def set_state(self, state: dict[str, Tensor], rows: Tensor | slice) -> None:
        """Inverse of `get_state` for the given rows."""
        self.buffers.set_state(state, rows)
        self.phase.set_state(state, rows)
