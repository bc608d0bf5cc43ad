"""What the stages of a task look like, to people and to its cameras: `python -m dora.tools.stage_pictures`.

Draws docs/images/<task>-stages.png and docs/images/cameras.png; needs a Vulkan driver (docs/rendering.md).
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8

from dora.errors import InputError, command
from dora.sim.batch.rendering import can_render
from dora.tasks import make_task, task_ids
from dora.tasks.env.task import short_name

SEEDS = range(1, 21)
"""Starts that are tried, in order, until the scripted solution completes all stages (at 0 the jug hides its handle)."""
SHRINK = 2
"""Pixels that become one along each side."""
GAP = 10
"""White columns between two pictures [pixels]."""
SIDE = 144
"""Width and height of what a camera of observations draws here [pixels]."""
OBSERVED = "rgb+depth+segmentation"
"""What those cameras observe."""

Picture = UInt8[np.ndarray, "h w 3"]


def stage_frames(task: Any, seed: int, draw: Callable[[Any], Picture] | None = None) -> list[Picture] | None:
    """The start of an episode of the scripted solution and the step in which each stage was first completed.

    Args:
        task: a Dora task of one environment that renders.
        seed: of the episode.
        draw: makes a picture of the task's present state; by default what `render` shows, at half the size.

    Returns:
        A picture more than the task has stages, or None if the last stage was not completed.
    """
    draw = draw or _picture
    task.reset(seed=seed)
    frames = [draw(task)]
    for _ in range(task.max_steps):
        task.step(task.scripted_action())
        completed = int(task.machine.furthest[0])
        if completed >= len(frames):
            frames += [draw(task)] * (completed + 1 - len(frames))
        if len(frames) > len(task.machine.stages):
            return frames
    return None


def side_by_side(frames: list[Picture]) -> UInt8[np.ndarray, "h _ 3"]:
    """One picture of several of the same size, white gaps between them."""
    white = np.full((len(frames[0]), GAP, 3), 255, np.uint8)
    parts = [part for frame in frames for part in (white, frame)]
    return np.concatenate(parts[1:], axis=1)


def _picture(task: Any) -> Picture:
    frame = np.asarray(task.render()[0].cpu(), dtype=np.uint8)
    height, width = (side // SHRINK for side in frame.shape[:2])
    cells = frame[: height * SHRINK, : width * SHRINK].reshape(height, SHRINK, width, SHRINK, 3)
    return cells.mean((1, 3)).astype(np.uint8)


def observed(task: Any) -> Picture:
    """What the cameras of observations see, one below the other, in colours."""
    return np.concatenate([_image(shot["rgb"]) for shot in task.get_sensor_images().values()])


def other_textures(task: Any) -> Picture:
    """Depth as the first camera sees it, and below it the segmentation of the others."""
    first, *others = task.get_sensor_images().values()
    return np.concatenate([_image(first["depth"]), *(_image(shot["segmentation"]) for shot in others)])


def one_below_the_other(strips: list[Picture]) -> UInt8[np.ndarray, "_ w 3"]:
    """One picture of strips of any width, white gaps between them."""
    width = max(strip.shape[1] for strip in strips)
    wide = [np.pad(s, ((0, GAP), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in strips]
    return np.concatenate(wide)[:-GAP]


def _image(picture: Any) -> Picture:
    return np.asarray(picture[0].cpu(), dtype=np.uint8)


def _first(task: Any, draw: Callable[[Any], Picture]) -> list[Picture]:
    """Frames of the first of `SEEDS` from which the scripted solution completes all stages."""
    frames = next((found for seed in SEEDS if (found := stage_frames(task, seed, draw))), None)
    if frames is None:
        raise RuntimeError(f"the scripted solution of {type(task).__name__} failed from all of {len(SEEDS)} starts")
    return frames


@command
def main(docs: Path) -> None:
    """Draws the stages of every registered task, and what its cameras see of them.

    Raises:
        RuntimeError: the scripted solution of a task fails from all starts that are tried.
    """
    if not can_render():
        raise InputError("nothing can be rendered here for want of a Vulkan driver: see docs/rendering.md.")
    strips, size = [], {"width": SIDE, "height": SIDE}
    for env_id in task_ids():
        task = make_task(env_id, 1, preset="none", render_mode="rgb_array", obs_mode=OBSERVED, sensor_configs=size)
        strips.append(side_by_side([*_first(task, observed), other_textures(task)]))
        path = docs / "images" / f"{short_name(env_id)}-stages.png"
        imageio.imwrite(path, side_by_side(_first(task, _picture)))
        task.close()
        print(f"{path}: {env_id}")
    path = docs / "images" / "cameras.png"
    imageio.imwrite(path, one_below_the_other(strips))
    print(f"{path}: what the cameras of {', '.join(task_ids())} observe")


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs")))
