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
from dora.tasks import find_task, make_task, task_ids
from dora.tasks.env.env import DoraEnv
from dora.tasks.mdp.stages import ParallelStages

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
        self.task = make_task(env_id, BATCH, preset=preset, grasps=candidates)
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
    failed = torch.zeros(task.num_envs, dtype=torch.bool, device=task.device)
    info: dict[str, Tensor] = {}
    for _ in range(task.max_steps):
        *_, info = task.step(task.scripted_action())
        failed |= info["fail"]
    clean = ~failed & (task.memory.max_penetration <= CLEAN * task.config.penetration_limit)
    if isinstance(task.machine, ParallelStages):
        return {arm: machine.finished & clean for arm, machine in task.machine.machines.items()}
    (arm,) = task.arms
    return {arm: clean & (info["success"] if region else task.task.held(task.snapshot))}


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
    return None if not ids or obj.on_table else _Usable(ids[0])


class _Usable:
    """Which of c candidates are within reach from at least a share `USABLE` of `STARTS` starts of a task (c,).

    The starts are drawn once, when it is first called; candidates are in the frame of the task's object [m].
    """

    def __init__(self, env_id: str):
        self._env_id = env_id
        self._task: DoraEnv | None = None

    def __call__(self, candidates: GraspCandidates) -> Bool[Tensor, " c"]:
        if self._task is None:
            self._task = make_task(self._env_id, STARTS, grasps=candidates)
            self._task.reset(seed=SEED)
        task = self._task
        task.guide.choice.candidates = candidates.to(task.device)
        pose = task.target_object.pose
        return (task.task.reachable(task.arm, torch.arange(STARTS), pose.p, pose.q).float().mean(0) >= USABLE).cpu()


def rank_bundled_set(name: str | Path, phase: Callable[[str], Callable[[int, int], None]], region: bool = True) -> Path:
    """Executes the bundled grasps of an object in its task and stores them anew, best first, with the number of steps
    that this took. Those of the search for the target region are ranked if they have its class.

    All are tried a few times, and the better ones again with other starts: their scores are those of the second round,
    and those of the others at most as high. Grasps of other classes follow as they were. The tables of f_reach in the
    object's folder are made to match.

    Args:
        name: of an object or its folder, as for `load_object`.
        phase: gives the progress callback of a named phase.
        region: the set of the search for the target region, ranked by success; otherwise the set of the search that
            knows no region, of all classes, ranked by whether the object is held.

    Raises:
        InputError: no such object, no candidates, or no task that uses the object.
    """
    obj = load_object(name)
    ids = tasks_of(obj)
    if not ids:
        raise InputError(f"no task uses the object {str(name)!r}, so its grasps cannot be ranked in one.")
    found = load_candidates(name, region=region)
    wanted = found.of_class(obj.target_class) if region else torch.ones(len(found), dtype=torch.bool)
    tested = found.select(wanted)
    count, everything, better = len(tested), phase(f"{obj.name}: execute all"), f"{obj.name}: execute the better ones"
    first = rank_in_task(ids[0], tested, FIRST_TRIES * count, progress=everything, region=region)
    tested = ranked(tested, first)
    few = math.ceil(BETTER * count)
    best, rest = tested.select(slice(few)), tested.select(slice(few, None))
    again = rank_in_task(ids[0], best, MORE_TRIES * few, progress=phase(better), seed=2 * SEED, region=region)
    best = ranked(best, again)
    tested = concatenate([best, replace(rest, score=rest.score.clamp(max=float(best.score.min())))])
    others = [found.select(~wanted)] if not wanted.all() else []
    path = bundled_path(name, region)
    settings = _as_mapping(found.settings) | {"ranking_steps": first.steps + again.steps}
    replace(concatenate([tested, *others]), settings=json.dumps(settings)).save(path)
    bundle_feasibility_tables(name)
    return path


def _as_mapping(settings: str) -> dict[str, Any]:
    """Settings of candidates by name; those of early files are the search's alone."""
    try:
        made = json.loads(settings or "{}")
    except ValueError:
        made = None
    return made if isinstance(made, dict) else {"search": settings}


def bundle_feasibility_tables(name: str | Path) -> list[Path]:
    """Puts the tables of f_reach of all tasks that use an object into its folder, and removes those of former grasps.

    Raises:
        InputError: no such object, or it has no folder.
    """
    folder, kept = bundled_path(name).parent, []
    sets = ["affordance"] + ["grasps"] * bundled_path(name, region=False).is_file()
    for env_id, guidance in itertools.product(tasks_of(load_object(name)), sets):
        task = make_task(env_id, 1, guidance)
        table = task.arm.reach_table
        task.close()
        if table is not None:
            kept.append(folder / file_name(table.digest))
            table.save(kept[-1])
    for old in set(folder.glob(file_name("*"))) - set(kept):
        old.unlink()
    return kept
