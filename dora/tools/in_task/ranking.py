"""Ranking of candidates by executing them in their task: whole randomised episodes of the scripted solution.

An arm cannot reach every grasp that a simulated hand without an arm holds (`dora.sim.grasp_tests.shake_test`), and some
grasps that it reaches penetrate the object too deep when it is lifted. Episodes of the task show which ones succeed.
"""

import itertools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.affordance.bundled_sets import bundled_path, load_candidates
from dora.affordance.candidates import GraspCandidates, concatenate
from dora.affordance.objects.catalogue import AffordanceObject, load_object
from dora.affordance.reach.feasibility_table import file_name
from dora.errors import InputError
from dora.parallel import run_cases
from dora.reading import parse_json
from dora.tasks import find_task, make_task, task_ids
from dora.tasks.env.env import DoraEnv
from dora.tasks.mdp.stages import ParallelStages
from dora.tools.episodes import play_out

FIRST_TRIES, MORE_TRIES = 6, 30
"""Episodes per grasp when a bundled set is ranked: of all grasps, then of the better ones."""
BETTER = 0.2
"""Share of the grasps that is executed again."""
BATCH = 64
"""Episodes that run together."""
CLEAN = 2 / 3
"""Share of the task's penetration limit within which an execution counts; the margin makes the outcome repeatable."""
STARTS, USABLE = 64, 0.5
"""Number of starts, and the share of them from which a usable grasp must be within reach."""
SEED = 10_000
"""First seed; training and evaluation use none of these."""


def tasks_of(obj: AffordanceObject) -> list[str]:
    """Ids of the registered tasks that use an object, sorted; its grasps are executed in the first."""
    ids = [env_id for env_id in task_ids() if obj.name in {arm.object for arm in find_task(env_id).ARMS.values()}]
    return ids if ids and load_object(obj.name) is obj else []


@dataclass(frozen=True)
class TaskRanking:
    """Result of executing c candidates.

    Attributes:
        tries: episodes in which each one was executed; few or none where the arm seldom reaches it.
        score: share of them that succeeded; 0 without an episode.
        steps: control steps that were simulated, over all candidates.
    """

    tries: Int[Tensor, " c"]
    score: Float[Tensor, " c"]
    steps: int


class _Balanced:
    """Selects for every new episode the reachable candidate with fewest tries; among equals, in turn from `first`."""

    def __init__(self, count: int, first: int = 0):
        self.tries = torch.zeros(count, dtype=torch.long)
        self.turn = ((torch.arange(count) - first) % count) / count
        self.led = torch.empty(0, dtype=torch.long)
        self.possible = torch.empty(0, dtype=torch.bool)

    def __call__(self, reachable: Bool[Tensor, "b c"]) -> Bool[Tensor, "b c"]:
        able = reachable.cpu()
        chosen = []
        for row in able:
            best = int(torch.where(row, self.tries + self.turn, torch.inf).argmin())
            self.tries[best] += int(row[best])
            chosen.append(best)
        self.led, self.possible = torch.tensor(chosen), able.any(-1)
        only = torch.zeros_like(able)
        only[torch.arange(len(able)), self.led] = True
        return only.to(reachable.device) & reachable


Counts = dict[str, tuple[Int[Tensor, " c"], Int[Tensor, " c"]]]
"""By arm, how often each of its candidates was executed, and how often with success."""


class _Executor:
    """Executes batches of episodes of a task with candidates by arm, one batch after the other; `region` as in
    `rank_in_task`."""

    def __init__(self, env_id: str, preset: str, candidates: Mapping[str, GraspCandidates], region: bool):
        self.task = make_task(env_id, BATCH, preset=preset, grasps={k: _all_valid(v) for k, v in candidates.items()})
        self.sizes = {arm: len(found) for arm, found in candidates.items()}
        self.region = region

    def __call__(self, case: tuple[int, int]) -> Counts:
        """What comes of a batch of (index, seed)."""
        index, seed = case
        picks = {arm: _Balanced(count, index * BATCH) for arm, count in self.sizes.items()}
        self.task.narrow = picks
        counts = {}
        for arm, won in _executed(self.task, seed, self.region).items():
            if arm in picks:
                led = picks[arm].led[won.cpu() & picks[arm].possible]
                counts[arm] = picks[arm].tries, torch.bincount(led, minlength=self.sizes[arm])
        return counts


def _all_valid(candidates: GraspCandidates) -> GraspCandidates:
    """The candidates without the verdict of the grasp test, so that a task leaves none out."""
    return replace(candidates, valid=torch.ones_like(candidates.valid))


