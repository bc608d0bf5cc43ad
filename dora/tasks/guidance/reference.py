"""What leads the hand when candidates are a prior of the action: the interface of closed-loop references."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from dora.tasks.guidance.residual_action import Target
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage, StageMachine


class Reference(ABC):
    """Sends wrist and hand where the chosen candidate and the observed object say, phase by phase.

    It sees nothing but the snapshot as it is observed, noise included. Whatever it remembers of an episode is in
    `buffers`, tensors (n, ...) by name, and in `phase`; both are saved and restored with the task's state.
    """

    PHASES: ClassVar[Sequence[Stage[Any]]]
    """The phases, in order."""

    def __init__(self, num_envs: int, device: torch.device):
        self.phase: StageMachine[Any] = StageMachine(self.PHASES, num_envs, device)
        self.buffers: dict[str, Tensor] = {}

    @abstractmethod
    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts anew in the environments `rows`, whose wrists have these world poses."""

    @abstractmethod
    def target(self, s: Snapshot) -> Target:
        """The uncorrected target for the next control step; pure, moves nothing."""

    @abstractmethod
    def advance(self, s: Snapshot) -> None:
        """Moves phases and ramps on, once per control step."""

    def aim(self, target: Target) -> None:  # noqa: B027 (most references need not know)
        """Is told where wrist and hand are being sent: the target after correction."""

    def one_hot(self) -> Float[Tensor, "n p"]:
        """The phase of each environment as a one-hot vector."""
        return F.one_hot(self.phase.index, len(self.phase) + 1)[:, : len(self.phase)].float()

    def get_state(self) -> dict[str, Tensor]:
        """Everything that changes during an episode, each (n, ...), for state dicts."""
        return {k: v.clone() for k, v in self.buffers.items()} | self.phase.get_state()

    def set_state(self, state: dict[str, Tensor], rows: Tensor | slice) -> None:
        """Inverse of `get_state` for the given rows."""
        for name, buffer in self.buffers.items():
            buffer[rows] = state[name].reshape(buffer[rows].shape)
        self.phase.set_state(state, rows)
