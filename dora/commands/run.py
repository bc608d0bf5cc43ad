"""Train or evaluate a learner on a Dora task.

    dora run --env DoraCube-v1
    dora run --env DoraCube-v1 --task.lift 0.12 --learner.gamma 0.97
    dora run --like results/tasks/DoraJug-v1/sac-affordance-s10 --seed 1
    dora run --eval-only --checkpoint FOLDER --seed 1 --episodes 50 --video
    dora run --eval-only --zero-correction --env DoraCube-v1

Trains with the recommended settings, evaluates the best policy on fixed seeds and writes a run folder, whose
path is the last line printed. Ctrl-C saves; `--resume FOLDER` goes on. Every number of the task and of the learner is
an option; the defaults that are shown are those of the task that --env names.
"""

import contextlib
import difflib
import functools
import logging
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Generic, Literal

import tyro

from dora.agents.checkpoint import read_checkpoint
from dora.agents.config import LEARNER_CONFIGS, Agent, Numbers, RunConfig, Settings
from dora.agents.evaluation.evaluate import FINAL_SEED, first_seed, outcome
from dora.agents.evaluation.play import checkpoint_path, evaluate_checkpoint, evaluate_zero, load_policy, record
from dora.agents.limits import check, check_episodes
from dora.agents.runs.agreement import agreement
from dora.agents.runs.interrupt import STATUS, ending_at_once
from dora.agents.runs.logging import add_film
from dora.agents.runs.recommended import learners_of, recommended
from dora.agents.runs.run_folder import RunFolder, default_folder, make_result
from dora.agents.runs.stored_results import NO_CORRECTION, read_result
from dora.agents.runs.trainer import Trainer
from dora.configs import plain
from dora.digests import file_sha256
from dora.errors import FAILED, RECORDS, InputError, RunFailure, command
from dora.tasks import find_task, make_task
from dora.tasks.env.options import numbers_under_preset, task_config
from dora.tasks.mdp.guidance_parts import guidance_in_force
from dora.tasks.mdp.randomisation import find_preset
from dora.tools.command_line import HELP, read_some
from dora.version import source_commit

VIDEO_EPISODES = 3
"""Episodes of a film [1]."""
ENTRANCES = ("--env", "--eval-only", "--checkpoint", "--resume", "--like")
"""Options that say what is run."""
OF_TRAINING = (
    "env", "agent", "learner", "total_steps", "eval_every", "eval_episodes", "stop_success", "checkpoint_seconds",
    "normaliser_samples", "stagger", "after_success", "overlap_share", "overlap_steps", "num_envs", "learner_threads",
)  # fmt: skip
"""Settings that have no effect on the evaluation of a policy."""
SHOWN = "DoraHammer-v1"
"""Task whose defaults --help shows if --env names none."""
INSTALLED = ("dora", "run")
"""How this command is called where the package is installed."""


@dataclass(frozen=True, kw_only=True)
class Args(Generic[Numbers, Settings, Agent]):
    """Train or evaluate a learner; an option left out takes the recommended value of the task."""

    run: Annotated[RunConfig[Numbers, Settings, Agent], tyro.conf.arg(name="")]
    """Settings of the run."""
    out: Path | None = None
    """Run folder to make (default runs/<env>/<agent>-<guidance>-s<seed>-<time>)."""
    resume: Path | None = None
    """Run folder to go on with, from its last checkpoint; only --total-steps may differ."""
    like: Path | None = None
    """Run folder, folder of a stored result or checkpoint whose settings are the defaults of a new run."""
    eval_only: bool = False
    """Evaluate --checkpoint, or with --zero-correction alone the zero action of --env, instead of training."""
    zero_correction: bool = True
    """Evaluate the zero action, too, where it is that of a reference (default with --eval-only: no)."""
    checkpoint: Path | None = None
    """Checkpoint to evaluate: a .safetensors file, a run folder for its best one, or a folder of a stored result."""
    collector: Literal["processes", "ray"] = "processes"
    """Where workers collect: in processes of this machine, or in actors of the Ray cluster at RAY_ADDRESS, one core
    each (without that variable, of the one on this machine, or of a new one; needs `pip install ray`)."""
    video: bool = False
    """Film a few episodes of the policy, after training or before evaluation (needs a Vulkan driver)."""
    first_seed: Annotated[int, tyro.conf.Suppress] = FINAL_SEED
    """Seed of the first episode that is evaluated or filmed with --eval-only."""


