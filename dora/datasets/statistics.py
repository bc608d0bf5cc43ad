"""Statistics of a dataset's features, which learners normalise by: of each episode, and of all together."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Shaped

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""Quantiles by name [1]."""
BRIGHTEST = 255.0
"""Value of a picture that counts as 1."""
EVERY = 4
"""Of the pictures of an episode each so many-th is looked at."""

Statistics = dict[str, np.ndarray]
"""Values by the name of the statistic: min, max, mean, std, count and quantiles."""


def vector_statistics(values: Shaped[np.ndarray, "t *shape"]) -> Statistics:
    """Statistics (k,) of a feature with k numbers in each of t steps; (1,) of one with a single number."""
    return _over_rows(values.reshape(len(values), -1).astype(np.float64))


def picture_statistics(pictures: Shaped[np.ndarray, "t h w 3"]) -> Statistics:
    """Statistics (3, 1, 1) of the channels of pictures, in [0, 1]; `count` (1,) counts the pictures looked at."""
    some = pictures[::EVERY]
    found = _over_rows(some.reshape(-1, some.shape[-1]) / BRIGHTEST)
    shaped = {name: value[:, None, None] for name, value in found.items() if name != "count"}
    return {**shaped, "count": np.array([len(some)])}


def joined_statistics(parts: Iterable[Statistics]) -> Statistics:
    """Statistics of all episodes of a feature together, of those of each.

    min, max, mean, std and count are exact; quantiles are the means of the episodes' quantiles, weighted by their
    counts, as LeRobot joins them.
    """
    stacked: dict[str, np.ndarray] = {}
    parts = list(parts)
    for name in parts[0]:
        stacked[name] = np.stack([part[name] for part in parts])
    count = stacked["count"].reshape(-1)
    weight = (count / count.sum()).reshape(-1, *(1 for _ in stacked["mean"].shape[1:]))
    mean = (weight * stacked["mean"]).sum(0)
    variance = (weight * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(0)
    quantiles = {name: (weight * stacked[name]).sum(0) for name in QUANTILES}
    return {
        "min": stacked["min"].min(0), "max": stacked["max"].max(0), "mean": mean, "std": np.sqrt(variance),
        "count": np.array([count.sum()]), **quantiles,
    }  # fmt: skip


def as_lists(statistics: Mapping[str, np.ndarray]) -> dict[str, list]:
    """Statistics as JSON and tables hold them."""
    return {name: value.tolist() for name, value in statistics.items()}


def _over_rows(values: Shaped[np.ndarray, "m k"]) -> Statistics:
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0),
        "count": np.array([len(values)]), **dict(zip(QUANTILES, quantiles, strict=True)),
    }  # fmt: skip
