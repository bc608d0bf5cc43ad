"""The observation as a table: name, function of the snapshot, size, unit and meaning of every entry."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dora.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_apply,
    quaternion_inverse,
    quaternion_multiply,
)
from dora.tasks.mdp.config import TaskConfig
from dora.tasks.mdp.guidance_parts import OBSERVATION, PRIOR, exists
from dora.tasks.mdp.quantities import goal_error, in_wrist, lifted, nearest_errors, turned_in_wrist
from dora.tasks.mdp.snapshot import Snapshot

FASTEST_SPIN = 30.0
"""Spin of an object that is still told apart, about each axis [rad/s]; a slender one that is hit spins faster."""


@dataclass(frozen=True)
class Entry:
    """One part of the observation.

    Attributes:
        value: snapshot -> (n, k) tensor.
        unit: unit of the values, "1" if dimensionless.
        doc: what it is, for the documentation table.
        guided: True if it exists only with guidance.
        region: True if it exists only with `guidance="affordance"`, because it knows the object's regions.
        prior: True if it is about the reference to which the action is a residual; it exists only with that part of
            guidance, all other guided entries belong to the part "observation".
        sensed: True if a robot knows it without looking: its joints, its commands, touch. It stays an observation
            beside pictures; all other entries are privileged, and left out where pictures are observed without state.
        arm: name of the only arm that has it, where not all of them do.
    """

    value: Callable[[Any], Tensor]
    unit: str
    doc: str
    guided: bool = False
    prior: bool = False
    region: bool = False
    sensed: bool = False
    arm: str | None = None

    def exists(self, parts: frozenset[str]) -> bool:
        """Whether the entry exists with these parts of guidance."""
        part = None if not self.guided else PRIOR if self.prior else OBSERVATION
        return exists(part, self.region, parts)


def observation_table(
    arms: Sequence[str], extra: Mapping[str, Entry], parts: frozenset[str], config: TaskConfig
) -> dict[str, Entry]:
    """The entries of a task's observation, in order.

    Args:
        arms: names of the arms. With several, each arm has all entries, under `<arm>/<name>`, of what it sees.
        extra: the task's own entries beyond `ARM_ENTRIES` and `SHARED_ENTRIES`, of one arm.
        parts: parts of guidance in force; entries of other parts are left out.
        config: numbers of the task; with `observe_candidate` there are `CANDIDATE_ENTRIES` besides, with
            `observe_correction` `CORRECTION_ENTRIES`.
    """
    table = {**ARM_ENTRIES, **extra, **(CANDIDATE_ENTRIES if config.observe_candidate else {})}
    table |= CORRECTION_ENTRIES if config.observe_correction else {}
    if len(arms) > 1:
        own = {
            f"{arm}/{name}": replace(entry, value=_as_observed_by(arm, entry))
            for arm in arms
            for name, entry in table.items()
            if name not in SHARED_ENTRIES and entry.arm in (None, arm)
        }
        table = {**own, **{name: ARM_ENTRIES[name] for name in SHARED_ENTRIES}}
    return {name: entry for name, entry in table.items() if entry.exists(parts)}


def observed_part(entries: Mapping[str, Entry], s: Snapshot, sensed: bool) -> dict[str, Tensor]:
    """Entries (n, k) by name: what the robot senses, which ManiSkill calls `agent`, or the privileged ones, `extra`.

    Args:
        entries: the table in force.
        s: the state as it is observed.
        sensed: which of the two.
    """
    return {name: entry.value(s) for name, entry in entries.items() if entry.sensed == sensed}


def joined(entries: Mapping[str, Entry], parts: Mapping[str, Mapping[str, Tensor]]) -> Tensor:
    """The observation vector (n, o): all entries in the order of the table, of the parts `agent` and `extra`."""
    values = {**parts["agent"], **parts["extra"]}
    return torch.cat([values[name] for name in entries], -1)


def columns_by_arm(arms: Sequence[str], sizes: Mapping[str, int]) -> dict[str, list[int]]:
    """Columns of the observation vector that each arm sees: its own entries, and those that are the same for all.

    Args:
        arms: names of the arms.
        sizes: number of components of each entry, in the order of the table.
    """
    columns: dict[str, list[int]] = {arm: [] for arm in arms}
    start = 0
    for name, size in sizes.items():
        owner = name.partition("/")[0]
        for arm in [owner] if owner in columns and "/" in name else arms:
            columns[arm] += range(start, start + size)
        start += size
    return columns


def _as_observed_by(arm: str, entry: Entry) -> Callable[[Any], Tensor]:
    return lambda s: entry.value(s.of(arm))


def _object_spin(s: Snapshot) -> Tensor:
    return turned_in_wrist(s, s.object.w).clamp(-FASTEST_SPIN, FASTEST_SPIN)


def _axes(q: Tensor) -> Tensor:
    """(n, 6): first two columns of the rotation matrix, a continuous encoding of orientation."""
    return matrix_from_quaternion(q)[..., :2].flatten(-2)


def _tips(s: Snapshot) -> Tensor:
    n, fingers = s.hand.tip_p.shape[:2]
    p, q = (x[:, None].expand(n, fingers, x.shape[-1]).flatten(0, 1) for x in (s.hand.wrist_p, s.hand.wrist_q))
    return quaternion_apply(quaternion_inverse(q), s.hand.tip_p.flatten(0, 1) - p).reshape(n, 3 * fingers)


def _stage(s: Snapshot) -> Tensor:
    return torch.stack([*s.stages.values()] or [s.stage], -1).float()


def _tip_directions(s: Snapshot) -> Tensor:
    return matrix_from_quaternion(s.hand.tip_q)[..., 2].flatten(-2)


def _object_turn(s: Snapshot) -> Tensor:
    return _axes(quaternion_multiply(quaternion_inverse(s.hand.wrist_q), s.object.q))


def _candidate(s: Snapshot) -> Tensor:
    """(n, 9): position [m] and two axes of the chosen candidate's wrist in the object's frame."""
    back = quaternion_inverse(s.object.q)
    place = quaternion_apply(back, s.goal.p - s.object.p)
    return torch.cat([place, _axes(quaternion_multiply(back, s.goal.q))], -1)


ARM_ENTRIES: dict[str, Entry] = {
    "hand_q": Entry(lambda s: s.hand.q, "rad", "hand joint angles, thumb to pinky", sensed=True),
    "hand_v": Entry(lambda s: s.hand.v, "rad/s", "hand joint velocities", sensed=True),
    "hand_lead": Entry(lambda s: s.hand.target - s.hand.q, "rad", "commanded minus measured hand joints", sensed=True),
    "arm_q": Entry(lambda s: s.hand.arm_q, "rad", "arm joint angles", sensed=True),
    "tips": Entry(_tips, "m", "fingertip positions in the hand frame", sensed=True),
    "tip_axes": Entry(_tip_directions, "1", "fingertip directions (tip z axes), world frame", sensed=True),
    "wrist_p": Entry(lambda s: s.hand.wrist_p, "m", "wrist position, world frame", sensed=True),
    "wrist_R": Entry(lambda s: _axes(s.hand.wrist_q), "1", "wrist orientation, two columns of its matrix", sensed=True),
    "wrist_v": Entry(lambda s: s.hand.wrist_v, "m/s", "wrist linear velocity, world frame", sensed=True),
    "wrist_w": Entry(lambda s: s.hand.wrist_w, "rad/s", "wrist angular velocity, world frame", sensed=True),
    "object_p": Entry(lambda s: in_wrist(s, s.object.p), "m", "object position in the hand frame"),
    "object_R": Entry(_object_turn, "1", "object orientation in the hand frame, two columns of its matrix"),
    "object_v": Entry(lambda s: turned_in_wrist(s, s.object.v), "m/s", "object velocity in the hand's axes"),
    "object_w": Entry(_object_spin, "rad/s", f"object spin in the hand's axes, clipped at {FASTEST_SPIN:g}"),
    "object_rise": Entry(lambda s: lifted(s)[:, None], "m", "height of the object above its start"),
    "touch": Entry(
        lambda s: s.hand.touch.float(), "1", "contact of thumb, index, middle, ring, pinky, palm", sensed=True
    ),
    "max_penetration": Entry(
        lambda s: (s.max_penetration[:, None] * 1000).nan_to_num(0.0),
        "mm",
        "largest overlap of the episode so far; 0 where the simulator does not report it",
    ),
    "stage": Entry(_stage, "1", "index of the active stage, of each arm if they have stages of their own"),
    "time": Entry(lambda s: s.time[:, None], "1", "share of the episode that is over", sensed=True),
    "goal": Entry(
        lambda s: torch.cat(goal_error(s), -1), "m, rad", "wrist to candidate: position and rotation vector", True
    ),
    "goal_hand": Entry(lambda s: s.goal.grasp - s.hand.q, "rad", "candidate's closed hand minus measured joints", True),
    "nearest": Entry(
        lambda s: nearest_errors(s)[:, 1:].flatten(1),
        "m, rad",
        "wrist to the next nearest candidates: position and rotation vector of each",
        True,
    ),
    "phase": Entry(lambda s: s.goal.phase, "1", "phase of the reference", True, True, sensed=True),
    "residual": Entry(
        lambda s: s.goal.residual, "1", "low-passed residual action, in units of its bounds", True, True, sensed=True
    ),
}
"""What every arm of every task observes."""
CANDIDATE_ENTRIES = {
    "candidate": Entry(_candidate, "m, 1", "candidate's wrist in the object's frame, position and two axes", True)
}
"""What every arm observes besides with the task's number `observe_candidate`. It is the same in the whole episode, and
free of noise: the pose of the object and the goal that follows from it are measured with the same error."""
CORRECTION_ENTRIES = {
    "correction": Entry(
        lambda s: s.goal.correction, "1", "residual that undoes the candidate's error, exactly", True, True
    )
}
"""What every arm observes besides with the task's number `observe_correction`: no sensor could tell it."""
SHARED_ENTRIES = ("max_penetration", "stage", "time")
"""Those of them that are the same for all arms of a task."""
