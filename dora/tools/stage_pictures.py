"""What the stages of a task look like: `python -m dora.tools.stage_pictures` draws docs/images/<task>-stages.png.

Needs a Vulkan driver (docs/rendering.md).
"""

import sys
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8

from dora.errors import InputError
from dora.sim.batch.rendering import can_render
from dora.tasks import make_task, task_ids
from dora.tasks.env.task import short_name

SEEDS = range(1, 21)
"""Starts that are tried, in order, until the scripted solution completes all stages (at 0 the jug hides its handle)."""
SHRINK = 2
"""Pixels that become one along each side."""
GAP = 10
"""White columns between two pictures [pixels]."""

Picture = UInt8[np.ndarray, "h w 3"]


def stage_frames(task: Any, seed: int) -> list[Picture] | None:
    """The start of an episode of the scripted solution and the step in which each stage was first completed.

    Args:
        task: a Dora task of one environment that renders.
        seed: of the episode.

    Returns:
        A picture more than the task has stages, or None if the last stage was not completed.
    """
    task.reset(seed=seed)
    frames = [_picture(task)]
    for _ in range(task.max_steps):
        task.step(task.scripted_action())
        completed = int(task.machine.furthest[0])
        if completed >= len(frames):
            frames += [_picture(task)] * (completed + 1 - len(frames))
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


def main(docs: Path) -> None:
    """Draws the stages of every registered task.

    Raises:
        InputError: nothing can be rendered here.
        RuntimeError: the scripted solution of a task fails from all starts that are tried.
    """
    if not can_render():
        raise InputError("nothing can be rendered here for want of a Vulkan driver: see docs/rendering.md.")
    for env_id in task_ids():
        task = make_task(env_id, 1, preset="none", render_mode="rgb_array")
        frames = next((found for seed in SEEDS if (found := stage_frames(task, seed))), None)
        task.close()
        if frames is None:
            raise RuntimeError(
                f"the scripted solution of {env_id} completed its stages from none of {len(SEEDS)} starts"
            )
        path = docs / "images" / f"{short_name(env_id)}-stages.png"
        imageio.imwrite(path, side_by_side(frames))
        print(f"{path}: {env_id}")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs"))
    except InputError as error:
        sys.exit(str(error))
