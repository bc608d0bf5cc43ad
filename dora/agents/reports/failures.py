"""Why episodes of an evaluation failed, from their tables."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float


def failure_kinds(tables: Sequence[Mapping[str, Float[np.ndarray, " _"]]]) -> dict[str, float]:
    """Share of episodes that failed for each reason, the most frequent first.

    Args:
        tables: columns of the eval.csv of each run.
    """
    counts: dict[str, int] = {}
    total = 0
    for table in tables:
        left = table["success"] == 0
        total += len(left)
        checks = [
            ("simulation not finite", table.get("nonfinite")),
            ("no grasp within reach", table.get("unreachable")),
            ("overlap alone", table.get("raw_success")),
        ]
        for kind, column in checks:
            if column is not None and len(column) == len(left):
                left = _count(counts, kind, left, column > 0)
        for name, column in table.items():
            if name.startswith("stage/"):
                left = _count(counts, f"before {name.removeprefix('stage/')}", left, column == 0)
        _count(counts, "lost again at the end", left, left)
    return {kind: count / total for kind, count in sorted(counts.items(), key=lambda item: -item[1]) if count}


def _count(counts: dict[str, int], kind: str, left: np.ndarray, applies: np.ndarray) -> np.ndarray:
    """Adds the episodes to which a reason applies; the mask of those that are left."""
    counts[kind] = counts.get(kind, 0) + int((left & applies).sum())
    return left & ~applies
