"""Progress of a run: what a checkpoint keeps besides tensors, and what it may be."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dora.configs import LARGEST, built, check_ranges
from dora.errors import InputError, shown

PHASES = ("collect", "learn", "evaluate")
"""What most of the time of a run is spent with."""
LEARNER = "learner"
"""Entry of a checkpoint's counters with those of its learner, by name."""
COLUMNS = 3
"""Columns that every row of a learning curve has: environment steps, seconds, success rate."""
COUNTS = ("env_steps", "wall_seconds", "episodes", "next_evaluation", "reached", "nonfinite", "other_seconds")
"""Counters that are at least 0."""
RANGES: dict[str, tuple[float, float]] = dict.fromkeys(COUNTS, (0, LARGEST))
"""Lowest and highest value of these."""


@dataclass
class Counters:
    """Progress of a run."""

    env_steps: int = 0
    wall_seconds: float = 0.0
    """Wall time of the run: start of the workers, collecting, learning, evaluating, saving [s]."""
    episodes: int = 0
    next_evaluation: int = 0
    best: list[float] | None = None
    """Success rate and return of the best evaluation."""
    reached: int = 0
    """Successive evaluations that reached `stop_success`."""
    nonfinite: int = 0
    """Episodes that ended because their simulation was not finite."""
    curve: list[list[Any]] = field(default_factory=list)
    other_seconds: float = 0.0
    """Processor time that other programs took meanwhile [s]."""
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    """Wall time of each of `PHASES` [s]."""


def checked_counters(progress: Mapping[str, Any], path: Path) -> Counters:
    """The counters of a checkpoint; those that it lacks, as of an earlier version, are zero.

    Args:
        progress: by name; besides the counters of the run, those of the learner.
        path: of the checkpoint, for messages.

    Raises:
        InputError: naming what is unknown, or of a wrong type or size.
    """
    what = f"the counters in {path}"
    counters = built(Counters, {name: value for name, value in progress.items() if name != LEARNER}, what)
    for name in COUNTS:
        if isinstance(getattr(counters, name), bool):
            raise _refused(path, name, getattr(counters, name), "a number")
    check_ranges(counters, RANGES, lambda name: f"{what}: {name}")
    best, learner = counters.best, progress.get(LEARNER, {})
    if best is not None and not (len(best) == 2 and 0 <= best[0] <= 1 and -LARGEST < best[1] < LARGEST):
        raise _refused(path, "best", best, "a success rate and a return")
    for row in counters.curve:
        if len(row) < COLUMNS or not all(map(_is_number, row)) or not (0 <= row[0] < LARGEST and 0 <= row[2] <= 1):
            raise _refused(path, "curve", row, "rows of steps, seconds, success rate, and further numbers")
    if set(counters.seconds) != set(PHASES) or not all(0 <= value < LARGEST for value in counters.seconds.values()):
        raise _refused(path, "seconds", counters.seconds, f"seconds of {', '.join(PHASES)}")
    values: Any = learner.values() if isinstance(learner, dict) else ["none"]
    if not all(_is_number(value) and -LARGEST < value < LARGEST for value in values):
        raise _refused(path, LEARNER, learner, "finite numbers by name")
    return counters


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _refused(path: Path, name: str, value: Any, wanted: str) -> InputError:
    return InputError(f"the counters in {path}: {name} has to be {wanted}, not {shown(value)}: use another checkpoint.")
