"""Sections of a report that set runs beside each other and beside the paper: from their files alone."""

from collections.abc import Mapping, Sequence
from statistics import mean

import numpy as np

from dora.agents.reports.claims import above_the_best, claims
from dora.agents.reports.failures import failure_kinds
from dora.agents.reports.gains import gains, gains_of_regions, how_soon
from dora.agents.reports.paper import DIFFERENCES, ONE_ARM, PAPER, Cell
from dora.agents.reports.run_results import (
    DEFAULT_PRESET,
    OF_CANDIDATES,
    SHARED,
    UNKNOWN,
    Run,
    grouped,
    in_words,
    most_frequent,
    seeds_of,
    shared_mark,
    task_numbers,
    zero_episodes,
)
from dora.agents.reports.section import (
    FEWEST,
    NONE,
    OVERLAP,
    TOO_NARROW,
    Section,
    mean_of,
    outcomes_of,
    rate_of,
    success_of,
    with_interval,
)
from dora.agents.reports.statistics import aggregates, crossed_interval, paired_difference
from dora.agents.runs.stored_results import NO_CORRECTION

TOLD = (("reorient", "in_hand"), ("hand_action", "fingers"))
"""Numbers of tasks that make another task of one, also where all runs have them."""


def sections(runs: Sequence[Run]) -> list[Section]:
    """All tables for which there are runs."""
    cells = of_the_paper(runs)
    made = [_differences(runs), _stages(runs), _overlap(runs), _failures(runs), how_soon(runs)]
    made += [gains(cells), gains_of_regions(runs)]
    if cells:
        made += [
            _success(cells),
            _minutes(cells),
            claims(cells),
            above_the_best(cells),
            _setup(cells),
            *_aggregated(cells),
        ]
    return [section for section in made if section.rows]


def of_the_paper(runs: Sequence[Run]) -> dict[Cell, list[Run]]:
    """The runs of each cell of the paper's tables: preset `standard`, the task's own reward, trained. Of several
    budgets one for all cells of a task, see `_budget`; of several variants of a task's numbers that with most runs by
    its present rules, the first of equals."""
    groups = {
        (env, agent, guidance.partition(",")[0], thousands, guidance): members
        for (env, preset, agent, guidance, thousands), members in grouped(runs).items()
        if preset == DEFAULT_PRESET and (env, agent, guidance.partition(",")[0]) in PAPER
    }
    budget = {env: _budget({group: some for group, some in groups.items() if group[0] == env}) for env, *_ in groups}
    found: dict[Cell, list[Run]] = {}
    for (env, agent, guidance, thousands, _), members in groups.items():
        cell = env, agent, guidance
        if thousands == budget[env] and _worth(members) > _worth(found.get(cell, [])):
            found[cell] = members
    return found


def _worth(runs: Sequence[Run]) -> tuple[int, int]:
    """Order of variants: runs by the present rules, runs."""
    return sum(not run.outdated for run in runs), len(runs)


def _budget(groups: Mapping[tuple[str, str, str, int, str], list[Run]]) -> int:
    """The budget of a task in the tables [thousand steps]: the largest with which it was run by its present rules, with
    guidance, with enough seeds for a verdict; where there is none, what is left of these conditions.

    Args:
        groups: runs by task, learner, guidance, budget and variant.
    """

    def order(group: tuple[str, str, str, int, str]) -> tuple[bool, bool, bool, int]:
        members = groups[group]
        enough = seeds_of(members) >= FEWEST
        return not members[0].outdated, group[2] == "affordance", enough, group[3]

    return max(groups, key=order)[3]


def variant(runs: Sequence[Run]) -> str:
    """Budget of the runs of a cell, and in what they differ from other runs of their task, learner and guidance, or
    from a training by the task's own rules."""
    run = runs[0]
    words = run.label.split(", ") if run.label else []
    words += [
        in_words(name, str(value))
        for name, value in (run.result.get("task_config") or {}).items()
        if (name in OF_CANDIDATES and isinstance(value, bool) and run.result["guidance"] != "none")
        or (name, str(value)) in TOLD
    ]
    return ", ".join(dict.fromkeys([f"{run.budget / 1000:.0f}k", *words]))