@dataclass(frozen=True, kw_only=True)
class First:
    """Options that decide the defaults of the others, as in `Args`; None if they are not given."""

    env: str | None = None
    resume: Path | None = None
    like: Path | None = None
    checkpoint: Path | None = None
    out: Path | None = None
    eval_only: bool = False
    zero_correction: bool = False
    preset: str | None = None
    agent: str | None = None
    guidance: str | None = None
    guidance_parts: tuple[str, ...] | None = None
    seed: str | None = None


def parse(words: Sequence[str]) -> Args[dict[str, Any], Any, str]:
    """The options of a command line, the settings of the run with all numbers of its task.

    Raises:
        InputError: for a task, learner or folder that is not there, or values that make no sense.
    """
    first = read_some(First, words)
    base = settings_to_start_from(first, words)
    task = find_task(base.env)
    numbers = task_config(task.CONFIG, base.preset, base.task)
    agents = Literal[tuple(learners_of(task.LEARNERS))]  # pyright: ignore[reportInvalidTypeForm]
    form: Any = Args[task.CONFIG, LEARNER_CONFIGS[base.agent], agents]  # pyright: ignore[reportInvalidTypeArguments, reportInvalidTypeForm]
    default = Args(run=replace(base, task=numbers), zero_correction=not first.eval_only)
    args = tyro.cli(form, default=default, description=__doc__, args=list(words))
    numbers = task_config(task.CONFIG, args.run.preset, args.run.task)
    if args.eval_only or args.like is not None:  # by the rules of now, whichever the policy was trained by
        numbers = replace(numbers, definition=task_config(task.CONFIG, args.run.preset, None).definition)
    config = replace(args.run, task=plain(numbers))
    check(config, stored=first.resume is not None or first.checkpoint is not None)
    guidance_in_force(config.guidance, config.guidance_parts)
    if not args.eval_only:
        if args.collector == "ray" and config.workers == 0:
            raise InputError("--collector ray needs workers, and --workers is 0: give 1 or more, or leave it out.")
        return replace(args, run=config)
    if config.final_episodes != base.final_episodes:
        check_episodes(config.final_episodes)
    refuse_settings_of_training(base, config)
    if first.agent is not None and args.checkpoint is None:
        raise InputError("--agent has no effect on an evaluation of zero correction: leave it out.")
    if args.collector != default.collector:
        raise InputError("--collector has no effect on an evaluation: leave it out.")
    if args.zero_correction and not config.has_prior:
        raise InputError("--zero-correction needs guidance with a prior: without one there is nothing to correct.")
    episode = FINAL_SEED if first.seed is None else first_seed(config.seed, config.final_episodes)
    return replace(args, run=config, first_seed=episode)


def settings_to_start_from(first: First, words: Sequence[str]) -> RunConfig:
    """Settings whose values are the defaults of the options: those of the run or checkpoint that is named, or the
    recommended ones of the task.

    Raises:
        InputError: the options do not go together, or name what is not there.
    """
    if first.resume is not None:
        given = {"--out": first.out, "--checkpoint": first.checkpoint, "--eval-only": first.eval_only or None}
        for option, value in (given | {"--like": first.like}).items():
            if value is not None:
                raise InputError(f"{option} does not go with --resume, which goes on in its folder: leave it out.")
        RunFolder(first.resume).check_trained()
        return RunFolder(first.resume).read_config()
    preset = first.preset
    if preset is not None:
        find_preset(preset)
    guidance_in_force(first.guidance or "affordance", None)
    guidance_in_force("affordance", first.guidance_parts)
    if first.like is not None:
        return settings_like(first, first.like)
    if first.eval_only and first.checkpoint is None and not (first.zero_correction and first.env is not None):
        raise InputError(
            "--eval-only needs --checkpoint with a .safetensors file or a run folder, or --zero-correction with --env."
        )
    if first.eval_only and first.checkpoint is not None:
        config = read_checkpoint(checkpoint_path(first.checkpoint)).config
        if preset is None:
            return config
        numbers = numbers_under_preset(find_task(config.env).CONFIG, config.task, config.preset, preset)
        return replace(config, preset=preset, task=numbers)
    if first.checkpoint is not None:
        raise InputError("--checkpoint is only evaluated: add --eval-only, or go on with a run by --resume.")
    if first.env is None and not HELP & set(words):
        near = [word for word in words if difflib.get_close_matches(word.partition("=")[0], ENTRANCES, 1, 0.7)]
        hint = f" instead of {near[0]}" if near else ""
        raise InputError(f"No task is given: add --env{hint}, for example --env DoraCube-v1.")
    env = first.env or SHOWN
    choice: Any = {"guidance": first.guidance, "guidance_parts": first.guidance_parts, "preset": preset}
    return recommended(env, first.agent, find_task(env).LEARNERS, **choice)


