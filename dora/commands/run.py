"""Train or evaluate a learner on a Dora task.

    python experiments/run.py --env DoraCube-v1

Trains with the recommended settings, evaluates the best policy on fixed seeds and writes a run folder, whose
path is the last line printed. Ctrl-C saves; `--resume FOLDER` goes on.
"""

import datetime
import functools
import logging
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from dora.agents.checkpoint import read_checkpoint
from dora.agents.config import RunConfig
from dora.agents.evaluation.evaluate import outcome
from dora.agents.evaluation.play import checkpoint_path, evaluate_checkpoint, load_policy, record
from dora.agents.runs.presets import recommended, with_total_steps
from dora.agents.runs.run_folder import RunFolder, make_result
from dora.agents.runs.trainer import Trainer
from dora.errors import InputError
from dora.tasks import check_task_id, make_task

VIDEO_EPISODES = 3
"""Number of episodes in a film."""
INTERRUPTED = 130
"""Exit status after Ctrl-C."""
BAD_INPUT = 2
"""Exit status after input that a person can correct."""


@dataclass
class Args:
    """Train or evaluate a learner; an option left out takes the recommended value of the task."""

    env: str | None = None
    """Task id, for example DoraCube-v1."""
    agent: Literal["ppo", "sac", "mappo", "happo"] | None = None
    """Learner (default: the one recommended for the task, docs/agents.md)."""
    guidance: Literal["affordance", "none"] | None = None
    """Use affordance maps and grasp candidates, or nothing of them (default affordance)."""
    guidance_parts: tuple[Literal["observation", "reward", "filter", "prior"], ...] | None = None
    """Parts of guidance in force, for ablations (default all)."""
    preset: Literal["none", "standard", "hard"] | None = None
    """How much episodes are randomised and disturbed (default standard)."""
    seed: int | None = None
    """Seed of weights, exploration and initial states (default 0)."""
    total_steps: int | None = None
    """Budget in environment steps, summed over all environments."""
    num_envs: int | None = None
    """Environments in EACH worker."""
    workers: int | None = None
    """Worker processes (default: one per core); 0 collects in the main process."""
    out: Path | None = None
    """Run folder to make (default runs/<env>/<agent>-<guidance>-s<seed>-<time>)."""
    resume: Path | None = None
    """Run folder to go on with, from its last checkpoint; only --total-steps may differ."""
    eval_only: bool = False
    """Evaluate --checkpoint instead of training."""
    checkpoint: Path | None = None
    """Checkpoint to evaluate: a .safetensors file, or a run folder for its best one."""
    episodes: int | None = None
    """Episodes of the final evaluation (default 200)."""
    video: bool = False
    """Film a few episodes of the policy at the end (needs a Vulkan driver)."""
    eval_every: int | None = None
    """Environment steps between evaluations during training."""
    stop_success: float | None = None
    """End early when two successive evaluations reach this success rate, 0 to 1."""
    noise_correlation: float | None = None
    """Correlation of the exploration noise of successive steps, 0 to below 1."""


def task_options(args: Args) -> dict[str, Any]:
    """The arguments of the task that are given."""
    given = {"preset": args.preset, "guidance_parts": args.guidance_parts and list(args.guidance_parts)}
    return {name: value for name, value in given.items() if value is not None}


def settings(args: Args) -> RunConfig:
    """Settings for a new run."""
    if args.env is None:
        raise InputError("No task is given: add --env, for example --env DoraCube-v1.")
    return recommended(
        args.env,
        args.agent,
        guidance=args.guidance,
        seed=args.seed,
        total_steps=args.total_steps,
        num_envs=args.num_envs,
        workers=args.workers,
        final_episodes=args.episodes,
        eval_every=args.eval_every,
        stop_success=args.stop_success,
        task=task_options(args),
        learner={"noise_correlation": args.noise_correlation},
    )


def resumed_settings(args: Args, config: RunConfig) -> RunConfig:
    """Settings of the run to go on with; refuses any that differ from what it was started with."""
    asked = {
        "env": args.env,
        "agent": args.agent,
        "guidance": args.guidance,
        "seed": args.seed,
        "num_envs": args.num_envs,
        "workers": args.workers,
        "final_episodes": args.episodes,
        "eval_every": args.eval_every,
        "stop_success": args.stop_success,
        "task": task_options(args) or None,
    }
    for name, value in asked.items():
        if value is not None and value != getattr(config, name):
            raise InputError(
                f"The run in {args.resume} has {name} {getattr(config, name)}, not {value}: "
                "leave the option out, or start a new run without --resume."
            )
    return with_total_steps(config, args.total_steps)


