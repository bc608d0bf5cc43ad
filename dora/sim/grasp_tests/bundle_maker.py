"""Make the set of grasps that comes with Dora: searched, filtered, validated, ranked by execution, best first."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.affordance.bundled_sets import ROBOT, bundled_path
from dora.affordance.candidates import GraspCandidates, concatenate
from dora.affordance.hand.protocol import STANDARD
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.approach_directions import free_approaches
from dora.affordance.reach.feasibility import Reach
from dora.affordance.reach.feasibility_table import Grid, poses
from dora.affordance.search.optimise import OFF_TABLE, Settings, optimise
from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_multiply
from dora.progress import ProgressDisplay
from dora.robot import RobotDescription, load_robot
from dora.sim.grasp_tests.lift_test import Execution, rank
from dora.sim.grasp_tests.shake_test import validate

ROUND = 192
"""Candidates searched at a time for the target region."""
MOST_ROUNDS = 20
"""Rounds after which a region has to have enough."""
POOL = 240
"""Grasps of the target region that are ranked."""
KEPT = 96
"""The best of them that are shipped."""
FEWEST = 64
"""Grasps of the target region below which nothing is shipped."""
STARTS = {"jug": "above"}
"""Posture from which the arm sets out, where it is not "home"."""
PLACES = Grid((0.55, 0.0), (0.08, 0.08), spacing=0.08, yaws=12)
"""Where objects on a table may stand: a grasp has to be feasible somewhere."""
FEASIBLE = 0.03
"""Share of those places from which a grasp is kept."""
OTHERS = 64
"""Candidates searched for each other region."""
OTHERS_KEPT = 32
"""The best of them that are shipped."""


Usable = Callable[[GraspCandidates], Bool[Tensor, " c"]]
"""Tells which grasps a task can use."""


def make_bundle(name: str, seed: int, phases: ProgressDisplay, usable: Usable | None = None) -> Path:
    """Make and write the shipped set of an object; returns its file.

    Args:
        name: one of our objects.
        seed: of all random draws.
        phases: where progress is shown.
        usable: what the object's task can use; the best grasps of the target region are chosen among those, and some
            of the others follow.

    Raises:
        InputError: unknown object, or too few valid grasps.
    """
    maker = SetMaker(load_object(name), load_robot(ROBOT), phases, usable)
    path = bundled_path(name)
    path.parent.mkdir(exist_ok=True)
    maker.make(seed).save(path)
    return path


class SetMaker:
    """Makes the shipped set of one object for one robot; `usable` as of `ship`."""

    def __init__(
        self, obj: AffordanceObject, robot: RobotDescription, phases: ProgressDisplay, usable: Usable | None = None
    ) -> None:
        self.obj, self.robot, self.phases, self.usable = obj, robot, phases, usable
        self.reach = Reach(robot, obj, start=STARTS.get(obj.name, "home"))
        self.on_table = obj.name not in OFF_TABLE

    def make(self, seed: int) -> GraspCandidates:
        """The best grasps of the target region, then those of the others; InputError if there are too few."""
        parts = [self.ranked(self.pool(seed)).select(slice(KEPT))]
        for index, label in enumerate(self.obj.labels):
            if label != self.obj.target or self.usable is not None:
                found = self.valid(OTHERS, seed + MOST_ROUNDS + index, label)
                parts += [] if found is None else [self.ranked(found).select(slice(OTHERS_KEPT))]
        made = {"search": repr(Settings()), "protocol": repr(STANDARD), "ranking": repr(Execution()), "seed": seed}
        return replace(concatenate(parts), settings=json.dumps(made))

    def pool(self, seed: int) -> GraspCandidates:
        """`POOL` valid grasps of the target region, or as many as there are."""
        sets: list[GraspCandidates] = []
        for index in range(MOST_ROUNDS):
            found = self.valid(ROUND, seed + index, self.obj.target, self.usable)
            sets += [] if found is None else [found]
            if sum(map(len, sets)) >= POOL:
                break
        count = sum(map(len, sets))
        if count < FEWEST:
            name, target = self.obj.name, self.obj.target
            raise InputError(f"{name}: only {count} grasps of {target!r} are valid, and {FEWEST} are needed.")
        return concatenate(sets).select(slice(POOL))

    def valid(self, num: int, seed: int, label: str, usable: Usable | None = None) -> GraspCandidates | None:
        """Those of `num` candidates that hold `label`, are usable, free on an approach and strictly valid; None if
        none is."""
        found = optimise(
            self.obj, self.robot, num, seed, label, progress=self.phase(f"search {label}", 1 / Settings().iterations)
        )
        name = self.obj.classes[self.obj.label_index(label)]
        good = found.valid & (found.self_penetration < STANDARD.strict_self_penetration) & found.of_class(name)
        good = good if usable is None else good & usable(found)
        if not good.any():
            return None
        found, free = free_approaches(found.select(good), self.reach)
        if self.on_table:
            if not free.any():
                return None
            found = found.select(free)
            places = poses(PLACES.nodes(), self.obj.support, self.obj.rest)
            feasible = self.reach.filter(found, *places, exact=False).reachable.float().mean(0) >= FEASIBLE
            if not feasible.any():
                return None
            found = found.select(feasible)
        verdict = validate(found, self.obj, self.robot, progress=self.phase(f"validate {label}"))
        return found.select(verdict.strict) if verdict.strict.any() else None

    def ranked(self, candidates: GraspCandidates) -> GraspCandidates:
        """With scores, best first: by lifts from the table, or by holds in the air of what is not on one."""
        report = self.phase(f"rank {candidates.grasp_class[0]}")
        if self.on_table:
            score = rank(candidates, self.obj, self.robot, progress=report)
        else:
            score = holds(candidates, self.obj, self.robot, report)
        order = torch.argsort(score, descending=True, stable=True)
        return replace(candidates, score=score).select(order)

    def phase(self, name: str, scale: float = 1.0) -> Callable[[int, int], None]:
        """A progress bar."""
        return self.phases.phase(f"{self.obj.name}: {name}", "candidates", scale)


def holds(
    candidates: GraspCandidates,
    obj: AffordanceObject,
    robot: RobotDescription,
    progress: Callable[[int, int], None] | None = None,
    execution: Execution | None = None,
    seed: int = 0,
) -> Float[Tensor, " c"]:
    """Share of validations passed with errors of the wrist's pose, drawn as `Execution` says, without a table."""
    e, count = execution or Execution(), len(candidates)
    draw = torch.Generator().manual_seed(seed)
    rows = torch.arange(count).repeat(e.draws)
    several = candidates.select(rows)
    shift = e.position * (2 * torch.rand(len(rows), 3, generator=draw) - 1)
    turn = e.rotation * (2 * torch.rand(len(rows), 3, generator=draw) - 1)
    moved = replace(
        several,
        position=several.position + shift,
        quaternion=quaternion_multiply(several.quaternion, quaternion_from_rotation_vector(turn)),
    )
    return validate(moved, obj, robot, progress=progress).passed.float().view(e.draws, count).mean(0)
