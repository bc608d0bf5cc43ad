"""Recommended settings per task and learner: a bare command is the recommended one."""

import dataclasses
from typing import Any

from dora.agents.config import GUIDANCES, LEARNER_CONFIGS, SINGLE_ARM_AGENTS, RunConfig
from dora.errors import InputError
from dora.parallel import available_cores

DEFAULT_AGENT = "ppo"
"""The learner of a bare command."""
RECOMMENDED_AGENT: dict[str, str] = {"DoraJug-v1": "sac", "DoraHammer-v1": "sac"}
"""The same for tasks on which another one does better."""

PRESETS: dict[tuple[str, str], dict[str, Any]] = {
    ("DoraCube-v1", "ppo"): {
        "total_steps": 300_000,
        "stop_success": 0.99,
        "num_envs": 64,
        "eval_every": 40_000,
        "eval_episodes": 50,
        "eval_envs": 50,
        "learner": {"rollout": 16, "log_std": -1.0},
    },
    ("DoraJug-v1", "ppo"): {
        "total_steps": 600_000,
        "stop_success": 0.98,
        "num_envs": 64,
        "eval_every": 60_000,
        "eval_episodes": 100,
        "eval_envs": 50,
        "learner": {"rollout": 16, "log_std": -1.8},
    },
    ("DoraHammer-v1", "ppo"): {
        "total_steps": 600_000,
        "stop_success": 0.97,
        "num_envs": 64,
        "eval_every": 150_000,
        "eval_episodes": 100,
        "eval_envs": 50,
        "learner": {"rollout": 32, "log_std": -1.8},
    },
    ("DoraJug-v1", "sac"): {
        "total_steps": 300_000,
        "stop_success": 0.98,
        "num_envs": 32,
        "eval_every": 50_000,
        "eval_episodes": 100,
        "eval_envs": 50,
    },
    ("DoraHammer-v1", "sac"): {
        "total_steps": 300_000,
        "stop_success": 0.97,
        "num_envs": 32,
        "eval_every": 75_000,
        "eval_episodes": 100,
        "eval_envs": 50,
    },
    ("DoraCube-v1", "sac"): {
        "total_steps": 200_000,
        "stop_success": 0.99,
        "num_envs": 32,
        "eval_every": 50_000,
        "eval_episodes": 50,
        "eval_envs": 50,
    },
}
"""Differences from the defaults of `RunConfig`, and under `learner` from those of the learner."""

WITHOUT_PRIOR: dict[str, dict[str, Any]] = {"sac": {"prior": 0.0}}
"""Settings of each learner where actions correct nothing and zero action is no prior to be pulled to."""

POSITIVE = ("total_steps", "num_envs", "eval_every", "eval_episodes", "final_episodes", "eval_envs")


def recommended(env: str, agent: str | None = None, **overrides: Any) -> RunConfig:
    """Settings of a run: the defaults, the preset of (env, agent), then `overrides` that are not None.

    Args:
        env: task id; one without a preset gets the defaults.
        agent: learner; the one recommended for the task if None.
        overrides: fields of `RunConfig`; `learner` is a dict of fields of the learner's settings.

    Raises:
        InputError: if a value makes no sense.
    """
    agent = agent or RECOMMENDED_AGENT.get(env, DEFAULT_AGENT)
    if agent not in SINGLE_ARM_AGENTS:
        raise InputError(f"The learner {agent} needs a task with two arms and {env} has one: use --agent ppo or sac.")
    preset = dict(PRESETS.get((env, agent), {}))
    learner, given = preset.pop("learner", {}), overrides.pop("learner", None) or {}
    fields = {"guidance": "affordance", "workers": available_cores()} | preset
    fields |= {name: value for name, value in overrides.items() if value is not None}
    config = RunConfig(env=env, agent=agent, **fields)
    learner = learner | ({} if config.has_prior else WITHOUT_PRIOR.get(agent, {}))
    learner = learner | {name: value for name, value in given.items() if value is not None}
    config = dataclasses.replace(config, learner=LEARNER_CONFIGS[agent](**learner))
    check(config)
    return config


def check(config: RunConfig) -> None:
    """Refuse settings that make no sense.

    Raises:
        InputError: naming the first of them.
    """
    for name in POSITIVE:
        if getattr(config, name) < 1:
            raise InputError(f"--{name.replace('_', '-')} is {getattr(config, name)} and has to be at least 1.")
    for name in ("workers", "seed"):
        if getattr(config, name) < 0:
            raise InputError(f"--{name} is {getattr(config, name)} and cannot be negative.")
    if config.guidance not in GUIDANCES:
        raise InputError(f"--guidance is {config.guidance} and has to be one of {', '.join(GUIDANCES)}.")
    if not 0.0 <= config.learner.noise_correlation < 1.0:
        raise InputError(
            f"--noise-correlation is {config.learner.noise_correlation} and has to be at least 0 and below 1."
        )


def with_total_steps(config: RunConfig, total_steps: int | None) -> RunConfig:
    """The same settings with another budget, if one is given."""
    config = config if total_steps is None else dataclasses.replace(config, total_steps=total_steps)
    check(config)
    return config