def settings_like(first: First, path: Path) -> RunConfig:
    """Settings of an earlier run, under the preset that is asked for.

    Args:
        first: options of the new run.
        path: run folder, folder of a stored result, or checkpoint of the earlier one.

    Raises:
        InputError: it is none, or the new run is to be of another task, learner or kind of action.
    """
    for option, value in {"--checkpoint": first.checkpoint, "--eval-only": first.eval_only or None}.items():
        if value is not None:
            raise InputError(f"{option} does not go with --like, which begins a training: leave one of them out.")
    of_run = os.path.isfile(path / "config.yaml")
    config = RunFolder(path).read_config() if of_run else read_checkpoint(checkpoint_path(path)).config
    for name in ("env", "agent"):
        theirs, asked = getattr(config, name), getattr(first, name)
        if asked is not None and asked != theirs:
            raise InputError(
                f"--{name} is {asked}, and the settings of {path} are for {theirs}: leave one of them out."
            )
    guidance = config.guidance if first.guidance is None else first.guidance
    parts = config.guidance_parts if first.guidance_parts is None else first.guidance_parts
    if replace(config, guidance=guidance, guidance_parts=parts).has_prior != config.has_prior:
        kind = "corrections of a reference" if config.has_prior else "actions without a reference"
        raise InputError(
            f"The settings of {path} are for {kind}: leave --guidance and --guidance-parts out, or begin with --env."
        )
    if first.preset is None:
        return config
    numbers = numbers_under_preset(find_task(config.env).CONFIG, config.task, config.preset, first.preset)
    return replace(config, preset=first.preset, task=numbers)


def refuse_settings_of_training(base: RunConfig, asked: RunConfig) -> None:
    """Refuses settings of an evaluation that would change nothing, and another task than the policy's.

    Raises:
        InputError: naming the first that differs from those of the checkpoint.
    """
    for name in OF_TRAINING:
        theirs, ours = getattr(base, name), getattr(asked, name)
        if theirs != ours:
            option = "--learner.*" if name == "learner" else f"--{name.replace('_', '-')}"
            value = "" if name == "learner" else f" ({theirs} here)"
            raise InputError(f"{option} has no effect on an evaluation{value}: leave it out.")


def refuse_other_settings(folder: Path, stored: RunConfig, asked: RunConfig) -> None:
    """Refuses settings that differ from what a run was started with; `total_steps` may.

    Raises:
        InputError: naming the first difference.
    """
    for f in fields(stored):
        theirs, ours = getattr(stored, f.name), getattr(asked, f.name)
        if f.name == "task":
            theirs, ours = (plain(task_config(find_task(stored.env).CONFIG, stored.preset, t)) for t in (theirs, ours))
        if f.name != "total_steps" and theirs != ours:
            raise InputError(
                f"The run in {folder} has {f.name} {theirs}, not {ours}: "
                "leave the option out, or start a new run without --resume."
            )


def refuse_finished(folder: Path, total_steps: int) -> None:
    """Refuses to go on with a run that has ended, whose last evaluation would only be repeated.

    Raises:
        InputError: it has been trained for `total_steps`, and its result is written.
    """
    path = folder / "result.json"
    result = read_result(path) if os.path.isfile(path) else None
    if result is not None and result.get("total_steps", 0) >= total_steps:
        raise InputError(
            f"The run in {folder} has ended, its figures are in result.json: give a larger --total-steps to go on, "
            f"or evaluate its policy by --eval-only --checkpoint {folder}."
        )


def task_maker(config: RunConfig) -> Any:
    """Makes a batch of the run's task from the number of environments; can be sent to other processes."""
    return functools.partial(make_task, config.env, **config.task_options)


