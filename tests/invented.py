"""Invented snapshots: task logic is tested on states that no simulator has made."""

from dataclasses import fields

import torch
from torch import Tensor

from dora.tasks.mdp.snapshot import Snapshot

SIZES = {
    "arm_q": 7, "hand_q": 20, "hand_v": 20, "hand_target": 20, "wrist_q": 4, "object_q": 4, "goal_q": 4,
    "touch": 6, "force": 6, "action": 26, "previous_action": 26, "correction": 26,
    "goal_pregrasp": 20, "goal_grasp": 20, "contact_finger": 0,
}  # fmt: skip
SCALARS = ("supported", "penetration", "max_penetration", "stage", "time")


def zeros(kind: type[Snapshot], n: int, phases: int = 4, scalars: tuple[str, ...] = ()) -> dict[str, Tensor]:
    """Fields of a snapshot of n environments: zeros and unit quaternions.

    Args:
        kind: class of the snapshot.
        n: environments.
        phases: of the reference.
        scalars: fields (n,) of `kind` beyond those of `Snapshot`.
    """
    values: dict[str, Tensor] = {}
    sizes = SIZES | {"phase": phases}
    for f in fields(kind):
        shape = (n,) if f.name in (*SCALARS, *scalars) else (n, sizes.get(f.name, 3))
        values[f.name] = torch.zeros(shape)
        if f.name.endswith("_q") and sizes.get(f.name) == 4:
            values[f.name][:, 0] = 1.0
    values |= {"tip_p": torch.zeros(n, 5, 3), "tip_q": torch.tensor([1.0, 0, 0, 0]).repeat(n, 5, 1)}
    values |= {"near_p": torch.zeros(n, 3, 3), "near_q": values["tip_q"][:, :3], "contact_p": torch.zeros(n, 0, 3)}
    values |= {k: values[k].bool() for k in ("touch", "supported")}
    return values | {k: values[k].long() for k in ("stage", "contact_finger")}


def invented(n: int, **given: Tensor) -> Snapshot:
    """A snapshot of zeros, unit quaternions and boxes of half extents 3 cm, with what is given."""
    return Snapshot(**(zeros(Snapshot, n) | {"object_half": torch.full((n, 3), 0.03)} | given))
