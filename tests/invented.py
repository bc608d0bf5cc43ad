"""Invented snapshots: task logic is tested on states that no simulator has made."""

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from dora.tasks.mdp.memory import EpisodeMemory, HandSizes
from dora.tasks.mdp.snapshot import GoalState, HandState, ObjectState, S, Snapshot, extended

ARM, FINGERS, HAND, ACTION, NEAR = 7, 5, 20, 26, 3
"""Joints of the arm, fingers, joints of the hand, components of the action, candidates that are observed."""
HAND_SHAPES: dict[str, tuple[int, ...]] = {
    "arm_q": (ARM,), "q": (HAND,), "v": (HAND,), "target": (HAND,), "wrist_p": (3,), "wrist_q": (4,), "wrist_v": (3,),
    "wrist_w": (3,), "tip_p": (FINGERS, 3), "tip_q": (FINGERS, 4), "touch": (FINGERS + 1,), "force": (FINGERS + 1,),
    "contact_p": (0, 3), "contact_finger": (0,),
}  # fmt: skip
OBJECT_SHAPES: dict[str, tuple[int, ...]] = {
    "p": (3,), "q": (4,), "v": (3,), "w": (3,), "half": (3,), "start_p": (3,), "supported": (),
}  # fmt: skip
GOAL_SHAPES: dict[str, tuple[int, ...]] = {
    "p": (3,), "q": (4,), "approach": (3,), "pregrasp": (HAND,), "grasp": (HAND,), "nearest_p": (NEAR, 3),
    "nearest_q": (NEAR, 4), "phase": (4,), "residual": (ACTION,),
}  # fmt: skip
SHARED_SHAPES: dict[str, tuple[int, ...]] = {
    "penetration": (), "max_penetration": (), "stage": (), "time": (),
    "action": (ACTION,), "previous_action": (ACTION,),
}  # fmt: skip
QUATERNIONS = ("q", "wrist_q", "tip_q", "nearest_q")
"""Fields that are unit quaternions, where their last axis has four components."""
KINDS = {"touch": torch.bool, "supported": torch.bool, "stage": torch.long, "contact_finger": torch.long}
"""Fields that are no floats."""
TIP_RADIUS = 0.011
"""Radius of invented fingertips [m]."""


def record(kind: Any, shapes: dict[str, tuple[int, ...]], n: int, given: dict[str, Any]) -> Any:
    """A record of zeros and unit quaternions, with what is given."""
    values: dict[str, Any] = {}
    for name, shape in shapes.items():
        values[name] = torch.zeros(n, *shape, dtype=KINDS.get(name, torch.float32))
        if name in QUATERNIONS and shape[-1] == 4:
            values[name][..., 0] = 1.0
    return kind(**(values | given))


def invented(n: int, **given: Tensor) -> Snapshot:
    """A snapshot of one arm and one object: zeros, unit quaternions, boxes of half extents 3 cm, with what is given.

    Fields of the hand are named as in `HandState`, or `hand_q`, `hand_v`; those of the object `object_p`, ...,
    `start_p`, `supported`; those of the goal `goal_p`, ..., `nearest_p`, `nearest_q`, `phase`, `residual`.
    """
    hand: dict[str, Any] = {"tip_radius": TIP_RADIUS}
    body: dict[str, Any] = {"half": torch.full((n, 3), 0.03)}
    goal: dict[str, Any] = {}
    shared: dict[str, Any] = {}
    own = [(hand, HAND_SHAPES), (body, OBJECT_SHAPES), (goal, GOAL_SHAPES), (shared, SHARED_SHAPES)]
    for name, value in given.items():
        whose, _, short = name.partition("_")
        named = {"object": body, "goal": goal, "hand": hand}
        if whose in named:
            named[whose][short] = value
        else:
            next(place for place, shapes in own if name in shapes)[name] = value
    records = {
        "hands": {"arm": record(HandState, HAND_SHAPES, n, hand)},
        "objects": {"thing": record(ObjectState, OBJECT_SHAPES, n, body)},
        "goals": {"arm": record(GoalState, GOAL_SHAPES, n, goal)},
        "handles": {"arm": "thing"},
        "stages": {},
    }
    return record(Snapshot, SHARED_SHAPES, n, records | shared)


def extension(kind: type[S], n: int, **given: Tensor) -> S:
    """An invented snapshot of a subclass, whose own fields are all given."""
    own = {f.name for f in fields(kind)} - {f.name for f in fields(Snapshot)}
    s = invented(n, **{name: value for name, value in given.items() if name not in own})
    return extended(s, kind, **{name: value for name, value in given.items() if name in own})


def memory(n: int, **given: Tensor) -> EpisodeMemory:
    """Memory of an episode of one arm and one object, zero but for what is given of the object or the episode."""
    made = EpisodeMemory(n, ACTION, {"arm": HandSizes(FINGERS + 1, 0)}, ("thing",), "cpu")
    for name, value in given.items():
        part = made.object if name in made.object else made.episode
        part.update(**{name: value})
    return made