def rank_in_task(
    env_id: str,
    candidates: GraspCandidates,
    episodes: int,
    preset: str = "standard",
    progress: Callable[[int, int], None] | None = None,
    seed: int = SEED,
    processes: int | None = None,
    region: bool = True,
) -> TaskRanking:
    """Execute c candidates in a task, each about equally often, where f_reach allows it.

    Args:
        env_id: the task.
        candidates: grasps of its object.
        episodes: in all, rounded up to whole batches of 64.
        preset: how the episodes are randomised; with candidate error, so that fragile grasps fail.
        progress: is called with (episodes done, episodes).
        seed: of starts and errors; the result does not depend on `processes`.
        processes: number of processes, one per core by default; 1 stays in this process.
        region: count the task's success; otherwise whether the object is held in the end, whatever region of it.
    """
    (arm,) = find_task(env_id).ARMS
    return rank_arms(env_id, {arm: candidates}, episodes, preset, progress, seed, processes, region)[arm]


def rank_arms(
    env_id: str,
    candidates: Mapping[str, GraspCandidates],
    episodes: int,
    preset: str = "standard",
    progress: Callable[[int, int], None] | None = None,
    seed: int = SEED,
    processes: int | None = None,
    region: bool = True,
) -> dict[str, TaskRanking]:
    """The same for candidates of several arms, which are executed in the same episodes.

    With stages of its own for each arm, an arm has succeeded when all of its stages are done and nothing overlapped too
    deep. Arguments as of `rank_in_task`, but `candidates` by arm; arms that are left out use the task's own.
    """
    cases = [(index, seed + index) for index in range(-(-episodes // BATCH))]

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress(done * BATCH, total * BATCH)

    found: list[Counts] = run_cases(_Executor, (env_id, preset, candidates, region), cases, processes, report, chunk=1)
    rankings = {}
    for arm in candidates:
        tries, wins = (torch.stack(counts).sum(0) for counts in zip(*(one[arm] for one in found), strict=True))
        steps = len(cases) * BATCH * find_task(env_id).MAX_STEPS
        rankings[arm] = TaskRanking(tries, wins / tries.clamp(min=1), steps)
    return rankings


def _executed(task: DoraEnv, seed: int, region: bool) -> dict[str, Bool[Tensor, " n"]]:
    """By arm, which of n episodes of the scripted solution succeed, or hold the object in the end whatever its region,
    without failure on the way and within `CLEAN`."""
    task.reset(seed=seed)
    success, failed, _ = play_out(task, lambda _: task.scripted_action())
    clean = ~failed & (task.memory.max_penetration <= CLEAN * task.config.penetration_limit)
    if not region:
        return {arm: clean & task.task.held(task.snapshot.of(arm), arm) for arm in task.arms}
    if isinstance(task.machine, ParallelStages):
        return {arm: machine.finished & clean for arm, machine in task.machine.machines.items()}
    (arm,) = task.arms
    return {arm: clean & success}


def ranked(candidates: GraspCandidates, ranking: TaskRanking) -> GraspCandidates:
    """The candidates with the scores of a ranking, best first; among equals, those with more tries."""
    order = torch.argsort(ranking.score + 1e-6 * ranking.tries, descending=True, stable=True)
    return replace(candidates, score=ranking.score).select(order)


def usable_in_task(name: str | Path) -> Callable[[GraspCandidates], Bool[Tensor, " c"]] | None:
    """A function that tells which grasps of an object are usable in its task, by the task's f_reach.

    None where there is no such task, or the object stands on a table, which the search for grasps takes care of.
    """
    obj = load_object(name)
    ids = tasks_of(obj)
    return None if not ids or obj.on_table else _Usable(ids[0], obj.name)


class _Usable:
    """Which of c candidates are within reach from at least a share `USABLE` of `STARTS` starts of a task (c,).

    The starts are drawn once, when it is first called; candidates are in the frame of the task's object [m].
    """

    def __init__(self, env_id: str, obj: str):
        self._env_id = env_id
        self._arm = next(arm for arm, spec in find_task(env_id).ARMS.items() if spec.object == obj)
        self._task: DoraEnv | None = None

    def __call__(self, candidates: GraspCandidates) -> Bool[Tensor, " c"]:
        if self._task is None:
            self._task = make_task(self._env_id, STARTS, grasps={self._arm: _all_valid(candidates)})
            self._task.reset(seed=SEED)
        task, arm = self._task, self._task.arms[self._arm]
        adapted = task.task.adapted(candidates, self._arm, arm.agent.description)
        arm.guide.choice.candidates = adapted.to(task.device)
        pose = task.objects[arm.spec.object].pose
        able = task.task.reachable(arm, torch.arange(STARTS), pose.p, pose.q)
        return (able.float().mean(0) >= USABLE).cpu()


def rank_bundled_set(
    name: str | Path, phase: Callable[[str], Callable[[int, int], None]], region: bool = True
) -> list[Path]:
    """Executes the bundled grasps of an object in its task and stores them anew, best first, with the number of steps
    that this took. Those of the search for the target region are ranked if they have its class.

    All are tried a few times, and the better ones again with other starts: their scores are those of the second round,
    and those of the others at most as high. Grasps of other classes follow as they were. The tables of f_reach in the
    object's folder are made to match. In a task of several arms, the grasps of all of them are ranked together, in the
    same episodes; those of an object that another task ranks for itself go into a file of their own.

    Args:
        name: of an object or its folder, as for `load_object`.
        phase: gives the progress callback of a named phase.
        region: the set of the search for the target region, ranked by success; otherwise the set of the search that
            knows no region, of all classes, ranked by whether the object is held.

    Returns:
        The files that were written.

    Raises:
        InputError: no such object, no candidates, or no task that uses the object.
    """
    obj = load_object(name)
    ids = tasks_of(obj)
    if not ids:
        why = f"no task uses the object {str(name)!r}, so its grasps cannot be ranked in one"
        raise InputError(f"{why}: leave --rank-in-task out.")
    arms = find_task(ids[0]).ARMS
    objects = {arm: obj if spec.object == obj.name else load_object(spec.object) for arm, spec in arms.items()}
    found = {arm: load_candidates(name if o is obj else o.name, region=region) for arm, o in objects.items()}
    wanted = {
        arm: f.of_class(objects[arm].target_class) if region else torch.ones(len(f), dtype=torch.bool)
        for arm, f in found.items()
    }
    tested = {arm: found[arm].select(mask) for arm, mask in wanted.items()}
    everything, better = phase(f"{obj.name}: execute all"), f"{obj.name}: execute the better ones"
    first = rank_arms(ids[0], tested, FIRST_TRIES * _most(tested), progress=everything, region=region)
    tested = {arm: ranked(t, first[arm]) for arm, t in tested.items()}
    best = {arm: t.select(slice(math.ceil(BETTER * len(t)))) for arm, t in tested.items()}
    again = rank_arms(ids[0], best, MORE_TRIES * _most(best), progress=phase(better), seed=2 * SEED, region=region)
    written = []
    for arm, one in objects.items():
        top = ranked(best[arm], again[arm])
        rest = tested[arm].select(slice(len(top), None)) if len(top) < len(tested[arm]) else None
        low = float(top.score.min())
        parts = [top] + ([replace(rest, score=rest.score.clamp(max=low))] if rest is not None else [])
        others = [found[arm].select(~wanted[arm])] if not wanted[arm].all() else []
        settings = as_mapping(found[arm].settings) | {"ranking_steps": first[arm].steps + again[arm].steps}
        own = None if tasks_of(one)[:1] in ([], [ids[0]]) else ids[0]
        written.append(bundled_path(name if one is obj else one.name, region, own))
        replace(concatenate([*parts, *others]), settings=json.dumps(settings)).save(written[-1])
        bundle_feasibility_tables(name if one is obj else one.name)
    return written


def _most(sets: Mapping[str, GraspCandidates]) -> int:
    """Number of candidates of the largest set."""
    return max(map(len, sets.values()))


def as_mapping(settings: str) -> dict[str, Any]:
    """Settings of candidates by name; those of early files are the search's alone."""
    try:
        made = parse_json(settings or "{}", "the settings of the grasps")
    except InputError:
        made = None
    return made if isinstance(made, dict) else {"search": settings}


def bundle_feasibility_tables(name: str | Path) -> list[Path]:
    """Puts the tables of f_reach of all tasks that use an object into its folder, and removes those of former grasps.

    Raises:
        InputError: no such object, or it has no folder.
    """
    obj, folder, kept = load_object(name), bundled_path(name).parent, list[Path]()
    sets = ["affordance"] + ["grasps"] * bundled_path(name, region=False).is_file()
    for env_id, guidance in itertools.product(tasks_of(obj), sets):
        try:
            task = make_task(env_id, 1, guidance)
        except InputError:
            if guidance == "affordance":
                raise
            continue  # another object of this task has no grasps of a search that knows no region
        for arm in task.arms.values():
            if arm.spec.object == obj.name and (table := arm.reach_table) is not None:
                kept.append(folder / file_name(table.digest))
                table.save(kept[-1])
        task.close()
    for old in set(folder.glob(file_name("*"))) - set(kept):
        old.unlink()
    return kept
