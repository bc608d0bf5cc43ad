"""Making of a bundled set: grasps are searched, filtered for reach, validated, and ranked by executing them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.affordance.bundled_sets import ROBOT, bundled_path
from dora.affordance.candidates import GraspCandidates, concatenate
from dora.affordance.hand.grasp_test_settings import STANDARD
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.approach_directions import free_approaches
from dora.affordance.reach.feasibility import Reach
from dora.affordance.reach.feasibility_table import Grid, poses
from dora.affordance.search.optimise import Settings, optimise
from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_multiply
from dora.progress import ProgressDisplay
from dora.robot import RobotDescription, load_robot
from dora.sim.grasp_tests.lift_test import Execution, rank
from dora.sim.grasp_tests.shake_test import validate

ROUND = 192
"""Number of candidates per round of the search for the target region."""
MOST_ROUNDS = 20
"""Largest number of rounds of the search for the target region."""
POOL = 240
"""Number of valid grasps of the target region that are ranked."""
KEPT = 96
"""Number of the best of them that are bundled."""
FEWEST_GRASPS = 64
"""Smallest number of valid grasps of the target region from which a set is made."""
PLACES = Grid((0.55, 0.0), (0.08, 0.08), spacing=0.08, yaws=12)
"""Places and yaws of objects on a table at which grasps are tested for reach."""
FEASIBLE_SHARE = 0.03
"""Smallest share of those places at which a grasp must be feasible [1]."""
MOST_NEAR = 6
"""Largest number of rounds of a search near candidates."""
SHORT: dict[str, Any] = {"iterations": 20, "starts": 1, "field_size": 1.0, "oversampling": 1.5}
"""Settings of a search near candidates, which have converged already."""
OTHERS = 64
"""Number of candidates searched for each other region."""
OTHERS_KEPT = 32
"""Number of the best of them that are bundled."""


Usable = Callable[[GraspCandidates], Bool[Tensor, " c"]]
"""Function that returns the mask (c,) of grasps that a task can use."""


def make_bundle(
    name: str,
    seed: int,
    phases: ProgressDisplay,
    usable: Usable | None = None,
    region: bool = True,
    settings: Settings | None = None,
) -> Path:
    """Make and write the bundled set of an object; returns the path of its file.

    Args:
        name: of an object or its folder, as for `load_object`.
        seed: seed of all random draws.
        phases: display of the progress.
        usable: mask of the grasps that the object's task can use. The best grasps of the target region are chosen among
            those; grasps of the other regions and unusable ones follow.
        region: whether the search knows the target region. If not, nothing asks for a region or a class; rounds,
            grasps that are ranked and grasps that are kept are as many.
        settings: of the search; the defaults if None.

    Raises:
        InputError: unknown object, one without a folder, or too few valid grasps.
    """
    maker = SetMaker(load_object(name), load_robot(ROBOT), phases, usable, settings)
    path = bundled_path(name, region)
    (maker.make(seed) if region else maker.make_for_any_region(seed)).save(path)
    return path


class SetMaker:
    """Makes the bundled set of one object for one robot; `usable` and `settings` as in `make_bundle`."""

    def __init__(
        self,
        obj: AffordanceObject,
        robot: RobotDescription,
        phases: ProgressDisplay,
        usable: Usable | None = None,
        settings: Settings | None = None,
    ) -> None:
        self.obj, self.robot, self.phases, self.usable = obj, robot, phases, usable
        self.settings = settings or Settings()
        self.reach = Reach(robot, obj, start=obj.start_posture)

    def make(self, seed: int) -> GraspCandidates:
        """The best grasps of the target region, then those of the other regions.

        Raises:
            InputError: there are too few valid grasps of the target region.
        """
        parts = [self.ranked(self.pool(seed, self.obj.target)).select(slice(KEPT))]
        for index, label in enumerate(self.obj.labels):
            if label != self.obj.target or self.usable is not None:
                found = self.valid(OTHERS, seed + MOST_ROUNDS + index, label)
                parts += [] if found is None else [self.ranked(found).select(slice(OTHERS_KEPT))]
        return replace(concatenate(parts), settings=self._made(seed))

    def make_for_any_region(self, seed: int) -> GraspCandidates:
        """The best grasps of a search that knows no region; errors as of `make`."""
        return replace(self.ranked(self.pool(seed, None)).select(slice(KEPT)), settings=self._made(seed))

    def _made(self, seed: int) -> str:
        made = {"search": repr(self.settings), "grasp_test": repr(STANDARD), "ranking": repr(Execution()), "seed": seed}
        return json.dumps(made)

    def pool(self, seed: int, label: str | None) -> GraspCandidates:
        """Up to `POOL` valid grasps of a region, or of any.

        Raises:
            InputError: there are fewer than `FEWEST_GRASPS`.
        """
        sets: list[GraspCandidates] = []
        for index in range(MOST_ROUNDS):
            found = self.valid(ROUND, seed + index, label, self.usable)
            sets += [] if found is None else [found]
            if sum(map(len, sets)) >= POOL:
                break
        count = sum(map(len, sets))
        if count < FEWEST_GRASPS:
            name, where = self.obj.name, "any region" if label is None else repr(label)
            why = f"dora grasps --object {name} --validate sapien shows why"
            raise InputError(f"{name}: only {count} grasps of {where} are valid, {FEWEST_GRASPS} are needed; {why}.")
        return concatenate(sets).select(slice(POOL))

    def near(self, candidates: GraspCandidates, count: int, seed: int, label: str | None) -> GraspCandidates | None:
        """Up to `count` further grasps near candidates, which hold `label` (None: anything); None if there are none."""
        sets: list[GraspCandidates] = []
        for index in range(MOST_NEAR):
            found = self.valid(ROUND, seed + index, label, self.usable, candidates)
            sets += [] if found is None else [found]
            if sum(map(len, sets)) >= count:
                break
        return concatenate(sets).select(slice(count)) if sets else None

    def valid(
        self,
        num: int,
        seed: int,
        label: str | None,
        usable: Usable | None = None,
        near: GraspCandidates | None = None,
    ) -> GraspCandidates | None:
        """Those of `num` candidates that hold `label` (None: anything), are usable, have a free approach, and are
        strictly valid.

        Args:
            num: candidates that are searched for.
            seed: of the search.
            label: region that they hold; None for any.
            usable: mask of those that the object's task can use.
            near: candidates near which is searched, in fewer steps.

        Returns:
            The candidates; None if none is left.
        """
        settings = self.settings if near is None else replace(self.settings, **SHORT)
        found = optimise(
            self.obj, self.robot, num, seed, label, settings, near=near,
            progress=self.phase(f"search {label or 'any region'}", 1 / settings.iterations),
        )  # fmt: skip
        good = found.valid & (found.self_penetration < STANDARD.strict_self_penetration)
        if label is not None:
            good &= found.of_class(self.obj.classes[self.obj.label_index(label)])
        if not good.any():
            return None
        found, free = free_approaches(found.select(good), self.reach)
        if self.obj.on_table:
            if not free.any():
                return None
            found = found.select(free)
            places = poses(PLACES.nodes(), self.obj.support, self.obj.rest)
            feasible = self.reach.filter(found, *places, exact=False).reachable.float().mean(0) >= FEASIBLE_SHARE
            if not feasible.any():
                return None
            found = found.select(feasible)
        if usable is not None:  # with the approaches that they have now
            chosen = usable(found)
            if not chosen.any():
                return None
            found = found.select(chosen)
        verdict = validate(found, self.obj, self.robot, progress=self.phase(f"validate {label or 'any region'}"))
        return found.select(verdict.strict) if verdict.strict.any() else None

    def ranked(self, candidates: GraspCandidates) -> GraspCandidates:
        """The candidates with scores, best first: by lifts from the table, else by grasp tests without a table."""
        report = self.phase(f"rank {candidates.grasp_class[0]}")
        if self.obj.on_table:
            score = rank(candidates, self.obj, self.robot, progress=report)
        else:
            score = rank_by_shaking(candidates, self.obj, self.robot, report)
        order = torch.argsort(score, descending=True, stable=True)
        return replace(candidates, score=score).select(order)

    def phase(self, name: str, scale: float = 1.0) -> Callable[[int, int], None]:
        """A progress bar for one phase; `scale` converts what it is called with to candidates."""
        return self.phases.phase(f"{self.obj.name}: {name}", "candidates", scale)


def rank_by_shaking(
    candidates: GraspCandidates,
    obj: AffordanceObject,
    robot: RobotDescription,
    progress: Callable[[int, int], None] | None = None,
    execution: Execution | None = None,
    seed: int = 0,
) -> Float[Tensor, " c"]:
    """Share of grasp tests passed under errors of the wrist's pose, without a table.

    Args:
        candidates: c candidates of this object and this robot.
        obj: the object.
        robot: the robot whose hand grasps.
        progress: called with the number of tests done and their total.
        execution: its `draws`, `position` and `rotation` are used.
        seed: seed of the errors.
    """
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
