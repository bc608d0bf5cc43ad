"""Sections of a report that set runs beside each other and beside the paper: from their files alone."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

import numpy as np
from jaxtyping import Float

from dora.agents.reports.failures import failure_kinds
from dora.agents.reports.paper import BETTER, DIFFERENCES, JUG_GAIN, MEAN_GAIN, ONE_ARM, PAPER, Cell
from dora.agents.reports.run_results import (
    DEFAULT_PRESET,
    EARLIER,
    SHARED,
    UNKNOWN,
    Run,
    grouped,
    in_words,
    shared_mark,
    success_shares,
    zero_episodes,
    zero_shares,
)
from dora.agents.reports.statistics import Interval, aggregates, crossed_interval, mean_of_curve, paired_difference

NONE = "-"
"""Cell of a table for which there is no run."""
OVERLAP = "penetration_mm"
"""Column of an episode's largest overlap [mm]."""
SWITCHES = ("optimised",)
"""Switches of tasks that choose between variants of them."""
NORMAL = 1.96
"""Half width of a normal distribution's 95 % interval, in standard deviations [1]."""
FEWEST = 3
"""Seeds of every cell that a verdict on a claim needs [1]."""
EXACT = 1e-9
"""Standard error below which a rate counts as exact [points]."""


@dataclass(frozen=True)
class Section:
    """A table of a report.

    Attributes:
        title: above it.
        head: names of its columns.
        rows: cells.
        note: below it.
    """

    title: str
    head: tuple[str, ...]
    rows: list[list[str]]
    note: str = ""


def sections(runs: Sequence[Run]) -> list[Section]:
    """All tables for which there are runs."""
    cells = of_the_paper(runs)
    made = [_differences(runs), _stages(runs), _overlap(runs), _failures(runs), _gains(cells)]
    if cells:
        made += [_success(cells), _minutes(cells), _claims(cells), _setup(), *_aggregated(cells)]
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
    """Budget of the runs of a cell, and in what the numbers of their task differ from those of other runs."""
    steps = f"{runs[0].budget / 1000:.0f}k"
    words = runs[0].result.get("task_config") or {}
    switches = [
        in_words(name, str(value)) for name, value in words.items() if isinstance(value, bool) and name in SWITCHES
    ]
    return ", ".join([steps, *switches]) + (EARLIER if runs[0].outdated else "")


def success_of(runs: Sequence[Run]) -> Float[np.ndarray, "seeds starts"] | None:
    """Outcomes of all seeds on the starts that all were evaluated on; None if their episodes are not there."""
    return _outcomes([run.episodes for run in runs], [run.result.get("first_seed") for run in runs])


def _outcomes(
    tables: Sequence[Mapping[str, Float[np.ndarray, " _"]]], first: Sequence[int | None]
) -> Float[np.ndarray, "seeds starts"] | None:
    columns = [table.get("success") for table in tables]
    known = [column for column in columns if column is not None]
    alike = len(known) == len(columns) and len({len(c) for c in known}) == 1 and len(set(first)) == 1
    return np.stack(known) if known and alike else None


def _rate(runs: Sequence[Run]) -> float:
    """Success over the episodes of all runs [%]; the mean of their rates where it is not known how many there were."""
    shares = success_shares(runs)
    trials = sum(n for _, n in shares)
    return 100 * (sum(s * n for s, n in shares) / trials if all(n for _, n in shares) else mean(s for s, _ in shares))


def _error(runs: Sequence[Run]) -> float:
    """Standard error of `_rate` over seeds and starts [%]; infinite where the episodes are not there."""
    outcomes = success_of(runs)
    if outcomes is None:
        return float("inf")
    low, high = crossed_interval(outcomes)
    return 100 * (high - low) / (2 * NORMAL)


def with_interval(value: float, interval: Interval, sign: bool = False) -> str:
    """A percentage and its interval, given as shares."""
    form = "+.1f" if sign else ".1f"
    return f"{100 * value:{form}} [{100 * interval[0]:{form}}, {100 * interval[1]:{form}}]"


