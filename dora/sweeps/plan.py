"""The runs of a sweep, in the order in which they are done: all combinations for the first seed, then the next one."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dora.agents.config import RunConfig, stored_digests
from dora.agents.runs.recommended import learners_of, recommended
from dora.configs import plain
from dora.errors import InputError
from dora.tasks import find_task
from dora.tasks.env.options import task_config

WORKERS = 2
"""Worker processes of every run, so that runs of machines with other numbers of cores have the same settings."""
MECHANISM = ("observation", "reward", "filter")
"""Parts of guidance that the paper describes: no residual action on a reference."""
Guidance = tuple[str, tuple[str, ...] | None]
"""Name of the guidance and its parts, None for all."""
AFFORDANCE, GRASPS, NONE, PAPERS = ("affordance", None), ("grasps", None), ("none", None), ("affordance", MECHANISM)
"""The kinds of guidance that are compared."""
ONE_ARM = {"DoraCube-v1": 300_000, "DoraJug-v1": 300_000, "DoraHammer-v1": 300_000}
"""Environment steps of a run of each task of one arm, the same for all learners."""
TWO_ARMS = {"DoraMicrowave-v1": 400_000}
"""The same of tasks of two arms."""


@dataclass(frozen=True)
class Block:
    """Part of a sweep: all combinations of tasks, learners and guidance.

    Attributes:
        title: of the part.
        budgets: environment steps of a run of each task.
        agents: names of learners; None is the one that the task recommends.
        guidance: kinds of guidance.
    """

    title: str
    budgets: dict[str, int]
    agents: tuple[str | None, ...]
    guidance: tuple[Guidance, ...]


@dataclass(frozen=True)
class Preset:
    """A named sweep.

    Attributes:
        blocks: its parts.
        seeds: of the runs of every combination.
        episodes: of the last evaluation of a run.
    """

    blocks: tuple[Block, ...]
    seeds: tuple[int, ...]
    episodes: int


QUICK_STEPS = 20_000
"""Environment steps of a run of the preset `quick`, which shows that everything works, not what can be learned."""
PRESETS = {
    "paper": Preset(
        (
            Block("Table II", ONE_ARM, ("ppo", "sac"), (AFFORDANCE, NONE)),
            Block("Table IV", TWO_ARMS, ("happo", "mappo"), (AFFORDANCE, NONE)),
            Block("ladder", ONE_ARM, (None,), (GRASPS, PAPERS)),
        ),
        seeds=(10, 11, 12),
        episodes=500,
    ),
    "quick": Preset(
        (Block("quick", dict.fromkeys([*ONE_ARM, *TWO_ARMS], QUICK_STEPS), (None,), (AFFORDANCE, NONE)),),
        seeds=(10,),
        episodes=50,
    ),
}
"""The sweeps that have a name."""


@dataclass(frozen=True)
class Row:
    """One run of a sweep.

    Attributes:
        title: of the part that it belongs to.
        config: its settings.
    """

    title: str
    config: RunConfig

    @property
    def name(self) -> Path:
        """Its folder in that of the sweep: <env>/<agent>-<guidance>-s<seed>."""
        return Path(self.config.env) / f"{self.config.agent}-{self.guidance.replace(' ', '-')}-s{self.config.seed}"

    @property
    def guidance(self) -> str:
        """Kind of guidance and, if not all are in force, its parts."""
        return " ".join([self.config.guidance, *(self.config.guidance_parts or ())])

    def same_zero(self, other: "Row") -> bool:
        """Whether zero correction does the same in another run, whatever its learner and seed."""
        a, b = (
            (c.env, c.preset, c.guidance, c.guidance_parts, c.final_episodes, c.task)
            for c in (self.config, other.config)
        )
        return a == b

    @property
    def digests(self) -> tuple[str, ...]:
        """Digests with which a result of these settings may have been stored, by this version or an earlier one."""
        return stored_digests(plain(self.config))


def rows_of(
    preset: str,
    *,
    envs: Sequence[str] = (),
    agents: Sequence[str] = (),
    guidance: Sequence[str] = (),
    seeds: Sequence[int] = (),
    total_steps: int | None = None,
    episodes: int | None = None,
) -> list[Row]:
    """The runs of a sweep.

    Args:
        preset: its name.
        envs: tasks that are kept; none: all.
        agents: learners that are kept.
        guidance: kinds of guidance that are kept, by the names of `Row.guidance`.
        seeds: instead of those of the preset.
        total_steps: instead of the budgets of the preset.
        episodes: of the last evaluation of a run, instead of those of the preset.

    Raises:
        InputError: unknown preset, or nothing is left.
    """
    if preset not in PRESETS:
        raise InputError(f"There is no sweep {preset!r}: use one of {', '.join(PRESETS)}.")
    plan, rows = PRESETS[preset], list[Row]()
    for seed, block in itertools.product(dict.fromkeys(seeds or plan.seeds), plan.blocks):
        for (env, budget), agent, kind in itertools.product(block.budgets.items(), block.agents, block.guidance):
            config = settings(env, agent, kind, seed, total_steps or budget, episodes or plan.episodes)
            rows.append(Row(block.title, config))
    asked = {"--env": envs, "--agent": agents, "--guidance": guidance}
    known = {
        "--env": {row.config.env for row in rows},
        "--agent": {row.config.agent for row in rows},
        "--guidance": {row.guidance for row in rows},
    }
    for option, names in asked.items():
        if unknown := [name for name in names if name not in known[option]]:
            there = ", ".join(sorted(known[option]))
            raise InputError(f"{option} {unknown[0]!r} is not in the sweep {preset}: there are {there}.")
    kept = [
        row
        for row in rows
        if (not envs or row.config.env in envs)
        and (not agents or row.config.agent in agents)
        and (not guidance or row.guidance in guidance)
    ]
    if not kept:
        raise InputError("No run of the sweep fits all of --env, --agent and --guidance together: leave one out.")
    return kept


def settings(env: str, agent: str | None, guidance: Guidance, seed: int, total_steps: int, episodes: int) -> RunConfig:
    """The recommended settings of a task and a learner with all numbers of the task, as `dora run` would have them."""
    task = find_task(env)
    config = recommended(
        env, agent, learners_of(task.LEARNERS), guidance=guidance[0], guidance_parts=guidance[1], seed=seed,
        total_steps=total_steps, final_episodes=episodes, workers=WORKERS,
    )  # fmt: skip
    return replace(config, task=plain(task_config(task.CONFIG, config.preset, {})))
