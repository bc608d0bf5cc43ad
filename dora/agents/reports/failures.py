"""Why episodes of an evaluation failed, from their table."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

STAGE = "stage/"
"""Beginning of the columns that say whether a stage was done."""
CHECKS = {
    "the simulation was not finite": "nonfinite", "no grasp within reach": "unreachable",
    "too much overlap": "raw_success",
}  # fmt: skip
"""Causes that come before those of the stages, and the columns that are above 0 where they apply."""
Table: TypeAlias = Mapping[str, Float[np.ndarray, " _"]]
"""Columns of an eval.csv by name, a value for each episode."""


def first_causes(table: Table, max_steps: int | None = None) -> dict[str, int]:
    """Failed episodes by the first cause that applies; a cause without episodes is left out.

    Args:
        table: its columns; what it lacks is no cause.
        max_steps: of an episode that is not ended by a failure [control steps]; None does not tell an object that was
            lost from a stage that took too long.
    """
    left, counts = table["success"] == 0, dict[str, int]()
    for cause, applies in _causes(table, max_steps):
        found = int((left & applies).sum())
        counts |= {cause: found} if found else {}
        left &= ~applies
    return counts


def _causes(table: Table, max_steps: int | None) -> Iterator[tuple[str, Bool[np.ndarray, " _"]]]:
    """Causes in the order in which they count, and the episodes to which they apply."""
    for cause, name in CHECKS.items():
        if name in table:
            yield cause, table[name] > 0
    for column in table:
        if column.startswith(STAGE):
            stage, undone = column.removeprefix(STAGE), table[column] == 0
            if max_steps is not None:
                yield f"object lost before {stage}", undone & (table["length"] < max_steps)
            yield f"{stage} not done" + (" in time" if max_steps else ""), undone
    yield "lost again at the end", np.full(len(table["success"]), True)


def failure_kinds(tables: Sequence[Table]) -> dict[str, float]:
    """Share of episodes that failed for each reason, the most frequent first.

    Args:
        tables: of each run.
    """
    counts: dict[str, int] = {}
    for table in tables:
        for cause, count in first_causes(table).items():
            counts[cause] = counts.get(cause, 0) + count
    total = sum(len(table["success"]) for table in tables)
    return {kind: count / total for kind, count in sorted(counts.items(), key=lambda item: -item[1])}
