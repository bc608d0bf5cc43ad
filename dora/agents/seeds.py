"""Seeds of training, which no evaluation has, and how many an evaluation has."""

import numpy as np

TRAINING_SEEDS = 1_000_000_000
"""Seeds of training are below this number, those of evaluation are not."""
STARTS = 10_000
"""Seeds that belong to each `--seed` of an evaluation [1]; no evaluation has more episodes."""


def seeds_for(seed: int, step: int, count: int) -> list[int]:
    """`count` independent seeds in [0, 1e9), different for every (seed, step)."""
    state = np.random.SeedSequence([seed, step]).generate_state(count, np.uint64)
    return [int(s % TRAINING_SEEDS) for s in state]