def other_numbers(cells: Mapping[Cell, list[Run]]) -> dict[Cell, list[str]]:
    """In words, the numbers of the task in which a cell differs from most cells of its task that have them."""
    found: dict[Cell, list[str]] = {cell: [] for cell in cells}
    for env in dict.fromkeys(env for env, *_ in cells):
        numbers = {cell: task_numbers(runs[0]) for cell, runs in cells.items() if cell[0] == env}
        for name in sorted({name for each in numbers.values() for name in each} - set(OF_CANDIDATES)):
            values = {cell: str(each[name]) for cell, each in numbers.items() if name in each}
            usual = most_frequent(list(values.values()))
            for cell, value in values.items():
                found[cell] += [in_words(name, value)] if value != usual and (name, value) not in TOLD else []
    return found


def _success(cells: Mapping[Cell, list[Run]]) -> Section:
    rows, own = [], other_numbers(cells)
    for cell, printed in PAPER.items():
        runs = cells.get(cell, [])
        ours = raw = NONE
        if runs:
            outcomes = success_of(runs)
            ours = (
                f"{rate_of(runs):.1f}"
                if outcomes is None
                else with_interval(outcomes.mean(), crossed_interval(outcomes))
            )
            known = [(run.result.get("raw_success_rate"), run.result.get("eval_episodes", 0)) for run in runs]
            told = [(rate, count) for rate, count in known if rate is not None]
            raw = f"{mean_of(told):.1f}" if len(told) == len(known) else NONE
        about = [str(seeds_of(runs)), ", ".join([variant(runs), *own[cell]]) if runs else NONE]
        rows.append([*cell, *about, ours, raw, f"{printed.success:.1f} ± {printed.deviation:.1f}"])
    head = (
        "task",
        "learner",
        "guidance",
        "seeds",
        "steps, candidates",
        "success %",
        "overlap not counted %",
        "paper %",
    )
    note = (
        "In brackets the bootstrap interval over seeds and starts, where the episodes of all runs are there. "
        + TOO_NARROW
    )
    return Section("Overall success beside the paper's tables II and IV", head, rows, note)


def _minutes(cells: Mapping[Cell, list[Run]]) -> Section:
    rows = [
        [
            *cell,
            f"{mean(known):.1f}{shared_mark(cells[cell])}",
            f"{printed.minutes:.1f}",
        ]
        for cell, printed in PAPER.items()
        if printed.minutes is not None and (known := [m for r in cells.get(cell, []) if (m := r.minutes) is not None])
    ]
    note = (
        "Ours on two CPU cores with all evaluations, the paper's on an RTX 4090. Marks as in the table of all runs: "
        f"other programs ran beside ours ({SHARED.strip()}), or it is not known whether they did ({UNKNOWN.strip()})."
    )
    return Section(
        "Minutes of a run beside the paper's table III", ("task", "learner", "guidance", "minutes", "paper"), rows, note
    )


def _setup(cells: Mapping[Cell, list[Run]]) -> Section:
    """Where the paper's set-up and that of these runs differ."""
    here = {"training": _training(cells), "evaluation": _evaluation(cells)}
    rows = [[what, paper, here.get(what, ours)] for what, paper, ours in DIFFERENCES]
    return Section("How the set-ups differ", ("what", "paper", "here"), rows)


def _training(cells: Mapping[Cell, list[Run]]) -> str:
    """Budgets and minibatches of the runs."""
    budgets = {env: runs[0].budget for (env, *_), runs in cells.items()}
    usual = max(budgets.values(), key=[*budgets.values()].count)
    others = ", ".join(f"{env} {steps:,}" for env, steps in budgets.items() if steps != usual)
    steps = f"{usual:,} steps" + (f" ({others})" if others else "")
    agents: dict[int, set[str]] = {}
    for run in (run for runs in cells.values() for run in runs):
        settings = run.result.get("learner_config") or {}
        size = settings.get("minibatch", settings.get("batch"))
        if isinstance(size, int):
            agents.setdefault(size, set()).add(run.result["agent"].upper())
    known = " and ".join(f"{size} ({', '.join(sorted(some))})" for size, some in sorted(agents.items(), reverse=True))
    return steps + (f", minibatches of {known}" if known else "")


def _evaluation(cells: Mapping[Cell, list[Run]]) -> str:
    """Episodes of the last evaluations."""
    counts = sorted({run.result.get("eval_episodes", 0) for runs in cells.values() for run in runs} - {0})
    known = f"{' or '.join(map(str, counts))} starts" if counts else "starts"
    return f"{known} that training never saw, for each seed"


