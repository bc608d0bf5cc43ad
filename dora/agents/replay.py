"""Replay buffer whose files grow with it, so that saving a checkpoint stays cheap."""

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler

from dora.agents.files import write_bytes
from dora.errors import InputError

SHARD = 16_384  # transitions per file


class Replay:
    """TorchRL's uniform replay buffer of the newest `capacity` transitions, stored in immutable shards.

    Transition k (counted from the start of the run) is in slot k mod capacity and in shard k // SHARD.
    A shard's file is named after its number and the number of transitions in it, and never changes; a
    checkpoint names the total, from which the files follow. Files of older checkpoints are removed only after
    the newer checkpoint is in place, so that every checkpoint on disk is complete.
    """

    def __init__(self, capacity: int, batch: int):
        self.capacity, self.added = capacity, 0
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
        return self.buffer.sample()

    def save(self, folder: Path) -> None:
        """Write the shards that are not on disk yet.

        Raises:
            InputError: if the disk is full.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for name, first, end in self._shards():
            path = folder / name
            if not path.exists():
                rows = torch.arange(first, end) % self.capacity
                data = self.buffer.storage[rows].flatten_keys("/").to_dict()
                write_bytes(path, save({key: value.contiguous() for key, value in data.items()}))

    def forget_old_files(self, folder: Path) -> None:
        """Remove shards that the present state does not need."""
        needed = {name for name, _, _ in self._shards()}
        for path in folder.glob("*.safetensors"):
            if path.name not in needed:
                path.unlink()

    def load(self, folder: Path) -> None:
        """Fill the buffer from the shards of the state `added`.

        Raises:
            InputError: if a shard is missing or damaged.
        """
        for name, first, end in self._shards():
            try:
                data = load_file(folder / name)
            except (OSError, SafetensorError) as error:
                raise InputError(
                    f"The replay buffer {folder / name} is missing or damaged: the run cannot be resumed."
                ) from error
            shard = TensorDict(data, batch_size=[end - first]).unflatten_keys("/")
            self.buffer.storage.set(torch.arange(first, end) % self.capacity, shard)
        self.buffer.writer.load_state_dict({"_cursor": self.added % self.capacity})

    def _shards(self) -> list[tuple[str, int, int]]:
        """File name, first transition and end of every shard of the buffer."""
        oldest = self.added - len(self)
        first_shard = -(-oldest // SHARD)  # a shard that is partly overwritten is dropped as a whole
        first_shard = first_shard if oldest else 0
        shards = []
        for first in range(first_shard * SHARD, self.added, SHARD):
            end = min(first + SHARD, self.added)
            shards.append((f"{first // SHARD:06d}-{end - first:05d}.safetensors", first, end))
        return shards
