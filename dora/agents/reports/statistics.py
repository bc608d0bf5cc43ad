"""Intervals of success over seeds and starts, differences on the same starts, and aggregates over tasks."""

import functools
import importlib
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from dora.tables import wilson

SAMPLES = 2000
"""Samples of a bootstrap [1]."""
SEED = 0
"""Of the bootstrap's random numbers."""
PERCENTILES = (2.5, 97.5)
"""Ends of an interval [%]."""

BLOCK = 2_000_000
"""Most numbers of draws that are held at once."""
Interval = tuple[float, float]
"""Its ends."""
Counts = list[Float[np.ndarray, "samples size"]]
"""How often each seed, start, ... is in some of the samples."""


def crossed_interval(outcomes: Float[np.ndarray, "seeds starts"]) -> Interval:
    """Bootstrap interval of the mean over seeds and starts, both drawn with replacement: a start that is hard is hard
    for every seed, so episodes are not independent. With one seed, over starts alone. Where all episodes end
    alike there is nothing to draw from, and the interval is Wilson's over the starts.

    Args:
        outcomes: of each seed in the episode of each start.
    """
    if np.ptp(outcomes) == 0:
        starts = outcomes.shape[1]
        return wilson(round(starts * float(outcomes.mean())), starts)
    return _interval([_means(outcomes, seeds, starts) for seeds, starts in _drawn(outcomes.shape)])


def paired_difference(
    ours: Float[np.ndarray, "seeds starts"], theirs: Float[np.ndarray, "others starts"]
) -> tuple[float, Interval]:
    """Mean difference on the same starts with its bootstrap interval over starts, and over the seeds of each side.

    Args:
        ours: outcomes of each seed for each start.
        theirs: the same of what is compared, such as zero correction (one row).
    """
    drawn = _drawn((ours.shape[1], len(ours), len(theirs)))
    found = [_means(ours, seeds, starts) - _means(theirs, others, starts) for starts, seeds, others in drawn]
    return float(ours.mean() - theirs.mean()), _interval(found)


def difference_of_pairs(
    there: Float[np.ndarray, "seeds starts"], here: Float[np.ndarray, "seeds starts"]
) -> tuple[float, Interval]:
    """Mean difference of the same policies on the same starts, with its bootstrap interval over policies and starts,
    which are drawn for both sides together.

    Args:
        there: outcomes of each policy for each start.
        here: the same under what it is compared with.
    """
    difference = np.asarray(there - here, float)
    found = difference.mean()
    interval = (found, found) if np.ptp(difference) == 0 else crossed_interval(difference)
    return float(found), (float(interval[0]), float(interval[1]))


def _drawn(sizes: tuple[int, ...]) -> Iterable[Counts]:
    """How often each of so many seeds, starts, ... is drawn in each sample, which depends on their numbers alone: kept
    for the next call, or in blocks of samples where it is too much."""
    return _kept(sizes) if SAMPLES * sum(sizes) <= BLOCK else _blocks(sizes)


@functools.lru_cache(maxsize=8)
def _kept(sizes: tuple[int, ...]) -> list[Counts]:
    return list(_blocks(sizes))


def _blocks(sizes: tuple[int, ...]) -> Iterator[Counts]:
    generator = np.random.default_rng(SEED)
    most = max(BLOCK // sum(sizes), 1)
    for first in range(0, SAMPLES, most):
        rows = min(most, SAMPLES - first)
        counts = [np.zeros((rows, size)) for size in sizes]
        for row in range(rows):
            for size, count in zip(sizes, counts, strict=True):
                count[row] = np.bincount(generator.integers(size, size=size), minlength=size)
        yield counts


def _means(
    outcomes: Float[np.ndarray, "seeds starts"],
    seeds: Float[np.ndarray, "samples seeds"],
    starts: Float[np.ndarray, "samples starts"],
) -> Float[np.ndarray, " samples"]:
    """Mean of each sample, in which seeds and starts were drawn so often."""
    return ((seeds @ outcomes) * starts).sum(1) / outcomes.size


def _interval(means: Sequence[Float[np.ndarray, " samples"]]) -> Interval:
    low, high = np.percentile(np.concatenate(means), PERCENTILES)
    return float(low), float(high)


def mean_of_curve(curve: Sequence[Mapping[str, float]], budget: int) -> float | None:
    """Mean success over the steps of a run: the area under its evaluations, with straight lines between them, the first
    value before the first and the last after the last (runs that end early have reached what they wanted)."""
    if not curve or budget <= 0:
        return None
    at = np.array([0.0, *(row["env_steps"] for row in curve), max(budget, curve[-1]["env_steps"])])
    values = np.array([curve[0]["success_rate"], *(row["success_rate"] for row in curve), curve[-1]["success_rate"]])
    return float(np.trapezoid(values, at) / at[-1])


def aggregates(
    scores: Mapping[str, Float[np.ndarray, "seeds tasks"]],
) -> dict[str, list[tuple[float, Interval]]] | None:
    """Mean and interquartile mean over seeds and tasks with stratified bootstrap intervals, by rliable (Agarwal et al.
    2021); None if it is not installed.

    Args:
        scores: success of each seed in each task, by what is compared; at least two seeds.
    """
    try:
        library: Any = importlib.import_module("rliable.library")
        metrics: Any = importlib.import_module("rliable.metrics")
    except ImportError:
        return None

    def both(x: np.ndarray) -> np.ndarray:
        return np.array([metrics.aggregate_mean(x), metrics.aggregate_iqm(x)])

    before = np.random.get_state()  # noqa: NPY002  rliable draws from the global generator, whatever it is given
    try:
        np.random.seed(SEED)  # noqa: NPY002
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # of what rliable calls
            points, intervals = library.get_interval_estimates(dict(scores), both, reps=SAMPLES)
    finally:
        np.random.set_state(before)  # noqa: NPY002
    return {
        name: [
            (float(p), (float(low), float(high))) for p, low, high in zip(points[name], *intervals[name], strict=True)
        ]
        for name in scores
    }