def train(args: Args) -> tuple[Path, int]:
    """Start or resume a run; returns its folder and the exit status.

    Raises:
        InputError: if another process trains in the folder, or settings differ.
    """
    config = args.run
    folder = RunFolder(args.resume or args.out or default_folder(config, config.agent))
    if args.resume is not None:
        refuse_other_settings(args.resume, folder.read_config(), config)
        refuse_finished(args.resume, config.total_steps)
    else:
        folder.create(config)
    with folder.locked():
        options: Any = {"zero": args.zero_correction, "cluster": args.collector == "ray"}
        try:
            trainer = Trainer(config, task_maker(config), folder, resume=args.resume is not None, **options)
        except InputError:
            if args.resume is None:
                folder.discard()
            raise
        folder.write_config(config)  # a larger budget, once it is known that the run can go on
        go_on = "To go on: " + shlex.join([*started_as(sys.orig_argv, sys.argv), "--resume", str(folder.path)])
        try:
            finished = trainer.run()["finished"]
        except RunFailure as error:
            print(f"{error} {go_on}", file=sys.stderr)
            return folder.path, FAILED
        if trainer.interrupted is not None:
            if not finished:
                done = "and saved" if trainer.saved else "since the last checkpoint nothing is saved"
                print(f"Interrupted, {done}. {go_on}", file=sys.stderr)
            return folder.path, STATUS + trainer.interrupted
    if args.video and film(folder.best, config, folder.video / "best.mp4"):
        add_film(folder.path, folder.video / "best.mp4", trainer.counters.env_steps)
    return folder.path, 0


def started_as(original: Sequence[str], own: Sequence[str]) -> list[str]:
    """The command line that began this program, without its options.

    Args:
        original: all words, the interpreter first, as `sys.orig_argv`.
        own: name and options of the program, as `sys.argv`.
    """
    words = list(original[: len(original) - len(own) + 1])
    if len(words) == len(INSTALLED) + 1 and Path(words[1]).name == INSTALLED[0]:  # python .../bin/dora run
        return list(INSTALLED)
    return ["python", *words[1:]]


def evaluate_only(args: Args) -> Path:
    """Film, if asked for, and evaluate a checkpoint or zero correction into a new run folder, which is returned."""
    config, commit = args.run, source_commit()
    path = None if args.checkpoint is None else checkpoint_path(args.checkpoint)
    agent = NO_CORRECTION if path is None else config.agent
    folder = RunFolder(args.out or default_folder(config, agent, "-eval"))
    folder.check_free(evaluation=True)
    os.environ[RECORDS] = str(folder.nonfinite.absolute())  # processes that are started later see it, too
    progress: dict[str, Any] = {"env_steps": 0, "wall_seconds": 0.0, "episodes": 0, "curve": []}
    policy = dict[str, Any]()

    def begin() -> None:
        folder.create(config, evaluation=True)
        held.enter_context(folder.locked())
        if args.video:
            film(path, config, folder.video / ("best.mp4" if path else "zero.mp4"), args.first_seed)
        print(f"evaluation on {config.final_episodes} episodes ...", file=sys.stderr)

    settings = config, task_maker(config)
    with contextlib.ExitStack() as held:
        if path is None:
            begin()
            evaluation = zero = evaluate_zero(*settings, args.first_seed)
            print(f"without any correction: {outcome(evaluation, None)}", file=sys.stderr)
        else:
            options: Any = {"zero": args.zero_correction, "first_seed": args.first_seed, "before": begin}
            checkpoint, evaluation, zero = evaluate_checkpoint(path, *settings, **options)
            progress = {name: checkpoint.progress.get(name, value) for name, value in progress.items()}
            policy = {"policy_seed": checkpoint.config.seed, "policy_digest": file_sha256(path)}  # `seed` may differ
            print(outcome(evaluation, zero), file=sys.stderr)
        folder.write_evaluation(evaluation, zero if path else None)
        result = make_result(config, evaluation=evaluation, zero=zero, finished=True, commit=commit, **progress)
        folder.write_result(result | policy | {"agent": agent, "checkpoint": None if path is None else str(path)})
    if path is not None and (said := agreement(path, folder.path / "eval.csv", config, args.first_seed)):
        print(said, file=sys.stderr)
    return folder.path


def film(checkpoint: Path | None, config: RunConfig, path: Path, seed: int = FINAL_SEED) -> bool:
    """Film the policy of a checkpoint, or zero correction without one, or say in one line why not; returns whether."""
    act = None if checkpoint is None else load_policy(read_checkpoint(checkpoint), checkpoint).greedy
    make_single_task = functools.partial(task_maker(config), 1, render_mode="rgb_array")
    try:
        record(make_single_task, act, path, VIDEO_EPISODES, seed)
    except (RuntimeError, InputError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        print(f"No video: {reason}", file=sys.stderr)
        with contextlib.suppress(OSError):
            path.parent.rmdir()  # nothing is in it, unless there is an earlier film
        return False
    return True


@command
def main() -> int:
    """Run the command; returns the exit status."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    with ending_at_once():
        args = parse(sys.argv[1:])
        folder, status = (evaluate_only(args), 0) if args.eval_only else train(args)
    print(folder)
    return status
