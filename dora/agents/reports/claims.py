"""What a report says of the paper's claims, and of its best figures."""

from collections.abc import Mapping, Sequence
from statistics import mean

import numpy as np

from dora.agents.reports.paper import BETTER, JUG_GAIN, MEAN_GAIN, ONE_ARM, PAPER, Cell
from dora.agents.reports.run_results import Run, same_task, seeds_of
from dora.agents.reports.section import FEWEST, NONE, NORMAL, Section, error_of, rate_of

EXACT = 1e-9
"""Standard error below which a rate counts as exact [points]."""


class Rates:
    """Rates and standard errors of the cells of the paper's tables [%].

    Args:
        cells: their runs.
    """

    def __init__(self, cells: Mapping[Cell, list[Run]]):
        self.cells = cells
        self.rates = {cell: rate_of(runs) for cell, runs in cells.items()}
        self.errors = {cell: error_of(runs) for cell, runs in cells.items()}

    def rate(self, cell: Cell) -> float:
        """Success; 0 of a cell without runs, of which `verdict` says so."""
        return self.rates.get(cell, 0.0)

    def error(self, cells: Sequence[Cell]) -> float:
        """Standard error of a sum over cells; infinite where the episodes are not there."""
        return sum(self.errors.get(cell, 0.0) ** 2 for cell in cells) ** 0.5

    def verdict(self, needed: Sequence[Cell], margin: float, error: float, words: tuple[str, str]) -> str | None:
        """The first word if `margin` is above zero by more than 1.96 standard errors, the second if it is as far below,
        else "undecided"; a sentence where cells have too few seeds or are of other tasks, None where one has no run."""
        if not set(needed) <= set(self.cells):
            return None
        fewest = min(seeds_of(self.cells[cell]) for cell in needed)
        if fewest < FEWEST:
            return f"too few runs: {fewest} of {FEWEST} seeds"
        if others := self.other_tasks(needed):
            return f"cannot be said: runs of {', '.join(others)} have other numbers of the task"
        sure = np.isfinite(error) and abs(margin) > NORMAL * error
        return words[margin < 0] if sure else "undecided"

    def other_tasks(self, needed: Sequence[Cell]) -> list[str]:
        """Tasks in which some of these cells have other numbers than others."""
        found = {}
        for env in dict.fromkeys(env for env, *_ in needed):
            first, *others = [self.cells[cell][0] for cell in needed if cell[0] == env]
            found[env] = all(same_task(first, other) for other in others)
        return [env for env, alike in found.items() if not alike]

    def row(
        self,
        first: Sequence[str],
        needed: Sequence[Cell],
        ours: str,
        margin: float,
        error: float,
        words: tuple[str, str],
    ) -> list[str]:
        """A row with what it is about, our figure and the verdict."""
        verdict = self.verdict(needed, margin, error, words)
        if verdict is None:
            missing = [" ".join(cell) for cell in needed if cell not in self.cells]
            return [*first, NONE, f"runs are missing: {', '.join(missing)}"]
        return [*first, ours, verdict]


def _learners(env: str) -> list[Cell]:
    """The cells of the two learners of a task with guidance."""
    return [cell for cell in PAPER if cell[0] == env and cell[2] == "affordance"]


def _ahead(env: str, rates: Rates) -> float:
    """By how much the learner that is better on a task in the paper is ahead here [points]."""
    ppo, sac = (rates.rate((env, agent, "affordance")) for agent in ("PPO", "SAC"))
    return ppo - sac if BETTER[env] == "PPO" else sac - ppo


def claims(cells: Mapping[Cell, list[Run]]) -> Section:
    """Whether what the paper claims holds here."""
    rates, words = Rates(cells), ("reproduced", "not reproduced")
    one_arm = [cell for cell in PAPER if cell[0] in ONE_ARM]
    guided = [cell for cell in one_arm if cell[2] == "affordance"]
    gain = mean(rates.rate(cell) - rates.rate((*cell[:2], "none")) for cell in guided)
    jug = [("DoraJug-v1", "PPO", "affordance"), ("DoraJug-v1", "PPO", "none")]
    jug_gain = rates.rate(jug[0]) - rates.rate(jug[1])
    ahead = {env: _ahead(env, rates) for env in BETTER}
    errors = {env: max(rates.error(_learners(env)), EXACT) for env in BETTER}
    weakest = min(ahead, key=lambda env: ahead[env] / errors[env])
    leads = ", ".join(f"{env}: {BETTER[env]} {d:+.1f}" for env, d in ahead.items())
    average = "affordance gains on average over tasks 1 to 3 and both learners"
    rows = [
        rates.row((average, f"{MEAN_GAIN:+.1f}"), one_arm, f"{gain:+.1f}", gain - MEAN_GAIN,
                  rates.error(one_arm) / len(guided), words),
        rates.row(("affordance gains on the jug with PPO", f"{JUG_GAIN:+.1f}"), jug, f"{jug_gain:+.1f}",
                  jug_gain - JUG_GAIN, rates.error(jug), words),
        rates.row(("PPO is better on cube and jug, SAC on the hammer", "yes"), guided, leads, ahead[weakest],
                  errors[weakest], words),
    ]  # fmt: skip
    note = (
        f"A verdict needs {FEWEST} seeds of every cell; it is undecided where the bar is within the 95 % interval over "
        "seeds and starts. The sizes of gains cannot be compared: here `none` takes the whole motion away, too."
    )
    return Section("The paper's claims", ("claim", "paper", "here", "verdict"), rows, note)


def above_the_best(cells: Mapping[Cell, list[Run]]) -> Section:
    """Whether both guided learners are above the paper's better one, task by task."""
    rates, rows = Rates(cells), []
    for env in dict.fromkeys(env for env, *_ in PAPER):
        both = _learners(env)
        best = max(both, key=lambda cell: PAPER[cell].success)
        bar, lowest = PAPER[best].success, min(both, key=rates.rate)
        worst = rates.rate(lowest)
        first = env, f"{bar:.1f} ({best[1]})"
        rows.append(rates.row(first, both, f"{worst:.1f}", worst - bar, rates.error([lowest]), ("yes", "no")))
    note = (
        "No claim of the paper. Its simulator, success and randomisation are others (see below), so this does not say "
        "which method is better."
    )
    head = ("task", "the paper's better learner %", "our worse learner %", "above it")
    return Section("Both learners with affordance beside the paper's best", head, rows, note)
