"""Replay buffer whose files grow with it, so that saving a checkpoint stays cheap."""

from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler

from dora.errors import InputError
from dora.files import MOST_BYTES, read_safetensors, write_safetensors

FORMAT = "dora-replay 1"
"""Format and version of a file of transitions."""
SHARD = 16_384
"""Largest number of transitions per file."""
FULL = MOST_BYTES // 2
"""Size of a file that is not exceeded, if transitions are so large that fewer fit [bytes]."""


class Replay:
    """TorchRL's uniform replay buffer of the newest `capacity` transitions, stored in immutable files.

    Transition k (counted from the start of the run) is in slot k mod capacity and in shard k // shard. A file
    holds those transitions of one shard that the buffer has, is named after the first and the end, and never
    changes; a checkpoint keeps the total, from which the files follow, so only the oldest and the newest
    shard are written anew. Files of older checkpoints are removed only after the newer checkpoint is in
    place, so that every checkpoint on disk is complete.

    Args:
        capacity: transitions.
        batch: transitions of a sample.
        size: of a transition [bytes], at most; files of large ones hold fewer.
    """

    def __init__(self, capacity: int, batch: int, size: int = 1):
        self.capacity, self.added = capacity, 0
        self.shard = min(SHARD, max(FULL // size, 1))
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(capacity), sampler=RandomSampler(), batch_size=batch
        )

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def extend(self, transitions: TensorDict) -> None:
        """Append transitions (B,)."""
        self.buffer.extend(transitions)
        self.added += len(transitions)

    def sample(self) -> TensorDict:
        """A batch of transitions drawn uniformly."""
        return self.buffer.sample()  # pyright: ignore[reportReturnType]

    def save(self, folder: Path, run: str = "") -> None:
        """Write the shards that are not on disk yet.

        Args:
            folder: of the files.
            run: digest of the settings of the run, which the files hold.

        Raises:
            InputError: if the disk is full.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for name, first, end in self._shards():
            path = folder / name
            if not path.exists():
                rows = torch.arange(first, end) % self.capacity
                data = self.buffer.storage[rows].flatten_keys("/").to_dict()
                write_safetensors(path, data, _header(first, end, run))

    def forget_old_files(self, folder: Path) -> None:
        """Remove shards that the present state does not need."""
        needed = {name for name, _, _ in self._shards()}
        for path in folder.glob("*.safetensors"):
            if path.name not in needed:
                path.unlink()

    def load(self, folder: Path, run: str = "") -> None:
        """Fill the buffer from the shards of the state `added`.

        Raises:
            InputError: if a shard is missing, damaged, or of another run or another place in it.
        """
        columns: dict[str, tuple[torch.dtype, torch.Size]] = {}
        for name, first, end in self._shards():
            required = {key: (value,) for key, value in _header(first, end, run).items()}
            try:
                data, _ = read_safetensors(folder / name, "replay file", required)
            except InputError as error:
                raise InputError(f"The replay buffer cannot be read, and so the run not be resumed: {error}") from error
            found = {key: (value.dtype, value.shape[1:]) for key, value in data.items()}
            columns = columns or found
            if found != columns or any(value.shape[:1] != (end - first,) for value in data.values()) or not data:
                raise InputError(f"The replay file {folder / name} does not fit the others: the run cannot be resumed.")
            shard = TensorDict(data, batch_size=[end - first]).unflatten_keys("/")
            slots = torch.arange(first, end) % self.capacity
            self.buffer.storage.set(slots, shard)  # pyright: ignore[reportArgumentType]
        self.buffer.writer.load_state_dict({"_cursor": self.added % self.capacity})

    def _shards(self) -> list[tuple[str, int, int]]:
        """File name, first transition and end of every shard of the buffer."""
        shards = []
        first = self.added - len(self)
        while first < self.added:
            end = min((first // self.shard + 1) * self.shard, self.added)
            shards.append((f"{first:010d}-{end:010d}.safetensors", first, end))
            first = end
        return shards


def _header(first: int, end: int, run: str) -> dict[str, str]:
    """Header of the file of the transitions from `first` to before `end` of a run."""
    return {"format": FORMAT, "transitions": f"{first}-{end}", "run": run}
