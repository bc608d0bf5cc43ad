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
    SHARED,
    UNKNOWN,
    Run,
    grouped,
    in_words,
    shared_mark,
    zero_episodes,
    zero_shares,
)
from dora.agents.reports.section import NONE, OVERLAP, Section, outcomes_of, rate_of, success_of, with_interval
from dora.agents.reports.statistics import aggregates, crossed_interval, paired_difference

TOO_NARROW = (
    "Of a few seeds it is too narrow: of three that differ by 1 point (standard deviation) it covers the true mean in "
    "95 of 100 cases, by 2.4 points in 90, by 5 in 84, by 11 in 76."
)
"""What bootstrap intervals over seeds leave out; measured on invented runs of three seeds and 500 starts."""
SWITCHES = ("optimised",)
"""Switches of tasks that choose between variants of them."""
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
    budgets the largest with which the task was run with guidance, so that all its cells have the same; of several
    variants of a task's numbers that with most runs by its present rules, the first of equals."""
    groups = {
        (env, agent, guidance.partition(",")[0], thousands, guidance): members
        for (env, preset, agent, guidance, thousands), members in grouped(runs).items()
        if preset == DEFAULT_PRESET and (env, agent, guidance.partition(",")[0]) in PAPER
    }
    budget = {env: _budget([group for group in groups if group[0] == env]) for env, *_ in groups}
    found: dict[Cell, list[Run]] = {}
    for (env, agent, guidance, thousands, _), members in groups.items():
        cell = env, agent, guidance
        if thousands == budget[env] and _worth(members) > _worth(found.get(cell, [])):
            found[cell] = members
    return found


def _worth(runs: Sequence[Run]) -> tuple[int, int]:
    """Order of variants: runs by the present rules, runs."""
    return sum(not run.outdated for run in runs), len(runs)


def _budget(groups: Sequence[tuple[str, str, str, int, str]]) -> int:
    """The budget of a task in the tables [thousand steps].

    Args:
        groups: task, learner, guidance, budget and variant of its runs.
    """
    guided = [thousands for _, _, guidance, thousands, _ in groups if guidance == "affordance"]
    return max(guided or [thousands for *_, thousands, _ in groups])


def variant(runs: Sequence[Run]) -> str:
    """Budget of the runs of a cell, and in what they differ from other runs of their task, learner and guidance, or
    from a training by the task's own rules."""
    run = runs[0]
    words = run.label.split(", ") if run.label else []
    words += [
        in_words(name, str(value))
        for name, value in (run.result.get("task_config") or {}).items()
        if (name in SWITCHES and isinstance(value, bool) and run.result["guidance"] != "none")
        or (name, str(value)) in TOLD
    ]
    return ", ".join(dict.fromkeys([f"{run.budget / 1000:.0f}k", *words]))


def _success(cells: Mapping[Cell, list[Run]]) -> Section:
    rows = []
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
            known = [run.result.get("raw_success_rate") for run in runs]
            raw = NONE if None in known else f"{100 * mean(rate for rate in known if rate is not None):.1f}"
        about = [str(len(runs)), variant(runs) if runs else NONE]
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
            f"{mean(run.minutes for run in cells[cell]):.1f}{shared_mark(cells[cell])}",
            f"{printed.minutes:.1f}",
        ]
        for cell, printed in PAPER.items()
        if cell in cells and printed.minutes is not None
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
        if size is not None:
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
        zero = outcomes_of(zero_episodes(members), [run.result.get("first_seed") for run in members])
        ours = success_of(members)
        if zero is not None and ours is not None and zero.shape[1] == ours.shape[1]:
            text = with_interval(*paired_difference(ours, zero), sign=True)
        elif zero_shares(members):
            text = f"{rate_of(members) - 100 * mean(share for share, _ in zero_shares(members)):+.1f}"
        else:
            continue
        rows.append([env, preset, agent, guidance, str(len(members)), text])
    note = (
        f"In brackets the bootstrap interval over seeds and starts, where the episodes of both are there. {TOO_NARROW}"
    )
    head = ("task", "preset", "learner", "guidance", "seeds", "points")
    return Section("Learned less zero correction, on the same starts", head, rows, note)


def _stages(runs: Sequence[Run]) -> Section:
    rows = []
    for (env, preset, agent, guidance, _), members in grouped(runs).items():
        names = list(members[0].result.get("stage_rates") or {})
        rates = [[run.result.get("stage_rates", {}).get(name) for run in members] for name in names]
        known = [
            (name, mean(r)) for name, r in zip(names, rates, strict=True) if all(isinstance(x, float | int) for x in r)
        ]
        if known:
            rows.append([env, preset, agent, guidance, ", ".join(f"{name} {100 * rate:.1f}" for name, rate in known)])
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
