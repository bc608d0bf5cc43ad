"""A table of a report, and the rates in its cells."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

import numpy as np
from jaxtyping import Float

from dora.agents.reports.run_results import Run, success_shares
from dora.agents.reports.statistics import Interval, crossed_interval

FEWEST = 3
"""Seeds of every side that a verdict needs [1]."""
NONE = "-"
"""Cell of a table for which there is no run."""
OVERLAP = "penetration_mm"
"""Column of an episode's largest overlap [mm]."""
TOO_NARROW = (
    "Of a few seeds it is too narrow: of three that differ by 1 point (standard deviation) it covers the true mean in "
    "95 of 100 cases, by 2.4 points in 90, by 5 in 84, by 11 in 76."
)
"""What bootstrap intervals over seeds leave out; measured on invented runs of three seeds and 500 starts."""
NORMAL = 1.96
"""Half width of a normal distribution's 95 % interval, in standard deviations [1]."""


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


def success_of(runs: Sequence[Run]) -> Float[np.ndarray, "seeds starts"] | None:
    """Outcomes of all seeds on the starts that all were evaluated on; None if their episodes are not there."""
    return outcomes_of([run.episodes for run in runs], [run.result.get("first_seed") for run in runs])


def outcomes_of(
    tables: Sequence[Mapping[str, Float[np.ndarray, " _"]]], first: Sequence[int | None]
) -> Float[np.ndarray, "seeds starts"] | None:
    """Outcomes in tables of episodes; None if one is missing, or they are not of the same starts.

    Args:
        tables: columns by name, of each seed.
        first: seed of the first start of each.
    """
    columns = [table.get("success") for table in tables]
    known = [column for column in columns if column is not None]
    alike = len(known) == len(columns) and len({len(c) for c in known}) == 1 and len(set(first)) == 1
    return np.stack(known) if alike else None


def rate_of(runs: Sequence[Run]) -> float:
    """Success over the episodes of all runs [%]; the mean of their rates where it is not known how many there were."""
    return mean_of(success_shares(runs))


def mean_of(shares: Sequence[tuple[float, int]]) -> float:
    """A share over the episodes of all runs [%]; the mean of the shares where it is not known how many there were.

    Args:
        shares: of each run, and its episodes.
    """
    trials = sum(n for _, n in shares)
    return 100 * (sum(s * n for s, n in shares) / trials if all(n for _, n in shares) else mean(s for s, _ in shares))


def error_of(runs: Sequence[Run]) -> float:
    """Standard error of `rate_of` over seeds and starts [%]; infinite where the episodes are not there."""
    outcomes = success_of(runs)
    if outcomes is None:
        return float("inf")
    low, high = crossed_interval(outcomes)
    return 100 * (high - low) / (2 * NORMAL)


def with_interval(value: float, interval: Interval, sign: bool = False) -> str:
    """A percentage and its interval, given as shares."""
    form = "+.1f" if sign else ".1f"
    return f"{100 * value:{form}} [{100 * interval[0]:{form}}, {100 * interval[1]:{form}}]"
