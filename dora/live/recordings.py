"""Trajectory files of ManiSkill: actions and first states of recorded episodes, with what their task was made with."""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float

from dora.digests import check_file, file_sha256
from dora.errors import InputError, shown
from dora.reading import check_size, read_bytes, read_json
from dora.tasks import check_task_id

MOST_BYTES = 4_000_000_000
"""Size of a trajectory file above which it is not read [bytes]."""
MOST_NUMBERS = 10_000_000
"""Largest number of values of one array of an episode, and of all that is unpacked for it: whole chunks of the file."""
LEAST_CHUNK = 100
"""What a chunk counts at least, because each takes its time [numbers]."""
MOST_MEMBERS, DEEPEST = 1000, 10
"""Largest number of arrays and groups of an episode, and depth of groups in each other."""
MOST_SEED = 2**32 - 1
"""Largest seed."""
KEPT = ("guidance", "guidance_parts", "hand_joints", "preset", "config", "control_mode", "robot_uids", "sim_config")
"""Arguments of a task that say what its actions and states mean; the others are of the machine that recorded."""
SUMS = ".sha256"
"""Ending of the file with the checksums of a trajectory file and of its index, which lies beside them."""
MOST_SUMS = 10_000
"""Largest size of it [bytes]."""


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode of a file.

    Attributes:
        seed: of its start; 0 if the file does not say.
        actions: (t, a).
        state: the first state, as of `get_state_dict`, of one environment; None if the file has no states.
    """

    seed: int
    actions: Float[np.ndarray, "t a"]
    state: Mapping[str, Any] | None


@dataclass(frozen=True)
class Recording:
    """A trajectory file (HDF5) with its index (JSON) beside it; episodes are read when they are played.

    Attributes:
        path: of the trajectory file.
        env_id: id of the task.
        options: arguments of the task.
        names: of the episodes' groups in the file, and their seeds.
    """

    path: Path
    env_id: str
    options: Mapping[str, Any]
    names: tuple[tuple[str, int], ...]

    @classmethod
    def open(cls, path: Path) -> Recording:
        """Reads the index.

        Raises:
            InputError: a file is missing, damaged or something else, or the recording is of no Dora task.
        """
        check_size(path, "trajectory file", MOST_BYTES)
        index_path = path.with_suffix(".json")
        if not os.path.isfile(index_path):
            raise InputError(f"{index_path} is missing: the index of a recording has to lie beside {path.name}.")
        _check_whole(path)
        index = read_json(index_path, "index of a recording")
        info = index.get("env_info") if isinstance(index, dict) else None
        episodes = index.get("episodes") if isinstance(index, dict) else None
        if not isinstance(info, dict) or not isinstance(episodes, list) or not isinstance(info.get("env_id"), str):
            raise InputError(f"{index_path} is no index of a ManiSkill recording: name the .h5 file of one.")
        env_id = info["env_id"].rpartition(":")[2]  # MODULE:ID opens it in gymnasium
        check_task_id(env_id)
        kwargs: Any = info.get("env_kwargs")
        kwargs = kwargs if isinstance(kwargs, dict) else {}
        names = tuple(_named(episode, index_path) for episode in episodes)
        if not names:
            raise InputError(f"{path} has no episode: record one that succeeds.")
        return cls(path, env_id, {name: kwargs[name] for name in KEPT if name in kwargs}, names)

    def episode(self, number: int) -> RecordedEpisode:
        """Reads one episode, by its place in the file.

        Raises:
            InputError: it is missing or damaged.
        """
        name, seed = self.names[number]
        try:
            with h5py.File(self.path) as file:
                group = _member(file, name)
                reader = _Reader()
                actions = reader.rows(group, "actions")
                state = reader.first(_member(group, "env_states"), DEEPEST) if "env_states" in group else None
        except (OSError, KeyError, TypeError, ValueError, RuntimeError, AttributeError, zlib.error) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"{self.path} has no intact episode {name} ({reason}): record it again.") from error
        if actions.ndim != 2 or not len(actions) or not np.isfinite(actions).all():
            raise InputError(f"{self.path}: the actions of {name} are no table of finite numbers: record it again.")
        return RecordedEpisode(seed, actions, state)


def seal(path: Path) -> None:
    """Write the checksums of a recording beside it, as `sha256sum` writes them.

    Args:
        path: of the trajectory file (HDF5), with its index (JSON) beside it.

    Raises:
        InputError: a file cannot be read.
        OSError: the checksums cannot be written.
    """
    path.with_suffix(SUMS).write_bytes(os.fsencode("".join(_sums(path, path.stem).values())))


def _check_whole(path: Path) -> None:
    """Refuse a recording that is no longer as `seal` left it; one without checksums, of another program, passes.

    Args:
        path: of the trajectory file.

    Raises:
        InputError: a file was damaged or changed, or cannot be read.
    """
    check_file(path)
    check_file(path.with_suffix(".json"))
    sums = path.with_suffix(SUMS)
    if not os.path.lexists(sums):
        return
    found = os.fsdecode(read_bytes(sums, "file of checksums", MOST_SUMS))
    stem = found.partition("  ")[2].partition(f"{path.suffix}\n")[0]  # all three files may have been renamed
    expected = _sums(path, stem)
    if found == "".join(expected.values()):
        return
    changed = [name for name, line in expected.items() if line not in found]
    raise InputError(
        f"{path.with_name(changed[0]) if changed else sums} is not as it was written, by its checksum in {sums.name}: "
        f"record it again, or remove {sums.name} to play it as it is."
    )


def _sums(path: Path, stem: str) -> dict[str, str]:
    """A line for each file of a recording, as of `sha256sum`, under names with this stem; by the names of now."""
    files = (path, path.with_suffix(".json"))
    return {file.name: f"{file_sha256(file)}  {stem}{file.suffix}\n" for file in files}


def _named(episode: Any, path: Path) -> tuple[str, int]:
    """Name of an episode's group and its seed."""
    number = episode.get("episode_id") if isinstance(episode, dict) else None
    seed = episode.get("episode_seed", 0) if isinstance(episode, dict) else 0
    seed = seed[0] if isinstance(seed, list) and seed else seed
    if type(number) is not int or number < 0:
        raise InputError(f"{path} has an episode with the number {shown(number)}: record it again.")
    return f"traj_{number}", seed if type(seed) is int and 0 <= seed <= MOST_SEED else 0


