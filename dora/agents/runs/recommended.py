"""Settings of a new run: the defaults, what a task recommends, and what the user asks for; checked."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from dora.agents.config import LEARNER_CONFIGS, RunConfig
from dora.agents.limits import check
from dora.configs import overridden
from dora.errors import InputError
from dora.parallel import available_cores

WITHOUT_PRIOR: dict[str, dict[str, Any]] = {
    name: {"prior": 0.0} for name, settings in LEARNER_CONFIGS.items() if hasattr(settings, "prior")
}
"""Settings of each learner where actions are no residuals and zero action is no prior to be pulled to."""
ALL: Mapping[str, Mapping[str, Any]] = {name: {} for name in LEARNER_CONFIGS}
"""The learners of a task that recommends nothing."""
LIKE_PPO = ("mappo", "happo")
"""Learners that can do what PPO can, with what a task recommends for PPO unless it names them itself."""


def learners_of(table: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """The learners that can do a task with what it recommends for each, the recommended one first.

    Args:
        table: those that the task names itself.
    """
    return {**table, **{name: table["ppo"] for name in LIKE_PPO if "ppo" in table and name not in table}}


def recommended(
    env: str, agent: str | None = None, learners: Mapping[str, Mapping[str, Any]] = ALL, **overrides: Any
) -> RunConfig:
    """Settings of a run: the defaults, what the task recommends for the learner, then `overrides` that are not None.

    Args:
        env: task id.
        agent: learner; the task's first one if None.
        learners: the learners that can do the task, with differences from the defaults of `RunConfig` and, under
            `learner`, from those of the learner; under `presets` further ones by preset.
        overrides: fields of `RunConfig`; `learner` is a mapping of fields of the learner's settings.

    Raises:
        InputError: if the task cannot be done by the learner, or a value makes no sense.
    """
    learners = learners_of(learners)
    agent = agent or next(iter(learners))
    if agent not in learners:
        raise InputError(f"{env} cannot be learned by {agent!r}: use --agent with one of {', '.join(learners)}.")
    fields: dict[str, Any] = {"workers": available_cores(), **learners[agent]}
    own = fields.pop("presets", {}).get(overrides.get("preset") or RunConfig.preset, {})
    learner, given = dict(fields.pop("learner", {})), overrides.pop("learner", None) or {}
    fields, learner = fields | {n: v for n, v in own.items() if n != "learner"}, learner | own.get("learner", {})
    fields |= {name: value for name, value in overrides.items() if value is not None}
    config: RunConfig = RunConfig(env=env, agent=agent, **fields)
    learner |= {} if config.has_prior else WITHOUT_PRIOR.get(agent, {})
    learner |= {name: value for name, value in given.items() if value is not None}
    config = dataclasses.replace(config, learner=overridden(LEARNER_CONFIGS[agent](), learner, "learner"))
    check(config)
    return config
