"""A dataset as a folder that appears only when it is whole: what acts, how many episodes, in which format."""

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from mani_skill.utils.wrappers.record import RecordEpisode

from dora.arguments import LARGEST_SEED
from dora.datasets.episodes import Episode, Plan, Source, make_batch, roll_out
from dora.datasets.facts import Facts, facts_of
from dora.datasets.hdf5_files import ForgivingFile, open_undisturbed, undisturbed
from dora.datasets.lerobot import write_lerobot
from dora.datasets.minari import write_minari
from dora.datasets.tables import require_pyarrow
from dora.errors import InputError
from dora.files import check_new_name, make_folder, write_json
from dora.live.recordings import seal
from dora.parallel import folder_beside, one_thread
from dora.sim.batch.rendering import can_render
from dora.version import version_line

FORMATS = ("lerobot", "minari", "maniskill")
"""Formats of datasets."""
NAME = "demonstrations"
"""Files of ManiSkill's format, before .h5 and .json."""
ROOM = 65_536
"""Room on the disk without which ManiSkill's recorder is not begun [bytes]."""
OWN = "recording.json"
"""File of a dataset that says how it was made, and lists seed, length and success of its episodes."""


@dataclass
class Summary:
    """What was recorded so far: episodes, successes among them, control steps."""

    episodes: int = 0
    successes: int = 0
    steps: int = 0

    def count(self, episode: Episode) -> None:
        """Count one more episode."""
        self.episodes += 1
        self.successes += episode.success
        self.steps += len(episode)


def check_possible(kind: str, plan: Plan, folder: Path, pictures: bool) -> None:
    """Refuse what cannot work, before any work.

    Raises:
        InputError: the folder exists or cannot be made; a library or driver is missing; numbers out of range.
    """
    if kind not in FORMATS:
        raise InputError(f"there is no format {kind!r}: choose one of {', '.join(FORMATS)}.")
    if plan.episodes < 1 or plan.num_envs < 1:
        raise InputError(f"a dataset needs an episode in an environment, not {plan.episodes} in {plan.num_envs}.")
    if not 0 <= plan.seed <= LARGEST_SEED - 100 * plan.episodes:
        first = f"the seed of the first start is {plan.seed}"
        raise InputError(f"{first}; those of all have to be from 0 to {LARGEST_SEED}.")
    check_new_name(folder)
    if kind == "lerobot":
        require_pyarrow()
    if pictures and kind == "minari":
        raise InputError("pictures are not written in Minari's format: choose the format lerobot or maniskill.")
    if pictures and not can_render():
        raise InputError(
            "No pictures: SAPIEN finds no Vulkan driver here (docs/rendering.md in the project); leave pictures out."
        )
    make_folder(folder.absolute().parent)


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder beside `folder` that gets its name when the context ends well, and is removed otherwise; that of a
    killed process by the next recording.

    Raises:
        InputError: something cannot be written, or `folder` has come to exist meanwhile.
    """
    temporary = None
    try:
        temporary = folder_beside(folder)
        yield temporary
        os.chmod(temporary, 0o755)
        if os.path.lexists(folder):
            raise InputError(f"{folder} exists meanwhile: nothing was written; choose another folder.")
        os.rename(temporary, folder)
    except OSError as error:
        raise InputError(
            f"Cannot write {folder} ({error.strerror or error}): nothing was written; choose another folder."
        ) from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


@one_thread()
def record_dataset(
    kind: str,
    source: Source,
    plan: Plan,
    folder: Path,
    pictures: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Summary:
    """Let a source act until there are as many episodes as are wanted, and write them as a dataset.

    On one thread: a policy's products are rounded otherwise on more, so that other starts would end in a success.

    Args:
        kind: one of `FORMATS`.
        source: what acts, of `find_source`.
        plan: how many episodes, from which starts.
        folder: of the dataset; it appears when all is written.
        pictures: record the cameras, too.
        progress: called with the number of episodes recorded and wanted.

    Raises:
        InputError: as `check_possible`, or too few starts end in a success.
    """
    check_possible(kind, plan, folder, pictures)
    summary, table = Summary(), list[dict[str, Any]]()
    with new_folder(folder) as place:
        with contextlib.ExitStack() as stack:
            recorder = below = None
            env = make_batch(source, min(plan.num_envs, plan.episodes), pictures)
            if kind == "maniskill":
                recorder, below = stack.enter_context(_recorder(env, place, source))
                env = recorder
            stack.callback(env.close)

            def episodes() -> Iterator[Episode]:
                """What the source does, episode by episode, counted; OSError on a disk that is full."""
                for row, episode in roll_out(env, source.act, plan, progress):
                    if recorder is not None and below is not None:
                        with undisturbed():
                            recorder.flush_trajectory(env_idxs_to_flush=[row])
                        below.check()
                    summary.count(episode)
                    table.append({"seed": episode.seed, "steps": len(episode), "success": episode.success})
                    yield episode

            options = json.loads(json.dumps(dict(source.options)))  # tuples become lists
            _write(kind, place, env, options, source, episodes())
        if kind == "maniskill":
            seal(place / f"{NAME}.h5")
        made = {"env": source.env_id, "options": options, "policy": source.name, "description": source.description}
        write_json(place / OWN, {**made, "version": version_line(), "episodes": table})
    return summary


def _write(
    kind: str, place: Path, env: gym.Env, options: Mapping[str, Any], source: Source, episodes: Iterator[Episode]
) -> None:
    if kind == "lerobot":
        write_lerobot(place, _facts(env, source), episodes)
    elif kind == "minari":
        write_minari(place, _facts(env, source), options, (source.name, source.description), episodes)
    else:
        for _ in episodes:
            pass


def _facts(env: gym.Env, source: Source) -> Facts:
    env.reset(seed=0)
    return facts_of(env)


@contextlib.contextmanager
def _recorder(env: gym.Env, folder: Path, source: Source) -> Iterator[tuple[RecordEpisode, ForgivingFile]]:
    """A batch whose ended episodes can be written as ManiSkill's trajectories, with rewards and all states, and the
    file into which they are written; it is closed at the end, whatever happens."""
    (folder / f"{NAME}.h5").write_bytes(bytes(ROOM))  # a full disk is met here, and not in the recorder's own file
    recorder = RecordEpisode(
        env,  # pyright: ignore[reportArgumentType]
        str(folder),
        trajectory_name=NAME,
        save_on_reset=False,
        save_video=False,
        source_type="motionplanning" if source.name == "scripted" else "rl",
        source_desc=source.description,
    )
    recorder._h5_file.close()
    recorder._json_path = str(folder / f"{NAME}.json")  # theirs replaces ".h5" in the whole path
    with ForgivingFile(folder / f"{NAME}.h5") as below:
        with open_undisturbed(below) as recorder._h5_file:
            yield recorder, below
        below.check()