def _member(group: Any, name: str) -> Any:
    """A group or array that is in the file itself; ValueError for a link, which may lead to another file."""
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is missing or is a link")
    return group[name]


def _array(group: Any, name: str) -> Any:
    """An array of bounded size that is in the file itself; ValueError for another one."""
    data = _member(group, name)
    if not isinstance(data, h5py.Dataset) or data.is_virtual or data.external or data.dtype.kind not in "biuf":
        raise ValueError(f"{name} is no array of numbers in the file itself")
    if data.size is None or data.size > MOST_NUMBERS or data.ndim < 1 or len(data) == 0:
        raise ValueError(f"{name} has too many numbers, or no rows")
    return data


def _check_chunks(data: Any, count: int) -> None:
    """ValueError if the chunks with the first rows are not packed by gzip, or unpack to more than a chunk holds."""
    steps = data.id.get_create_plist()
    filters = [steps.get_filter(k)[0] for k in range(steps.get_nfilters())]
    if not set(filters) <= {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE}:
        raise ValueError("an array is packed in another way than by gzip")
    if h5py.h5z.FILTER_DEFLATE not in filters:
        return
    skipped, size = 1 << filters.index(h5py.h5z.FILTER_DEFLATE), prod(data.chunks or ()) * data.dtype.itemsize
    offsets: list[tuple[int, ...]] = []
    data.id.chunk_iter(lambda chunk: offsets.append(chunk.chunk_offset) if chunk.chunk_offset[0] < count else None)
    for offset in offsets:
        mask, packed = data.id.read_direct_chunk(offset)
        if not mask & skipped and len(zlib.decompressobj().decompress(packed, size + 1)) > size:
            raise ValueError("an array unpacks to more than it holds")


class _Reader:
    """Reads the arrays of one episode, as long as they are few and small together."""

    def __init__(self) -> None:
        self._numbers, self._members = MOST_NUMBERS, MOST_MEMBERS

    def rows(self, group: Any, name: str, count: int | None = None) -> np.ndarray:
        """The first rows of an array, or all; ValueError for a wrong one, or if that becomes too much."""
        data = _array(group, name)
        shape = (len(data) if count is None else min(count, len(data)), *data.shape[1:])
        chunks = data.chunks or tuple(max(size, 1) for size in shape)
        pieces = prod(-(-size // chunk) for size, chunk in zip(shape, chunks, strict=True))
        self._numbers -= pieces * max(prod(chunks), LEAST_CHUNK)
        if self._numbers < 0:
            raise ValueError(f"its arrays unpack to more than {MOST_NUMBERS} numbers")
        if data.chunks:
            _check_chunks(data, shape[0])
        return np.asarray(data[: shape[0]], np.float32)

    def first(self, group: Any, depth: int) -> dict[str, Any]:
        """The first row of every array of a group, as (1, ...); ValueError if it is too deep or too large."""
        self._members -= len(group) if isinstance(group, h5py.Group) else 0
        if depth == 0 or not isinstance(group, h5py.Group) or self._members < 0:
            raise ValueError("its states are too many, or nested too deep")
        return {
            name: self.first(_member(group, name), depth - 1)
            if isinstance(_member(group, name), h5py.Group)
            else self.rows(group, name, 1)
            for name in map(str, group)
        }
