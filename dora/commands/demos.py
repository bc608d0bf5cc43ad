"""Record demonstrations of a task, or episodes of a policy, as a dataset of LeRobot, Minari or ManiSkill.

    dora demos DoraJug-v1 --out jug --episodes 100 --only-successes      # the scripted solution, for LeRobot
    dora demos DoraJug-v1 --out jug --policy policy --pictures           # the policy that comes with the task
    dora demos DoraCube-v1 --out cube --policy runs/DoraCube-v1/RUN --format minari

The folder appears when the dataset is whole, and its path is the last line printed.
"""

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from dora.arguments import LARGEST_SEED
from dora.configs import check_ranges
from dora.datasets.episodes import Plan
from dora.datasets.record import check_possible, record_dataset
from dora.datasets.sources import find_source
from dora.errors import command
from dora.progress import ProgressDisplay

RANGES = {"episodes": (1, 1_000_000), "seed": (0, LARGEST_SEED), "num_envs": (1, 1024)}
"""Lowest and highest value of options."""


@dataclass(frozen=True)
class Args:
    """Record a dataset of episodes of a task."""

    env: tyro.conf.Positional[str]
    """Task id, for example DoraJug-v1."""
    out: Path
    """Folder of the dataset, which must not exist."""
    format: Literal["lerobot", "minari", "maniskill"] = "lerobot"
    """LeRobot 3.0, Minari 0.5 (HDF5), or a recording of ManiSkill."""
    policy: str = "scripted"
    """Who acts: scripted, policy (the one that comes with the task), or the path of a checkpoint or run folder."""
    episodes: int = 50
    """Episodes to record."""
    only_successes: bool = False
    """Leave out episodes that fail, and go on until there are enough."""
    pictures: bool = False
    """Record the cameras, too (needs a Vulkan driver)."""
    preset: Literal["none", "standard", "hard"] | None = None
    """How much episodes are randomised (default: standard, or what the policy was trained with)."""
    seed: int = 0
    """Seed of the first start."""
    num_envs: int = 16
    """Environments that are stepped together."""


@command
def main() -> int:
    """Run the command; returns the exit status."""
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=__doc__)
    torch.set_num_threads(1)
    logging.getLogger("mani_skill").setLevel(logging.ERROR)  # what a missing driver means is said in one sentence
    check_ranges(args, RANGES, lambda name: f"--{name.replace('_', '-')}")
    plan = Plan(args.episodes, args.seed, args.only_successes, args.num_envs)
    source = find_source(args.env, args.policy, args.preset)
    check_possible(args.format, plan, args.out, args.pictures)
    start = time.monotonic()
    with ProgressDisplay() as progress:
        update = progress.phase(f"{source.name} in {args.env}", "episodes")
        made = record_dataset(args.format, source, plan, args.out, args.pictures, update)
    seconds = time.monotonic() - start
    print(f"{made.episodes} episodes, {made.successes} of them a success, {made.steps:,} steps, in {seconds:.0f} s")
    print(args.out)
    return 0
