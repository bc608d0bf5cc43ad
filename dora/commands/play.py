"""Watch a task live on a web page: the robot, what it knows, what it feels, and controls to disturb it.

    dora play DoraHammer-v1                                   # the policy that comes with the task
    dora play DoraJug-v1 --checkpoint runs/DoraJug-v1/RUN     # a policy of your own
    dora play DoraCube-v1 --recording demonstrations.h5       # a trajectory file of ManiSkill
    dora play DoraHammer-v1 --video hammer.mp4                # a film instead of a page

Needs no GPU and no graphics driver; only a film needs a Vulkan driver. Runs until Ctrl-C.
"""

import contextlib
import functools
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from dora.agents.evaluation.play import check_film, record
from dora.arguments import LARGEST_SEED
from dora.configs import check_ranges
from dora.errors import InputError, command
from dora.files import make_folder
from dora.live.page import Page
from dora.live.players import Player, recorded, zero_correction
from dora.live.recordings import Recording
from dora.live.session import Session
from dora.policies.policy import TaskPolicy, bundled_ids, load_policy
from dora.sim.batch.rendering import can_render
from dora.tasks import check_task_id, make_task

RANGES = {"port": (1, 65_535), "seed": (0, LARGEST_SEED), "episodes": (1, 1000)}
"""Lowest and highest value of options."""
POLICY = "policy"
"""Name of a policy among those who may act."""
LOOK = 0.2
"""Time between looks whether session and page are well [s]."""


@dataclass(frozen=True)
class Args:
    """Watch a task live on a web page."""

    env: tyro.conf.Positional[str]
    """Task id, for example DoraHammer-v1."""
    checkpoint: Path | None = None
    """Policy of your own: a .safetensors file, or a run folder for its best one."""
    recording: Path | None = None
    """Trajectory file of ManiSkill (.h5 with the .json beside it), which is played first."""
    zero_correction: bool = False
    """Begin with the zero action instead of the policy."""
    seed: int = 0
    """Seed of the first episode."""
    preset: Literal["none", "standard", "hard"] = "standard"
    """How much episodes are randomised."""
    port: int = 8080
    """TCP port of the page."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines see the page, and press its buttons."""
    video: Path | None = None
    """Film to write at once, such as hammer.mp4; no page is served then (needs a Vulkan driver)."""
    episodes: int = 1
    """Episodes of the film."""


def find_policy(env_id: str, checkpoint: Path | None) -> TaskPolicy | None:
    """The policy of a checkpoint, or the one that comes with a task; None if none does.

    Raises:
        InputError: the checkpoint is missing, damaged, or of another task.
    """
    if checkpoint is None and env_id not in bundled_ids():
        return None
    policy = load_policy(env_id if checkpoint is None else checkpoint)
    if policy.env_id != env_id:
        raise InputError(f"{checkpoint} is a policy of {policy.env_id}, not of {env_id}: name the task that it is of.")
    return policy


def find_players(args: Args) -> list[Player]:
    """Who may act, the first one that which is asked for.

    Raises:
        InputError: a file is missing, damaged, or of another task, or zero correction is asked for where a zero action
            is no correction.
    """
    policy = find_policy(args.env, args.checkpoint)
    players = [] if policy is None else [Player(POLICY, policy.env_kwargs, policy)]
    if policy is None or policy.config.has_prior:
        zero = zero_correction({} if policy is None else policy.env_kwargs)
        players.insert(0 if args.zero_correction else len(players), zero)
    elif args.zero_correction:
        raise InputError("--zero-correction needs guidance with a prior, and this policy was trained without any.")
    if args.recording is not None:
        recording = Recording.open(args.recording)
        if recording.env_id != args.env:
            raise InputError(f"{args.recording} is of {recording.env_id}, not of {args.env}: name that task.")
        players.insert(0, recorded(recording))
    return players


def film(args: Args, player: Player) -> Path:
    """Film whole episodes of the policy; returns the path of the film.

    Raises:
        InputError: there is no Vulkan driver, or a recording is to be filmed.
    """
    assert args.video is not None
    if player.recording is not None:
        raise InputError("--video films a policy: leave out --recording, or --video to watch it on the page.")
    logging.getLogger("mani_skill").setLevel(logging.ERROR)  # the sentence below says what its note says
    if not can_render():
        raise InputError(
            "No film: SAPIEN finds no Vulkan driver here (docs/rendering.md in the project); the page needs none."
        )
    make_folder(args.video.parent)
    options = player.options_with(args.env, args.preset)
    make = functools.partial(make_task, args.env, 1, sim_backend="physx_cpu", render_mode="rgb_array", **options)
    record(make, player.act, args.video, args.episodes, args.seed)
    return args.video


@contextlib.contextmanager
def served(session: Session, port: int, host: str) -> Iterator[Page]:
    """A page of a session, both running; they end with the context."""
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a client that goes away would bring a traceback
    page = Page(session, port, host)
    session.start()
    page.start()
    try:
        yield page
    finally:
        page.stop()
        session.stop()


def serve(session: Session, port: int, host: str) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        KeyboardInterrupt: by Ctrl-C, when the page has ended.
        InputError: viser is not installed, or the port is in use.
        RuntimeError: session or page broke down.
    """
    with served(session, port, host) as page:
        print(page.url, flush=True)
        while session.error is None and page.error is None:
            time.sleep(LOOK)
        if (error := session.error or page.error) is not None:
            raise RuntimeError(f"the page has ended: {error}") from error


@command
def main() -> int:
    """Run the command; returns the exit status."""
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=__doc__)
    torch.set_num_threads(1)
    check_ranges(args, RANGES, lambda name: f"--{name}")
    if args.video is not None:
        check_film(args.video)
    elif args.episodes != Args.episodes:
        raise InputError("--episodes is the length of a film: give --video with it, or leave it out.")
    check_task_id(args.env)
    players = find_players(args)
    if args.video is not None:
        print(film(args, players[0]))
        return 0
    serve(Session(args.env, players, preset=args.preset, seed=args.seed), args.port, args.host)
    return 0
