"""Who acts in a session: a policy, zero correction, or a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from dora.live.recordings import Recording
from dora.tasks import options_under_preset

Act = Callable[[Tensor], Any]
"""Observation (1, o) -> action (1, a) in [-1, 1]."""
ZERO = "zero correction"
"""Name of the player whose actions are all zero."""


@dataclass(frozen=True)
class Player:
    """Who acts.

    Attributes:
        name: as a page shows it.
        options: arguments with which its task is made; without a preset that of the session is in force.
        act: gives the action; None for a recording, and for zero correction.
        recording: what is played; None for a policy.
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    act: Act | None = None
    recording: Recording | None = None

    def options_with(self, env_id: str, preset: str) -> dict[str, Any]:
        """Arguments of the task with another preset; a recording keeps what it was made with."""
        return dict(self.options) if self.recording is not None else options_under_preset(env_id, self.options, preset)


def zero_correction(options: Mapping[str, Any]) -> Player:
    """The zero action, which executes the reference where actions are residuals; `options` are those of its task."""
    return Player(ZERO, options)


def recorded(recording: Recording) -> Player:
    """A player of a recording."""
    return Player(f"recording {recording.path.name}", recording.options, recording=recording)
