"""Grasp candidates of one object: where the wrist goes, how the fingers close, which part is held."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dora.errors import InputError


@dataclass(frozen=True)
class GraspCandidates:
    """C grasps of one object, all poses in the object frame.

    Attributes:
        object: name of the object.
        position: (c, 3) wrist origin [m].
        quaternion: (c, 4) wrist orientation, wxyz.
        approach: (c, 3) unit direction of the wrist's last motion towards the object.
        pregrasp: (c, 20) hand joints before closing [rad].
        grasp: (c, 20) commanded hand joints of the closed hand [rad]; beyond contact, so that they squeeze.
        grasp_class: c names such as "BodyGrasp" or "HandleGrasp".
    """

    object: str
    position: Float[Tensor, "c 3"]
    quaternion: Float[Tensor, "c 4"]
    approach: Float[Tensor, "c 3"]
    pregrasp: Float[Tensor, "c 20"]
    grasp: Float[Tensor, "c 20"]
    grasp_class: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in ("position", "quaternion", "approach", "pregrasp", "grasp"):
            value = getattr(self, name)
            if len(value) != len(self):
                raise InputError(f"candidates of {self.object!r}: {name} has {len(value)} rows, not {len(self)}")
            if not torch.isfinite(value).all():
                raise InputError(f"candidates of {self.object!r}: {name} holds a value that is not finite")
        if len(self) == 0:
            raise InputError(f"there is no grasp candidate for {self.object!r}; generate some first")

    def __len__(self) -> int:
        return len(self.grasp_class)

    def to(self, device: torch.device | str) -> "GraspCandidates":
        """The same candidates on another device."""
        moved = {k: getattr(self, k).to(device) for k in ("position", "quaternion", "approach", "pregrasp", "grasp")}
        return GraspCandidates(object=self.object, grasp_class=self.grasp_class, **moved)
