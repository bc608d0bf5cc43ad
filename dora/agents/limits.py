"""Ranges of the settings of runs and learners, and the check that a run's are within them."""

import itertools

from dora.agents.config import RunConfig, SACConfig
from dora.agents.seeds import STARTS
from dora.arguments import LARGEST_SEED
from dora.configs import check_finite, check_ranges
from dora.errors import InputError
from dora.files import MOST_BYTES, MOST_HEADER

MOST_TRANSITIONS = 100_000_000
"""Largest product of environments, workers and control steps of an iteration, and of a replay buffer [1]."""
MOST_LAYERS, WIDEST = 16, 4096
"""Largest number of hidden layers, and of their units [1]."""
COPIES, COPIES_OF_SAC = 6, 12
"""Numbers in a checkpoint per weight of a network: actor and critic with two moments of Adam each; of SAC two critics,
besides their targets and a second copy of the actor [1]."""
BYTES = 4
"""Size of such a number [bytes]."""
RUN: dict[str, tuple[float, float]] = {
    "seed": (0, LARGEST_SEED),
    "total_steps": (1, 10**12),
    "num_envs": (1, 100_000),
    "workers": (0, 512),
    "learner_threads": (1, 512),
    "eval_every": (1, 10**12),
    "eval_episodes": (1, STARTS),
    "final_episodes": (1, STARTS),
    "eval_envs": (1, 100_000),
    "stop_success": (0, 1),
    "after_success": (0, 10**12),
    "overlap_share": (1e-6, 1),
    "overlap_steps": (1, 10**12),
    "checkpoint_seconds": (0, 10**9),
    "normaliser_samples": (0, 10**12),
}
"""Lowest and highest value of the settings of a run."""
SHARE, RATE = (0, 1), (1e-12, 1e3)
"""Lowest and highest share, and rate or norm."""
LEARNER = {
    "rollout": (1, 100_000),
    "epochs": (1, 10_000),
    "minibatch": (1, MOST_TRANSITIONS),
    "batch": (1, 10**6),
    "capacity": (1, MOST_TRANSITIONS),
    "n_step": (1, 10_000),
    "warmup": (0, 10**12),
    "critic_only": (0, 10**12),
    "gamma": (0, 1 - 1e-6),  # rewards are learned times 1 - gamma
    "gae_lambda": SHARE,
    "polyak": SHARE,
    "noise_correlation": (0, 1 - 1e-9),
    "learning_rate": RATE,
    "learning_rate_min": RATE,
    "learning_rate_max": RATE,
    "learning_rate_actor": RATE,
    "learning_rate_alpha": RATE,
    "learning_rate_last": SHARE,
    "learning_rate_steps": (1, 10**12),
    "updates_per_step": RATE,
    "grad_norm": (1e-12, 1e9),
    "clip": (1e-6, 0.999),  # TorchRL takes log(1 - clip)
    "target_kl": RATE,
    "alpha": RATE,
    "entropy": (-1e6, 1e6),
    "value": (0, 1e6),
    "bound": (0, 1e6),
    "prior": (0, 1e6),
    "prior_last": (1e-12, 1e6),  # it is reached geometrically
    "prior_steps": (1, 10**12),
    "target_entropy": (-1e6, 1e6),
    "log_std": (-30, 0),  # PPO's noise never grows beyond the range of actions
    "log_std_min": (-30, 0),
    "log_std_last": (-30, 0),
    "log_std_steps": (1, 10**12),
    "log_std_max": (-30, 10),
}
"""Lowest and highest value of the settings of learners."""
EARLIER = {
    "final_episodes": (1, 10**6), "eval_episodes": (1, 100_000), "log_std": (-30, 10), "log_std_min": (-30, 10),
    "gamma": SHARE,
}  # fmt: skip
"""Wider ranges of earlier versions, whose files can be read still."""
ORDERED = (
    ("learning_rate_min", "learning_rate_max"), ("log_std_min", "log_std"), ("log_std_last", "log_std"),
    ("log_std_min", "log_std_last"),
)  # fmt: skip
"""Settings of learners of which the first may not be larger than the second."""
FLAGS = {"final_episodes": "episodes"}
"""Options whose name is not that of their setting."""


def check(config: RunConfig, stored: bool = False) -> None:
    """Refuse settings that make no sense or for which no machine is large enough.

    Args:
        config: settings.
        stored: they are those of a file, perhaps of an earlier version.

    Raises:
        InputError: naming the option of the first of them.
    """
    wider = EARLIER if stored else {}
    run, learner = ({name: wider.get(name, own) for name, own in ranges.items()} for ranges in (RUN, LEARNER))
    check_ranges(config, run, lambda name: f"--{FLAGS.get(name, name).replace('_', '-')}")
    check_finite(config.learner, "learner")
    check_ranges(config.learner, learner, lambda name: f"--learner.{name.replace('_', '-')}")
    for low, high in ORDERED:
        least, most = getattr(config.learner, low, None), getattr(config.learner, high, None)
        if least is not None and most is not None and least > most:
            names = f"--learner.{low.replace('_', '-')} is {least} and --learner.{high.replace('_', '-')} {most}"
            raise InputError(f"{names}: the first has to be the smaller one.")
    hidden = config.learner.hidden
    if len(hidden) > MOST_LAYERS or not all(1 <= width <= WIDEST for width in hidden):
        raise InputError(f"--learner.hidden has to be at most {MOST_LAYERS} widths from 1 to {WIDEST}.")
    weights = sum(a * b for a, b in itertools.pairwise(hidden))  # those of the first and last layer come on top
    check_checkpoint(BYTES * weights * (COPIES_OF_SAC if isinstance(config.learner, SACConfig) else COPIES))
    at_once = config.num_envs * max(config.workers, 1) * config.learner.rollout
    if at_once > MOST_TRANSITIONS:
        raise InputError(
            f"--num-envs, --workers and --learner.rollout make {at_once} transitions at once, "
            f"which has to be at most {MOST_TRANSITIONS}: lower one of them."
        )
    if (capacity := getattr(config.learner, "capacity", at_once)) < at_once:
        raise InputError(
            f"--learner.capacity is {capacity}, and an iteration collects {at_once} transitions: give at least as many."
        )


def check_episodes(count: int) -> None:
    """Refuse a number of evaluation episodes that new evaluations may not have.

    Raises:
        InputError: it is out of range.
    """
    low, high = RUN["final_episodes"]
    if not low <= count <= high:
        raise InputError(f"--episodes is {count} and has to be from {low} to {high}.")


def check_checkpoint(size: int) -> None:
    """Refuse networks whose checkpoints would be too large to be read again.

    Args:
        size: of the tensors of a checkpoint [bytes].

    Raises:
        InputError: there are too many weights.
    """
    if size > MOST_BYTES - MOST_HEADER:
        raise InputError(
            f"--learner.hidden makes checkpoints of {size / 1e6:.0f} MB, of which at most {MOST_BYTES / 1e6:.0f} MB "
            "can be read again: give fewer or narrower layers."
        )
