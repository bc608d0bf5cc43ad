"""Films of the policies that come with the tasks: `python -m dora.policies.films`.

Writes <task>.gif, up to three episodes on consecutive seeds whether they succeed or not, and <task>-film.png, moments
of the first of them, to docs/images, and says which episodes succeeded. Needs a Vulkan driver (docs/rendering.md).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import tyro
from jaxtyping import UInt8
from PIL import Image

import dora
from dora.agents.evaluation.evaluate import FINAL_SEED
from dora.agents.evaluation.play import episode_frames
from dora.errors import InputError, command
from dora.files import make_folder, write_bytes
from dora.policies.policy import bundled_ids
from dora.sim.batch.rendering import can_render
from dora.tasks import make_task
from dora.tasks.env.task import short_name
from dora.tools.stage_pictures import Picture, side_by_side

SIDE = 200
"""Width and height of a film [pixels]."""
RATE = 10.0
"""Pictures of a film in a second [1/s]."""
MOST_PICTURES = 300
"""Pictures of a film: of long episodes there are fewer than were asked for, at least one [1]."""
COLOURS = 96
"""Number of colours of a film."""
MOMENTS = 8
"""Number of pictures of a strip."""


@dataclass(frozen=True)
class Args:
    """Films of the policies that come with the tasks."""

    out: Path = Path("docs/images")
    """Folder of the films."""
    episodes: int = 3
    """Episodes of a film."""
    seed: int = FINAL_SEED
    """Seed of the first one; those of the others follow."""


@dataclass(frozen=True)
class Episode:
    """One episode: its pictures, their number in a second, and whether it succeeded."""

    pictures: list[Picture]
    rate: float
    success: bool


def film_episodes(env_id: str, episodes: int, seed: int) -> list[Episode]:
    """Episodes of the policy that comes with a task, with the task's preset."""
    policy = dora.load_policy(env_id)
    task: Any = make_task(env_id, 1, sim_backend="physx_cpu", render_mode="rgb_array", **policy.env_kwargs)
    try:
        filmed = []
        for episode in range(episodes):
            frames = episode_frames(task, policy, seed + episode)
            success = bool(task.evaluate()["success"][0])
            filmed.append(Episode([_small(frame) for frame in frames], float(task.control_freq), success))
        return filmed
    finally:
        task.close()


def _small(frame: UInt8[np.ndarray, "_ _ 3"]) -> Picture:
    """The middle square of a picture, in the size of a film."""
    height, width = frame.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = Image.fromarray(frame[top : top + side, left : left + side])
    return np.asarray(square.resize((SIDE, SIDE), Image.Resampling.LANCZOS))


def as_gif(episodes: list[Episode]) -> bytes:
    """A film of the episodes with one palette, of as many of them as `MOST_PICTURES` allows."""
    frames: list[Picture] = []
    for episode in episodes:
        some = episode.pictures[:: max(round(episode.rate / RATE), 1)]
        if frames and len(frames) + len(some) > MOST_PICTURES:
            break
        frames += some
    some = np.concatenate(frames[:: max(len(frames) // 12, 1)])
    palette = Image.fromarray(some).quantize(COLOURS, dither=Image.Dither.NONE)
    pictures = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    written: Any = imageio.mimwrite(  # pyright: ignore[reportCallIssue]
        "<bytes>", [np.asarray(p.convert("RGB")) for p in pictures], format="GIF", duration=1000 / RATE, loop=0
    )
    return written


def strip(episode: Episode) -> Picture:
    """Moments of an episode side by side: the first and the last, and those between which equally much changes."""
    pictures = np.stack(episode.pictures).astype(np.float32)
    changes = np.abs(np.diff(pictures, axis=0)).mean((1, 2, 3))
    so_far = np.concatenate([[0.0], np.cumsum(changes)])
    places = np.searchsorted(so_far, np.linspace(0, so_far[-1], MOMENTS)).clip(max=len(pictures) - 1)
    return side_by_side([episode.pictures[place] for place in places])


@command
def main() -> None:
    """Film every bundled policy."""
    args = tyro.cli(Args, description=__doc__)
    if not can_render():
        raise InputError("No film: SAPIEN finds no Vulkan driver here (docs/rendering.md).")
    make_folder(args.out)
    for env_id in bundled_ids():
        episodes = film_episodes(env_id, args.episodes, args.seed)
        name = short_name(env_id)
        write_bytes(args.out / f"{name}.gif", as_gif(episodes))
        imageio.imwrite(args.out / f"{name}-film.png", strip(episodes[0]))
        outcome = ", ".join("succeeded" if episode.success else "failed" for episode in episodes)
        print(f"{args.out / name}.gif: seeds from {args.seed}: {outcome}")


if __name__ == "__main__":
    sys.exit(main())
