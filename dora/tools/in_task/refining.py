"""Refinement of a bundled set: grasps near the best of it are searched and executed in the task, and the best are kept.

What a search finds is ranked, but nothing asks the search itself for grasps that the task lifts well. Near a grasp that
it does lift well there are more of them: of a search that begins near others two fifths are strictly valid and usable,
of one that begins anywhere a fifteenth (the jug's handle).
"""

import json
from dataclasses import replace
from pathlib import Path

from dora.affordance.bundled_sets import ROBOT, bundled_path, load_candidates
from dora.affordance.candidates import GraspCandidates, concatenate
from dora.affordance.objects.catalogue import load_object
from dora.affordance.search.optimise import Settings
from dora.errors import InputError
from dora.progress import ProgressDisplay
from dora.robot import load_robot
from dora.sim.grasp_tests.bundle_maker import KEPT, SetMaker
from dora.tasks import find_task
from dora.tools.in_task.ranking import (
    SEED,
    as_mapping,
    bundle_feasibility_tables,
    rank_in_task,
    ranked,
    tasks_of,
    usable_in_task,
)

GENERATIONS = 2
"""How often is searched near the best."""
PARENTS, CHILDREN = 16, 96
"""The best grasps, near which is searched, and the largest number of new ones in a generation."""
CHILD_TRIES = 4
"""Episodes of each new grasp before the better ones are compared with their parents."""
CONTENDERS, CONTENDER_TRIES = 24, 16
"""How many of parents and new ones together are compared, and episodes of each."""
FINAL_TRIES = 30
"""Episodes of each of the last contenders; their shares of success are the scores."""


def refine_bundled_set(
    name: str | Path,
    phases: ProgressDisplay,
    region: bool = True,
    settings: Settings | None = None,
    generations: int = GENERATIONS,
) -> list[Path]:
    """Refines the bundled grasps of an object that have been ranked in its task, and stores them anew, best first.

    The scores of those that are compared last come from starts that chose nothing before; older grasps keep theirs, but
    at most as high. Grasps of other classes follow as they were. As many are kept as a set has at most.

    Args:
        name: of an object or its folder, as for `load_object`.
        phases: display of the progress.
        region: as for `rank_bundled_set`.
        settings: of the search; those with which the set was made, or the defaults if None.
        generations: how often is searched near the best.

    Returns:
        The file that was written.

    Raises:
        InputError: no such object, no candidates, candidates that have not been ranked, no task that uses the object,
            or one of several arms.
    """
    obj = load_object(name)
    ids = tasks_of(obj)
    if not ids or len(find_task(ids[0]).ARMS) > 1:
        which = f"{ids[0]} has several arms" if ids else f"no task uses the object {str(name)!r}"
        raise InputError(f"{which}, so its grasps cannot be refined in one: leave --refine-in-task out.")
    found = load_candidates(name, region=region)
    if found.ranking_steps is None:
        option = "" if region else " --any-region"
        raise InputError(
            f"the grasps of {str(name)!r} have not been ranked in a task yet: "
            f"do it first with `dora grasps --object {name} --rank-in-task{option}`."
        )
    wanted = found.of_class(obj.target_class) | (not region)
    known = found.select(wanted)
    known = known.select(known.score.nan_to_num(nan=0.0).argsort(descending=True, stable=True))
    refinement = Refinement(name, ids[0], phases, region, settings)
    top = known.select(slice(PARENTS))
    for generation in range(generations):
        top = refinement.generation(top, generation)
    top = refinement.executed(top, FINAL_TRIES, "execute the last ones", 5 * SEED)
    rest = known.select(slice(PARENTS, None)) if len(known) > PARENTS else None
    parts = [top] if rest is None else [top, replace(rest, score=rest.score.clamp(max=float(top.score.min())))]
    kept = concatenate(parts).select(slice(KEPT))
    others = [] if wanted.all() else [found.select(~wanted)]
    made = as_mapping(found.settings)
    made |= {"ranking_steps": found.ranking_steps + refinement.steps, "generations": generations}
    path = bundled_path(name, region)
    replace(concatenate([kept, *others]), settings=json.dumps(made)).save(path)
    bundle_feasibility_tables(name)
    return [path]


class Refinement:
    """Searches near grasps of an object, and executes them in a task; `steps` counts the control steps of that."""

    def __init__(self, name: str | Path, env_id: str, phases: ProgressDisplay, region: bool, settings: Settings | None):
        self.obj, self.env_id, self.phases, self.region = load_object(name), env_id, phases, region
        self.maker = SetMaker(self.obj, load_robot(ROBOT), phases, usable_in_task(name), settings)
        self.steps = 0

    def generation(self, parents: GraspCandidates, index: int) -> GraspCandidates:
        """The best of parents and of new grasps near them, best first."""
        label = self.obj.target if self.region else None
        children = self.maker.near(parents, CHILDREN, SEED + 100 * index, label)
        if children is None:
            return parents
        children = self.executed(children, CHILD_TRIES, "execute new ones", 3 * SEED + 100 * index)
        contenders = concatenate([children.select(slice(CONTENDERS)), parents.select(slice(PARENTS))])
        seed = 4 * SEED + 100 * index
        return self.executed(contenders, CONTENDER_TRIES, "compare with older ones", seed).select(slice(CONTENDERS))

    def executed(self, candidates: GraspCandidates, tries: int, title: str, seed: int) -> GraspCandidates:
        """The candidates with their shares of success in as many episodes each, best first."""
        report = self.phases.phase(f"{self.obj.name}: {title}", "episodes")
        ranking = rank_in_task(
            self.env_id, candidates, tries * len(candidates), progress=report, seed=seed, region=self.region
        )
        self.steps += ranking.steps
        return ranked(candidates, ranking)
