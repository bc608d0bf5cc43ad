"""What guidance gains, and how soon: final success, mean over training, steps and minutes to a share of successes."""

from collections.abc import Iterator, Mapping, Sequence
from statistics import mean

from dora.agents.reports.paper import PAPER, Cell
from dora.agents.reports.run_results import (
    SECONDS_PER_MINUTE,
    Group,
    Run,
    grouped,
    same_task,
    same_values,
    seeds_of,
    shared_mark,
)
from dora.agents.reports.section import FEWEST, NONE, TOO_NARROW, Section, rate_of, success_of, with_interval
from dora.agents.reports.statistics import mean_of_curve, paired_difference

OTHER_TASK = "the tasks have other numbers"
"""In the place of a difference between runs that did not do the same."""
MOST = 0.8
"""Share of successes of the entry `steps_to_80` of a result [1]."""
IN_STEPS, IN_MINUTES = (0.5, 0.8), (0.5, 0.8, 0.9)
"""Shares of successes in training's evaluations whose steps and whose minutes are told [1]."""


def gains(cells: Mapping[Cell, list[Run]]) -> Section:
    """Guidance `affordance` less `none`, in the cells of the paper's tables."""
    rows = []
    for env, agent, guided, plain in _pairs(cells):
        printed = PAPER[env, agent, "affordance"].success - PAPER[env, agent, "none"].success
        final = f"{rate_of(guided) - rate_of(plain):+.1f}" if same_task(guided[0], plain[0]) else OTHER_TASK
        soon = (_steps(runs) for runs in (guided, plain))
        rows.append([env, agent, final, f"{printed:+.1f}", _gain_of_mean(guided, plain), *soon])
    head = ("task", "learner", "gain", "gain in the paper", "gain of the mean over training",
            "steps to 80 %, guided", "steps to 80 %, unguided")  # fmt: skip
    note = (
        "Guidance `affordance` less `none`, in points of success. The mean over training is the area under the "
        "evaluations, of which the first stands for the time before it and the last for the rest of the budget."
    )
    return Section("What guidance gains", head, rows, note)


def gains_of_regions(runs: Sequence[Run]) -> Section:
    """Guidance `affordance` less `grasps`: the same motion and learner, candidates with and without regions."""
    rows = []
    for guided, plain, (env, preset, agent, guidance, _) in _same_but_regions(runs):
        ours, theirs = success_of(guided), success_of(plain)
        starts = {run.result.get("first_seed") for run in (*guided, *plain)}
        final, verdict = f"{rate_of(guided) - rate_of(plain):+.1f}", NONE
        if ours is not None and theirs is not None and ours.shape[1] == theirs.shape[1] and len(starts) == 1:
            value, (low, high) = paired_difference(ours, theirs)
            final = with_interval(value, (low, high), sign=True)
            verdict = "more" if low > 0 else "less" if high < 0 else "not told apart"
        fewest = min(seeds_of(guided), seeds_of(plain))
        verdict = f"too few runs: {fewest} of {FEWEST} seeds" if verdict != NONE and fewest < FEWEST else verdict
        seeds = f"{seeds_of(guided)}, {seeds_of(plain)}"
        soon = (_steps(some) for some in (guided, plain))
        rows.append([env, preset, agent, guidance, seeds, final, verdict, _gain_of_mean(guided, plain), *soon])
    head = ("task", "preset", "learner", "guidance", "seeds of each", "points more than with `grasps`", "verdict",
            "gain of the mean over training", "steps to 80 %", "steps to 80 % with `grasps`")  # fmt: skip
    note = (
        "The same reference motion, learner, budget and starts; the candidates of `grasps` are of a search without "
        "regions. (A grasp made by hand is of no search: its row does not tell what regions gain.) In brackets the "
        f"bootstrap interval over seeds and starts. {TOO_NARROW}"
    )
    return Section("What regions gain: affordance less grasps", head, rows, note)


def how_soon(runs: Sequence[Run]) -> Section:
    """Steps and minutes at which an evaluation during training first reached some shares of successes."""
    rows = []
    for (env, preset, agent, guidance, _), members in grouped(runs).items():
        if all(run.curve for run in members):
            steps = [_reached(members, share, "env_steps", 1000, "k") for share in IN_STEPS]
            minutes = [_reached(members, share, "wall_seconds", SECONDS_PER_MINUTE, "") for share in IN_MINUTES]
            rows.append([env, preset, agent, guidance, *steps, *minutes, shared_mark(members).strip()])
    head = ("task", "preset", "learner", "guidance", *(f"steps to {100 * share:.0f} %" for share in IN_STEPS),
            *(f"minutes to {100 * share:.0f} %" for share in IN_MINUTES), "mark")  # fmt: skip
    note = (
        "Mean over the seeds that reached it, evaluations included; in brackets how many did, where not all. Nothing "
        "is reached before the first evaluation, which a task's settings have after 40,000 to 150,000 steps. Marks as "
        "in the table of all runs."
    )
    return Section("How soon: steps and minutes to a share of successes", head, rows, note)


def _reached(runs: Sequence[Run], share: float, column: str, unit: float | int, after: str) -> str:
    """Mean of a column of the learning curves in the first row with such a share of successes."""
    first = [_first(run, share, column) for run in runs]
    known = [value / unit for value in first if value is not None]
    count = "" if len(known) == len(runs) else f" ({len(known)} of {len(runs)})"
    return f"{mean(known):.{0 if after else 1}f}{after}{count}" if known else "never"


def _steps(runs: Sequence[Run]) -> str:
    """Steps to 80 % of the seeds that reached it, of those whose evaluations are known."""
    told = [run for run in runs if run.curve or "steps_to_80" in run.result]
    known = [run.result.get("steps_to_80", _first(run, MOST, "env_steps")) for run in told]
    reached = [steps for steps in known if steps is not None]
    if not known:
        return NONE
    return f"{mean(reached) / 1000:.0f}k ({len(reached)} of {len(known)})" if reached else f"never (0 of {len(known)})"


def _first(run: Run, share: float, column: str) -> float | None:
    """A column of the learning curve in its first row with such a share of successes."""
    return next((row[column] for row in run.curve if row["success_rate"] >= share), None)


def _gain_of_mean(guided: Sequence[Run], plain: Sequence[Run]) -> str:
    """Difference of the areas under the evaluations of training."""
    areas = [[a for r in runs if (a := mean_of_curve(r.curve, r.budget)) is not None] for runs in (guided, plain)]
    return f"{100 * (mean(areas[0]) - mean(areas[1])):+.1f}" if all(areas) else NONE


def _pairs(cells: Mapping[Cell, list[Run]]) -> Iterator[tuple[str, str, list[Run], list[Run]]]:
    """Task, learner, guided and unguided runs, where there are both."""
    for env, agent, guidance in PAPER:
        if guidance == "affordance" and {(env, agent, guidance), (env, agent, "none")} <= set(cells):
            yield env, agent, cells[env, agent, guidance], cells[env, agent, "none"]


def _same_but_regions(runs: Sequence[Run]) -> Iterator[tuple[list[Run], list[Run], Group]]:
    """Runs with `affordance` and those with `grasps` of the same task, learner, budget and settings, and the row of the
    former."""
    rows = grouped(runs)
    for guided, members in rows.items():
        for plain, others in rows.items():
            ours, theirs = members[0], others[0]
            same = guided[:3] == plain[:3] and guided[4] == plain[4] and same_values(ours.settings, theirs.settings)
            whole = ours.result["guidance"] == "affordance" and not ours.result.get("guidance_parts")
            if same and whole and theirs.result["guidance"] == "grasps":
                yield members, others, guided
