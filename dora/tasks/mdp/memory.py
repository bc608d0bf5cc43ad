"""What a task remembers during an episode, one row per environment: contacts, heights, penetration, actions."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.tasks.mdp.buffers import Buffers

MM = 1000.0
"""Millimetres per metre."""


@dataclass(frozen=True)
class HandSizes:
    """Sizes of what is remembered of a hand: parts that touch (fingers and palm), and contact points."""

    parts: int
    points: int


class EpisodeMemory:
    """Buffers (n, ...) of an episode.

    Args:
        num_envs: n.
        action_size: components of an action.
        hands: sizes by the name of the arm.
        objects: names of the objects.
        device: where the tensors are.

    Attributes:
        hands: per arm `touch` (0 or 1) and `force` [N] of each part, `contact_p` [m] and `contact_finger` of up to so
            many contact points, in the object frame; of the last control step.
        objects: per object `start_p` [m], `highest` rise so far [m], `supported` (0 or 1), `mass` [kg], `friction`.
        episode: `penetration` of the last control step and `max_penetration` of all [m]; the last two actions; whether
            it has `failed` (0 or 1).
    """

    def __init__(
        self,
        num_envs: int,
        action_size: int,
        hands: Mapping[str, HandSizes],
        objects: tuple[str, ...],
        device: torch.device | str,
    ):
        self.hands = {
            arm: Buffers(
                num_envs,
                device,
                touch=(sizes.parts,),
                force=(sizes.parts,),
                contact_p=(sizes.points, 3),
                contact_finger=(sizes.points,),
            )
            for arm, sizes in hands.items()
        }
        self.objects = {
            name: Buffers(num_envs, device, start_p=(3,), highest=(), supported=(), mass=(), friction=())
            for name in objects
        }
        size = (action_size,)
        self.episode = Buffers(
            num_envs, device, penetration=(), max_penetration=(), action=size, previous_action=size, failed=()
        )

    @property
    def object(self) -> Buffers:
        """What is remembered of the only object; ValueError if there are several."""
        (only,) = self.objects.values()
        return only

    @property
    def max_penetration(self) -> Float[Tensor, " n"]:
        """Largest overlap of the episode so far [m]."""
        return self.episode.max_penetration

    def begin(self, rows: Int[Tensor, " b"], start_p: Mapping[str, Float[Tensor, "b 3"]]) -> None:
        """Clears the rows of environments that start anew with the objects at `start_p` [m]."""
        for part in self._parts().values():
            part.clear(rows)
        for name, position in start_p.items():
            self.objects[name].write(rows, start_p=position)

    def record_penetration(self, penetration: Float[Tensor, " n"]) -> None:
        """Takes over the overlap of the last control step [m]."""
        e = self.episode
        e.update(penetration=penetration, max_penetration=torch.maximum(e.max_penetration, penetration))

    def record_rise(self, name: str, rise: Float[Tensor, " n"]) -> None:
        """Takes note of an object's present height above its start [m]."""
        o = self.objects[name]
        o.update(highest=torch.maximum(o.highest, rise))

    def record_failure(self, failed: Bool[Tensor, " n"]) -> None:
        """Takes note of which episodes have failed in the last control step: they stay so."""
        self.episode.update(failed=torch.maximum(self.episode.failed, failed.float()))

    def record_action(self, action: Float[Tensor, "n a"]) -> None:
        """Shifts the action history by one."""
        self.episode.update(previous_action=self.episode.action, action=action)

    def report(self) -> dict[str, Float[Tensor, " n"]]:
        """For `info`: overlap of the last control step and largest of the episode [mm]."""
        return {"penetration_mm": self.episode.penetration * MM, "penetration_max_mm": self.max_penetration * MM}

    def _parts(self) -> dict[str, Buffers]:
        hands = {f"hand.{arm}": part for arm, part in self.hands.items()}
        return hands | {f"object.{name}": part for name, part in self.objects.items()} | {"episode": self.episode}

    def get_state(self) -> dict[str, Tensor]:
        """Copies of all buffers by name."""
        return {f"{p}.{name}": value for p, part in self._parts().items() for name, value in part.get_state().items()}

    def set_state(self, state: dict[str, Tensor], rows: Tensor | slice) -> None:
        """Inverse of `get_state` for the given rows."""
        for prefix, part in self._parts().items():
            part.set_state({name: state[f"{prefix}.{name}"] for name in part.names}, rows)