def _aggregated(cells: Mapping[Cell, list[Run]]) -> list[Section]:
    """Mean and interquartile mean over tasks 1 to 3, of learners with the same seeds in all of them."""
    scores = {}
    for agent in ("PPO", "SAC"):
        for guidance in ("affordance", "none"):
            rates = [
                {run.result.get("seed"): run.result["success_rate"] for run in cells.get((env, agent, guidance), [])}
                for env in ONE_ARM
            ]
            common = sorted(set.intersection(*map(set, rates)), key=str)
            if len(common) >= 2:
                shares = [[one[seed] for seed in common] for one in rates]
                scores[f"{agent}, {guidance}"] = np.array(shares).T
    found = aggregates(scores) if scores else {}
    if found is None:
        return [Section("Over tasks 1 to 3", ("",), [["needs rliable: pip install rliable 'pandas<3'"]])]
    rows = [[name, str(len(scores[name])), *(with_interval(*pair) for pair in both)] for name, both in found.items()]
    head = ("learner, guidance", "seeds", "mean %", "interquartile mean %")
    return [
        Section(
            "Over tasks 1 to 3",
            head,
            rows,
            "By rliable, stratified bootstrap over the seeds that all three tasks have.",
        )
    ]


def _differences(runs: Sequence[Run]) -> Section:
    rows = []
    for (env, preset, agent, guidance, _), members in grouped(runs).items():
        known = [run for run in members if run.result["zero_success_rate"] is not None]
        if not known or members[0].result["agent"] == NO_CORRECTION:
            continue
        zero = outcomes_of(zero_episodes(known), [run.result.get("first_seed") for run in known])
        ours = success_of(known)
        if zero is not None and ours is not None and zero.shape[1] == ours.shape[1]:
            text = with_interval(*paired_difference(ours, zero), sign=True)
        else:
            on_the_same = [(run.result["zero_success_rate"], run.result.get("eval_episodes", 0)) for run in known]
            text = f"{rate_of(known) - mean_of(on_the_same):+.1f}"
        rows.append([env, preset, agent, guidance, str(seeds_of(known)), text])
    note = (
        f"In brackets the bootstrap interval over seeds and starts, where the episodes of both are there. {TOO_NARROW}"
    )
    head = ("task", "preset", "learner", "guidance", "seeds", "points")
    return Section("Learned less zero correction, on the same starts", head, rows, note)


def _stages(runs: Sequence[Run]) -> Section:
    rows = []
    for (env, preset, agent, guidance, _), members in grouped(runs).items():
        names = list(members[0].result.get("stage_rates") or {})
        counts = [run.result.get("eval_episodes", 0) for run in members]
        rates = {name: [run.result.get("stage_rates", {}).get(name) for run in members] for name in names}
        known = [
            f"{name} {mean_of(list(zip(each, counts, strict=True))):.1f}"
            for name, each in rates.items()
            if all(isinstance(rate, float | int) for rate in each)
        ]
        if known:
            rows.append([env, preset, agent, guidance, ", ".join(known)])
    return Section(
        "Sub-tasks: share of episodes that reach each stage",
        ("task", "preset", "learner", "guidance", "stages %"),
        rows,
    )


def _overlap(runs: Sequence[Run]) -> Section:
    rows = []
    for (env, preset, agent, guidance, _), members in grouped(runs).items():
        tables = [run.episodes[OVERLAP] for run in members if OVERLAP in run.episodes]
        if tables:
            depth = np.concatenate(tables)
            cells = [f"{np.percentile(depth, q):.1f}" for q in (50, 90, 95, 99)]
            rows.append([env, preset, agent, guidance, str(len(depth)), *cells, f"{depth.max():.1f}"])
    head = ("task", "preset", "learner", "guidance", "episodes", "median", "90 %", "95 %", "99 %", "largest")
    return Section(
        "Largest overlap of an episode [mm]",
        head,
        rows,
        "In any physics step, of anything with anything. Runs without an eval.csv are left out.",
    )


def _failures(runs: Sequence[Run]) -> Section:
    rows = []
    for (env, preset, agent, guidance, _), members in grouped(runs).items():
        tables = [run.episodes for run in members if run.episodes]
        if tables:
            kinds = failure_kinds(tables)
            text = ", ".join(f"{kind} {100 * share:.1f}" for kind, share in kinds.items())
            rows.append([env, preset, agent, guidance, text or "none"])
    head = ("task", "preset", "learner", "guidance", "share of episodes %")
    return Section(
        "Why episodes fail",
        head,
        rows,
        "Each failed episode by the first of its causes: overlap where all else succeeded, or the first stage "
        "that was not done. Runs without an eval.csv are left out.",
    )