def _success(cells: Mapping[Cell, list[Run]]) -> Section:
    rows = []
    for cell, printed in PAPER.items():
        runs = cells.get(cell, [])
        ours = raw = NONE
        if runs:
            outcomes = success_of(runs)
            ours = (
                f"{_rate(runs):.1f}" if outcomes is None else with_interval(outcomes.mean(), crossed_interval(outcomes))
            )
            known = [run.result.get("raw_success_rate") for run in runs]
            raw = NONE if None in known else f"{100 * mean(rate for rate in known if rate is not None):.1f}"
        about = [str(len(runs)), variant(runs) if runs else NONE]
        rows.append([*cell, *about, ours, raw, f"{printed.success:.1f} ± {printed.deviation:.1f}"])
    head = ("task", "learner", "guidance", "seeds", "of", "success %", "overlap not counted %", "paper %")
    note = (
        "In brackets the bootstrap interval over seeds and starts, where the episodes of all runs are there. "
        "With three seeds that differ it is too narrow: it covers the true mean in about 85 to 90 of 100 cases."
    )
    return Section("Overall success beside the paper's tables I and IV", head, rows, note)


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


def _pairs(cells: Mapping[Cell, list[Run]]) -> Iterator[tuple[str, str, list[Run], list[Run]]]:
    """Task, learner, guided and unguided runs, where there are both."""
    for env, agent, guidance in PAPER:
        if guidance == "affordance" and {(env, agent, guidance), (env, agent, "none")} <= set(cells):
            yield env, agent, cells[env, agent, guidance], cells[env, agent, "none"]


def _gains(cells: Mapping[Cell, list[Run]]) -> Section:
    rows = []
    for env, agent, guided, plain in _pairs(cells):
        areas = [[a for r in runs if (a := mean_of_curve(r.curve, r.budget)) is not None] for runs in (guided, plain)]
        area = f"{100 * (mean(areas[0]) - mean(areas[1])):+.1f}" if all(areas) else NONE
        printed = PAPER[env, agent, "affordance"].success - PAPER[env, agent, "none"].success
        final = _rate(guided) - _rate(plain)
        rows.append([env, agent, f"{final:+.1f}", f"{printed:+.1f}", area, *(_steps(runs) for runs in (guided, plain))])
    head = ("task", "learner", "gain", "gain in the paper", "gain of the mean over training",
            "steps to 80 %, guided", "steps to 80 %, unguided")  # fmt: skip
    note = "Guidance `affordance` less `none`, in points of success."
    return Section("What guidance gains", head, rows, note)


def _steps(runs: Sequence[Run]) -> str:
    """Steps to 80 % of the seeds that reached it."""
    known = [run.result.get("steps_to_80") for run in runs]
    reached = [steps for steps in known if steps is not None]
    return f"{mean(reached) / 1000:.0f}k ({len(reached)} of {len(known)})" if reached else f"never (0 of {len(known)})"


def _learners(env: str) -> list[Cell]:
    """The cells of the two learners of a task with guidance."""
    return [(env, agent, "affordance") for agent in ("PPO", "SAC")]


def _ahead(env: str, rates: Mapping[Cell, float]) -> float:
    """By how much the learner that is better on a task in the paper is ahead here [points]."""
    ppo, sac = (rates.get(cell, 0.0) for cell in _learners(env))
    return ppo - sac if BETTER[env] == "PPO" else sac - ppo