def default_folder(config: RunConfig, suffix: str = "") -> Path:
    """runs/<env>/<agent>-<guidance>-s<seed>-<time>."""
    time = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    return Path("runs") / config.env / f"{config.agent}-{config.guidance}-s{config.seed}-{time}{suffix}"


def train(args: Args) -> tuple[Path, bool]:
    """Start or resume a run; returns its folder and whether it finished."""
    if args.checkpoint is not None:
        raise InputError("--checkpoint is only evaluated: add --eval-only, or go on with a run by --resume.")
    if args.resume is not None:
        folder = RunFolder(args.resume)
        config = resumed_settings(args, folder.read_config())
        check_task_id(config.env)
        folder.write_config(config)
    else:
        config = settings(args)
        check_task_id(config.env)
        folder = RunFolder(args.out or default_folder(config))
        folder.create(config)
    make_task_batch = functools.partial(make_task, config.env, guidance=config.guidance, **config.task)
    trainer = Trainer(config, make_task_batch, folder, resume=args.resume is not None)
    result = trainer.run()
    if not result["finished"]:
        command = ["python", *sys.argv[:1], "--resume", str(folder.path)]
        print(f"Interrupted and saved. To go on: {shlex.join(command)}", file=sys.stderr)
    elif args.video:
        film(folder.best, config, folder.video / "best.mp4")
    return folder.path, result["finished"]


def evaluate_only(args: Args) -> Path:
    """Evaluate a checkpoint into a new run folder, which is returned."""
    if args.checkpoint is None:
        raise InputError("--eval-only needs --checkpoint with a .safetensors file or a run folder.")
    path = checkpoint_path(args.checkpoint)
    theirs = read_checkpoint(path).config
    asked = {"agent": args.agent or theirs.agent, "guidance": args.guidance or theirs.guidance}
    config = recommended(
        args.env or theirs.env, **asked, seed=theirs.seed, num_envs=theirs.num_envs,
        workers=theirs.workers if args.workers is None else args.workers,
        final_episodes=args.episodes, total_steps=theirs.total_steps, task=theirs.task | task_options(args),
    )  # fmt: skip
    check_task_id(config.env)
    make_task_batch = functools.partial(make_task, config.env, guidance=config.guidance, **config.task)
    print(f"evaluation on {config.final_episodes} episodes ...", file=sys.stderr)
    checkpoint, evaluation, zero = evaluate_checkpoint(path, config, make_task_batch)
    print(outcome(evaluation, zero), file=sys.stderr)
    folder = RunFolder(args.out or default_folder(config, "-eval"))
    folder.create(config)
    folder.write_evaluation(evaluation)
    folder.write_result(
        make_result(
            config,
            env_steps=checkpoint.progress["env_steps"],
            wall_seconds=checkpoint.progress["wall_seconds"],
            episodes=checkpoint.progress["episodes"],
            evaluation=evaluation,
            zero=zero,
            finished=True,
        )
    )
    if args.video:
        film(path, config, folder.video / "best.mp4")
    return folder.path


def film(checkpoint: Path, config: RunConfig, path: Path) -> None:
    """Film the policy of a checkpoint, or say in one line why not."""
    policy = load_policy(read_checkpoint(checkpoint), checkpoint)
    options = config.task | {"render_mode": "rgb_array"}
    make_single_task = functools.partial(make_task, config.env, 1, config.guidance, **options)
    try:
        record(make_single_task, policy.greedy, path, VIDEO_EPISODES)
    except (RuntimeError, InputError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        print(f"No video: nothing can be rendered here ({reason}).", file=sys.stderr)


def main() -> int:
    """Run the command; returns the exit status."""
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=__doc__)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    try:
        if args.eval_only:
            folder, finished = evaluate_only(args), True
        else:
            folder, finished = train(args)
    except InputError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        return INTERRUPTED
    print(folder)
    return 0 if finished else INTERRUPTED
