"""Train all runs of a table, one after the other, and go on where an earlier call stopped.

    dora sweep --preset paper --dry-run
    dora sweep --preset paper
    dora sweep --preset paper --env DoraCube-v1 --seeds 10
    dora sweep --preset paper --launcher ray

A finished run counts, whichever command made it, if its settings are the same and its result lies under --out or
--known. Ctrl-C saves; the same command goes on.
"""

import os
import shlex
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dora.agents.runs.interrupt import STATUS, Interrupt
from dora.errors import InputError, command
from dora.files import make_folder
from dora.sweeps.board import Board, print_all, summary
from dora.sweeps.launching import Launcher, LocalLauncher
from dora.sweeps.plan import rows_of
from dora.sweeps.sweep import State, Sweep

MOST_JOBS = 4096
"""Most runs at the same time [1]."""
FAILED = 1
"""Exit status when runs have failed."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Which runs, and where they are trained."""

    preset: Literal["paper", "quick"] = "paper"
    """paper: the runs of the paper's tables II, III and IV and of the ladder of guidance. quick: every task, guided and
    unguided, in minutes, to see that all of it works."""
    out: Path | None = None
    """Folder of the sweep: a run folder for each run (default runs/sweep-<preset>)."""
    known: tuple[Path, ...] = (Path("results"),)
    """Folders whose finished runs count as well."""
    launcher: Literal["local", "ray"] = "local"
    """Train on this machine, or as tasks of a Ray cluster (`pip install ray`)."""
    address: str | None = None
    """Of the Ray cluster; without it the one on this machine, or a new one there."""
    jobs: int = 1
    """Runs at the same time; with Ray, 0 is as many as the cluster has cores for."""
    retries: int = 1
    """How often a run is gone on with after it failed."""
    env: tuple[str, ...] = ()
    """Only these tasks."""
    agent: tuple[str, ...] = ()
    """Only these learners."""
    guidance: tuple[str, ...] = ()
    """Only these kinds of guidance, as the table names them."""
    seeds: tuple[int, ...] = ()
    """Seeds, instead of those of the preset."""
    total_steps: int | None = None
    """Environment steps of every run, instead of the budgets of the preset."""
    episodes: int | None = None
    """Episodes of the last evaluation of every run, instead of those of the preset."""
    dry_run: bool = False
    """Show the runs and the time that is missing, and train nothing."""


@command
def main() -> int:
    """Run the command; returns the exit status."""
    args = tyro.cli(Args, description=__doc__)
    _check(args)
    chosen = {"envs": args.env, "agents": args.agent, "guidance": args.guidance, "seeds": args.seeds}
    rows = rows_of(args.preset, total_steps=args.total_steps, episodes=args.episodes, **chosen)
    out = args.out or Path("runs") / f"sweep-{args.preset}"
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} is not a folder: choose another one.")
    if not args.dry_run:
        make_folder(out)
    sweep = Sweep(rows, out, args.known, args.jobs, args.retries)
    if args.dry_run:
        print_all(sweep)
        print(f"{summary(sweep)} with {args.jobs or 'as many as there is room for'} at a time.")
        return 0
    with Interrupt() as interrupt:
        try:
            launcher = _launcher(args, sweep)
            with Board() as board:
                sweep.run(launcher, board, interrupt.check)
        except KeyboardInterrupt:
            print(f"Interrupted and saved; {summary(sweep)}. The same command goes on.", file=sys.stderr)
            return STATUS + (interrupt.number or signal.SIGINT)
    print_all(sweep)
    for entry in sweep.without_zero if sweep.count(State.FAILED) else ():
        places = "--checkpoint", str(entry.folder), "--out", str(sweep.zero_folder(entry))
        options = shlex.join([*places, "--episodes", str(entry.row.config.final_episodes), "--zero-correction"])
        told = f"{entry.row.name}: no zero correction, because the run failed that was to evaluate it; it is had by "
        print(f"{told}dora run --eval-only {options}", file=sys.stderr)
    print(out)
    return FAILED if sweep.count(State.FAILED) else 0


def _check(args: Args) -> None:
    """Refuses numbers that make no sense.

    Raises:
        InputError: naming the option.
    """
    numbers = {
        "--jobs": args.jobs,
        "--retries": args.retries,
        "--total-steps": args.total_steps,
        "--episodes": args.episodes,
    }
    least = {"--jobs": 0 if args.launcher == "ray" else 1, "--retries": 0}
    for option, value in numbers.items():
        smallest = least.get(option, 1)
        if value is not None and value < smallest:
            raise InputError(f"{option} is {value}, but has to be at least {smallest}.")
    if args.jobs > MOST_JOBS:
        raise InputError(f"--jobs is larger than {MOST_JOBS}: give as many as there are cores for.")
    if args.launcher == "local" and args.address is not None:
        raise InputError("--address is that of a Ray cluster: add --launcher ray, or leave it out.")
    for seed in args.seeds:
        if seed < 0:
            raise InputError(f"--seeds has {seed}, but a seed has to be at least 0.")
    for folder in args.known:
        if folder != Path("results") and not os.path.isdir(folder):
            raise InputError(f"--known {folder} is not a folder: leave it out, or name one with finished runs.")


def _launcher(args: Args, sweep: Sweep) -> Launcher:
    if args.launcher == "local":
        return LocalLauncher()
    from dora.sweeps.ray_cluster import RayLauncher

    launcher = RayLauncher(args.address)
    sweep.jobs = args.jobs or launcher.room
    print(f"{launcher.room} runs fit into the cluster at the same time.", file=sys.stderr)
    return launcher