def _claims(cells: Mapping[Cell, list[Run]]) -> Section:
    rates = {cell: _rate(runs) for cell, runs in cells.items()}

    def row(claim: str, paper: str, needed: Sequence[Cell], ours: str, margin: float, error: float) -> list[str]:
        """A claim that holds if `margin` is above zero, by more than its standard error times 1.96; undecided where
        the error is not known."""
        missing = [
            f"{env} {agent} {guidance}" for env, agent, guidance in needed if (env, agent, guidance) not in cells
        ]
        if missing:
            return [claim, paper, NONE, f"runs are missing: {', '.join(missing)}"]
        fewest = min(len({run.result.get("seed") for run in cells[cell]}) for cell in needed)
        if fewest < FEWEST:
            return [claim, paper, ours, f"too few runs: {fewest} of {FEWEST} seeds"]
        sure = np.isfinite(error) and abs(margin) > NORMAL * error
        return [claim, paper, ours, ("reproduced" if margin >= 0 else "not reproduced") if sure else "undecided"]

    errors = {cell: _error(runs) for cell, runs in cells.items()}

    def spread(some: Sequence[Cell]) -> float:
        """Standard error of a sum over cells."""
        return sum(errors.get(cell, 0.0) ** 2 for cell in some) ** 0.5

    one_arm = [cell for cell in PAPER if cell[0] in ONE_ARM]
    guided = [cell for cell in one_arm if cell[2] == "affordance"]
    gains = [rates.get(cell, 0.0) - rates.get((*cell[:2], "none"), 0.0) for cell in guided]
    jug = ("DoraJug-v1", "PPO", "affordance"), ("DoraJug-v1", "PPO", "none")
    jug_gain = rates.get(jug[0], 0.0) - rates.get(jug[1], 0.0)
    ahead = {env: _ahead(env, rates) for env in BETTER}
    errors_ahead = {env: max(spread(_learners(env)), EXACT) for env in BETTER}
    weakest = min(ahead, key=lambda env: ahead[env] / errors_ahead[env])
    mean_gain, learners = mean(gains), ", ".join(f"{env}: {BETTER[env]} {d:+.1f}" for env, d in ahead.items())
    average = "affordance gains on average over tasks 1 to 3 and both learners"
    rows = [
        row(average, f"{MEAN_GAIN:+.1f}", one_arm, f"{mean_gain:+.1f}", mean_gain - MEAN_GAIN,
            spread(one_arm) / len(guided)),
        row("affordance gains on the jug with PPO", f"{JUG_GAIN:+.1f}", jug, f"{jug_gain:+.1f}", jug_gain - JUG_GAIN,
            spread(jug)),
        row("PPO is better on cube and jug, SAC on the hammer", "yes", guided, learners, ahead[weakest],
            errors_ahead[weakest]),
    ]  # fmt: skip
    for env in dict.fromkeys(env for env, *_ in PAPER):
        both = [cell for cell in PAPER if cell[0] == env and cell[2] == "affordance"]
        bar = max(PAPER[cell].success for cell in both)
        lowest = min(both, key=lambda cell: rates.get(cell, 0.0))
        worst = rates.get(lowest, 0.0)
        claim = f"both guided learners are above the paper's best on {env}"
        rows.append(row(claim, f"{bar:.1f}", both, f"{worst:.1f}", worst - bar, errors.get(lowest, 0.0)))
    note = (
        f"A verdict needs {FEWEST} seeds of every cell; it is undecided where the bar is within the 95 % interval over "
        "seeds and starts. The last four lines are no claims of the paper: they say whether both learners here are "
        "above its best."
    )
    return Section("The paper's claims", ("claim", "paper", "here", "verdict"), rows, note)


def _setup() -> Section:
    return Section("How the set-ups differ", ("what", "paper", "here"), [list(row) for row in DIFFERENCES])


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
    return [Section("Over tasks 1 to 3", head, rows, "By rliable, stratified bootstrap over seeds.")]


def _differences(runs: Sequence[Run]) -> Section:
    rows = []
    for (env, preset, agent, guidance, _), members in grouped(runs).items():
        zero = _outcomes(zero_episodes(members), [run.result.get("first_seed") for run in members])
        ours = success_of(members)
        if zero is not None and ours is not None and zero.shape[1] == ours.shape[1]:
            text = with_interval(*paired_difference(ours, zero), sign=True)
        elif zero_shares(members):
            text = f"{_rate(members) - 100 * mean(share for share, _ in zero_shares(members)):+.1f}"
        else:
            continue
        rows.append([env, preset, agent, guidance, str(len(members)), text])
    note = "In brackets the bootstrap interval over seeds and starts, where the episodes of both are there."
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
