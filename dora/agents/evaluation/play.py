"""Evaluation of a checkpoint, and films of a policy."""

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from dora.agents.checkpoint import Checkpoint, check_belongs, read_checkpoint, unpack_modules
from dora.agents.collecting.task_env import MakeTask, Task
from dora.agents.config import RunConfig
from dora.agents.evaluation.evaluate import FINAL_SEED, Act, Evaluation, no_correction
from dora.agents.evaluation.evaluators import Evaluators
from dora.agents.learners.learner import agents_of, make_learner
from dora.agents.learners.networks import Policy
from dora.errors import InputError
from dora.files import film_is_whole

FILMS = (".mp4", ".mov", ".avi", ".mkv", ".wmv", ".gif")
"""Suffixes of films that can be written."""
GIF_TICKS, MOST_LEFT_OUT = 100, 10
"""Ticks per second in which a GIF counts, and frames of a film of which it must have one [1]."""
FRAMES_PER_SECOND = 20
"""Rate of a film of a task that does not say its control frequency [Hz]."""


def checkpoint_path(path: Path) -> Path:
    """The file meant by `path`: itself, the best checkpoint of a run folder, or the policy beside a stored result."""
    if not os.path.isdir(path):
        return path
    best, stored = path / "checkpoints" / "best.safetensors", path / "policy.safetensors"
    return stored if os.path.isfile(stored) and not os.path.isfile(best) else best


def load_policy(checkpoint: Checkpoint, path: Path) -> Policy:
    """The policy of a checkpoint.

    Raises:
        InputError: if its tensors do not fit its settings, or are not finite.
    """
    policy = make_learner(checkpoint.config, *checkpoint.sizes, checkpoint.agents).policy
    unpack_modules(policy.modules_by_name, checkpoint.tensors, path)
    return policy


def evaluate_checkpoint(
    path: Path,
    config: RunConfig,
    make_task: MakeTask,
    *,
    zero: bool = True,
    first_seed: int = FINAL_SEED,
    before: Callable[[], None] = lambda: None,
) -> tuple[Checkpoint, Evaluation, Evaluation | None]:
    """Evaluate a checkpoint on `config.final_episodes` episodes, by default those of final evaluations.

    The networks are those of the checkpoint, whatever `config.learner` says.

    Args:
        path: of the checkpoint.
        config: settings of the task and of the evaluation.
        make_task: makes a batch of tasks; picklable.
        zero: evaluate no correction, too, if there is a prior.
        first_seed: seed of the first episode.
        before: called when the checkpoint has been found to fit.

    Raises:
        InputError: if it is no checkpoint or belongs to another task, learner or guidance.
    """
    checkpoint = read_checkpoint(path)
    settings = dataclasses.replace(config, learner=checkpoint.config.learner)
    evaluators = Evaluators(make_task, settings, config.final_episodes)
    try:
        agents = agents_of(settings, evaluators.agents)
        check_belongs(checkpoint, path, config, evaluators.sizes, agents, exactly=False)
        before()
        return checkpoint, *evaluators.final(load_policy(checkpoint, path), zero=zero, first_seed=first_seed)
    finally:
        evaluators.close()


def evaluate_zero(config: RunConfig, make_task: MakeTask, first_seed: int = FINAL_SEED) -> Evaluation:
    """Evaluate no correction of a task without any policy; arguments as for `evaluate_checkpoint`."""
    evaluators = Evaluators(make_task, config, config.final_episodes)
    try:
        return evaluators.run(None, config.final_episodes, first_seed)
    finally:
        evaluators.close()


def check_film(path: Path) -> None:
    """Refuse the path of a film that could not be written.

    Raises:
        InputError: it has another suffix than `FILMS`, or is a folder.
    """
    if path.suffix.lower() not in FILMS:
        raise InputError(f"{path} is no name of a film: let it end in one of {', '.join(FILMS)}.")
    if os.path.isdir(path):
        raise InputError(f"{path} is a folder: name a file for the film.")


def record(
    make_task: Callable[[], Task], act: Act | None, path: Path, episodes: int, first_seed: int = FINAL_SEED
) -> None:
    """Film whole episodes of a task with one environment that can `render()`, one after the other.

    Args:
        make_task: makes that environment.
        act: the policy; None for no correction.
        path: of the film.
        episodes: number of episodes.
        first_seed: seed of the first one; those of the others follow.

    The film appears when it is whole; an earlier one of that name stays until then.

    Raises:
        InputError: as `check_film`, or it cannot be written.
        RuntimeError: if nothing can be rendered, for want of a driver.
    """
    check_film(path)
    task: Any = make_task()
    try:
        act = act or no_correction(len(task.single_action_space.low))
        rate = getattr(task, "control_freq", FRAMES_PER_SECOND)
        first = episode_frames(task, act, first_seed)
        later = (episode_frames(task, act, first_seed + episode) for episode in range(1, episodes))
        write_film(path, itertools.chain([first], later), rate)
    finally:
        task.close()


def write_film(path: Path, episodes: Iterable[Sequence[UInt8[np.ndarray, "h w 3"]]], rate: float | int) -> None:
    """Write the frames of episodes, one after the other, as a film with so many frames per second [Hz].

    The frames of a GIF last multiples of 10 ms, so that it has every second, third, ... one where a frame would not.

    Raises:
        InputError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    beside, count = path.absolute().with_name(f".{os.getpid()}-{path.name}"), 0  # FFmpeg takes "a:b" as a protocol
    gif = path.suffix.lower() == ".gif"
    every = next((n for n in range(1, MOST_LEFT_OUT) if (n * GIF_TICKS / rate).is_integer()), 1) if gif else 1
    options: dict[str, Any] = {"loop": 0} if gif else {"macro_block_size": 8}
    try:
        with imageio.get_writer(beside, fps=rate / every, **options) as writer:
            for frames in episodes:
                for frame in frames[::every]:
                    writer.append_data(frame)  # pyright: ignore[reportAttributeAccessIssue]
                count += len(frames)
        if not gif and not film_is_whole(beside, count, rate):
            raise OSError("the encoder did not end well")
        os.replace(beside, path)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path} cannot be written ({reason}): make room on the disk, and film again.") from error
    finally:
        beside.unlink(missing_ok=True)


@torch.no_grad()
def episode_frames(task: Any, act: Act, seed: int) -> list[UInt8[np.ndarray, "h w 3"]]:
    """What `render` shows of an episode, from its start until its time is over or it has failed.

    Args:
        task: one environment that can render.
        act: the policy.
        seed: of the start.
    """
    low, high = (torch.as_tensor(x) for x in (task.single_action_space.low, task.single_action_space.high))
    observation, _ = task.reset(seed=seed)
    frames = [_picture(task.render())]
    for _ in range(task.max_steps):
        observation, _, _, _, info = task.step(act(observation).clamp(low, high))
        frames.append(_picture(task.render()))
        if "fail" in info and bool(info["fail"]):
            break
    return frames


def _picture(image: Any) -> UInt8[np.ndarray, "h w 3"]:
    """The image that `render` returned, as bytes."""
    array = image.cpu().numpy() if isinstance(image, Tensor) else np.asarray(image)
    return array.reshape(array.shape[-3:]).astype(np.uint8)
