"""Make the set of grasps that comes with Dora: searched, validated, ranked by executed lifts, best first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from dora.affordance.candidates import GraspCandidates, concatenate
from dora.affordance.objects import load_object
from dora.affordance.shipped import ROBOT, shipped_path
from dora.affordance.structure import AffordanceObject
from dora.errors import InputError
from dora.progress import PhaseProgress
from dora.robot import RobotDescription, load_robot
from dora.sim.grasps import generate
from dora.sim.ranking import rank

ROUND = 256
"""Candidates searched at a time."""
MOST_ROUNDS = 8
"""Rounds after which a region has to have enough."""
POOL = 224
"""Valid grasps of the target region that are ranked."""
KEPT = 128
"""The best of them that are shipped."""
FEWEST = 64
"""Grasps of the target region below which nothing is shipped."""
OTHERS = 64
"""Candidates searched for each other region; the valid ones are shipped."""


def ship(name: str, seed: int, phases: PhaseProgress) -> Path:
    """Make and write the shipped set of an object; returns its file.

    Args:
        name: one of our objects.
        seed: of all random draws.
        phases: where progress is shown.

    Raises:
        InputError: unknown object, or too few valid grasps.
    """
    obj, robot = load_object(name), load_robot(ROBOT)
    target = target_grasps(obj, robot, seed, phases)
    others = [
        found
        for index, label in enumerate(obj.labels)
        if label != obj.target
        and (found := valid_grasps(obj, robot, OTHERS, seed + MOST_ROUNDS + index, label, phases)) is not None
    ]
    chosen = [
        ranked(part, obj, robot, phases, f"{name}: ranking {part.grasp_class[0]}").select(slice(KEPT))
        for part in (target, *others)
    ]
    path = shipped_path(name)
    path.parent.mkdir(exist_ok=True)
    concatenate(chosen).save(path)
    return path


def target_grasps(obj: AffordanceObject, robot: RobotDescription, seed: int, phases: PhaseProgress) -> GraspCandidates:
    """At least `FEWEST` and about `POOL` valid grasps of the target region; InputError if there are fewer."""
    sets: list[GraspCandidates] = []
    for index in range(MOST_ROUNDS):
        found = valid_grasps(obj, robot, ROUND, seed + index, obj.target, phases)
        sets += [] if found is None else [found]
        if sum(map(len, sets)) >= POOL:
            break
    count = sum(map(len, sets))
    if count < FEWEST:
        raise InputError(f"{obj.name}: only {count} grasps of {obj.target!r} are valid; {FEWEST} are needed.")
    return concatenate(sets)


def valid_grasps(
    obj: AffordanceObject, robot: RobotDescription, num: int, seed: int, region: str, phases: PhaseProgress
) -> GraspCandidates | None:
    """Those of `num` candidates that are strictly valid and hold `region`; None if there are none."""
    generated = generate(obj, robot, num, seed, region, phases, name=f"{obj.name} {region}")
    assert generated.strict is not None
    mask = generated.strict & generated.candidates.of_class(obj.classes[obj.label_index(region)])
    return generated.candidates.select(mask) if mask.any() else None


def ranked(
    candidates: GraspCandidates, obj: AffordanceObject, robot: RobotDescription, phases: PhaseProgress, name: str
) -> GraspCandidates:
    """The candidates with their scores, best first."""
    score = rank(candidates, obj, robot, progress=phases.phase(name, "lifts"))
    order = torch.argsort(score, descending=True, stable=True)
    return replace(candidates, score=score).select(order)
