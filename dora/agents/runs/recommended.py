"""Settings of a new run: the defaults, what a task recommends, and what the user asks for; checked."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from dora.agents.config import LEARNER_CONFIGS, RunConfig
from dora.configs import check_finite, overridden
from dora.errors import InputError
from dora.parallel import available_cores

WITHOUT_PRIOR: dict[str, dict[str, Any]] = {"sac": {"prior": 0.0}}
"""Settings of each learner where actions are no residuals and zero action is no prior to be pulled to."""
POSITIVE = ("total_steps", "num_envs", "eval_every", "eval_episodes", "final_episodes", "eval_envs")
"""Settings that have to be at least 1."""
SHARES = ("gamma", "gae_lambda", "polyak")
"""Settings of learners that have to be from 0 to 1."""
COUNTS = ("rollout", "epochs", "minibatch", "batch", "capacity", "n_step")
"""Settings of learners that have to be at least 1."""
RATES = ("learning_rate", "learning_rate_min", "learning_rate_max", "learning_rate_actor", "learning_rate_alpha",
         "updates_per_step", "grad_norm", "clip", "target_kl", "alpha")  # fmt: skip
"""Settings of learners that have to be above 0."""
LIMITS = (
    (SHARES, lambda value: 0 <= value <= 1, "from 0 to 1"),
    (COUNTS, lambda value: value >= 1, "at least 1"),
    (RATES, lambda value: value > 0, "above 0"),
    (("noise_correlation",), lambda value: 0 <= value < 1, "at least 0 and below 1"),
    (("hidden",), lambda widths: all(width >= 1 for width in widths), "widths of at least 1"),
)
"""Settings of learners, the test of each, and its words."""
ALL: Mapping[str, Mapping[str, Any]] = {name: {} for name in LEARNER_CONFIGS}
"""The learners of a task that recommends nothing."""


def recommended(
    env: str, agent: str | None = None, learners: Mapping[str, Mapping[str, Any]] = ALL, **overrides: Any
) -> RunConfig:
    """Settings of a run: the defaults, what the task recommends for the learner, then `overrides` that are not None.

    Args:
        env: task id.
        agent: learner; the task's first one if None.
        learners: the learners that can do the task, with differences from the defaults of `RunConfig` and, under
            `learner`, from those of the learner.
        overrides: fields of `RunConfig`; `learner` is a mapping of fields of the learner's settings.

    Raises:
        InputError: if the task cannot be done by the learner, or a value makes no sense.
    """
    agent = agent or next(iter(learners))
    if agent not in learners:
        raise InputError(f"{env} cannot be learned by {agent!r}: use --agent with one of {', '.join(learners)}.")
    fields: dict[str, Any] = {"workers": available_cores(), **learners[agent]}
    learner, given = dict(fields.pop("learner", {})), overrides.pop("learner", None) or {}
    fields |= {name: value for name, value in overrides.items() if value is not None}
    config: RunConfig = RunConfig(env=env, agent=agent, **fields)
    learner |= {} if config.has_prior else WITHOUT_PRIOR.get(agent, {})
    learner |= {name: value for name, value in given.items() if value is not None}
    config = dataclasses.replace(config, learner=overridden(LEARNER_CONFIGS[agent](), learner, "learner"))
    check(config)
    return config


def check(config: RunConfig) -> None:
    """Refuse settings that make no sense.

    Raises:
        InputError: naming the first of them.
    """
    for name in POSITIVE:
        if getattr(config, name) < 1:
            flag = "episodes" if name == "final_episodes" else name.replace("_", "-")
            raise InputError(f"--{flag} is {getattr(config, name)} and has to be at least 1.")
    for name in ("workers", "seed"):
        if getattr(config, name) < 0:
            raise InputError(f"--{name} is {getattr(config, name)} and cannot be negative.")
    check_finite(config.learner, "learner")
    for names, fits, words in LIMITS:
        for name in names:
            value = getattr(config.learner, name, None)
            if value is not None and not fits(value):
                raise InputError(f"--learner.{name.replace('_', '-')} is {value} and has to be {words}.")
