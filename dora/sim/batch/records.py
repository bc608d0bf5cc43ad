"""Files with the last states of environments whose simulation became bad."""

import io
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mani_skill import logger

from dora.errors import RECORDS, InputError
from dora.files import write_bytes
from dora.sim.batch.packed import POSE_FLOATS, POSE_ORDER

FOLDER = "dora-nonfinite"
"""Name of the folder of the files among temporary files, unless the environment variable `RECORDS` names another."""
MOST = 4
"""Files that one scene writes at most [1]."""
MOST_IN_FOLDER = 16
"""Files in the folder at most [1]; the oldest are removed."""


@dataclass(frozen=True)
class Record:
    """What is written about one environment: states before each of the last control steps, then the bad one.

    environment: its index.
    states, poses: as SAPIEN packs them, in order of time.
    actions: of all environments, one per control step; None where it was no array.
    entities: names of the entities, in the order of `poses`.
    """

    environment: int
    states: Sequence[bytes]
    poses: Sequence[bytes]
    actions: Sequence[Any]
    entities: Sequence[str]

    def arrays(self) -> dict[str, np.ndarray]:
        """What the file holds: `environment`; `entities` (e,) names; `poses` (k, e, 7) position [m] and quaternion wxyz
        in the world frame; `states` (k, s) as `PhysxCpuSystem.pack` orders them; `actions` (k - 1, a), NaN where
        unknown."""
        poses = np.stack([np.frombuffer(p, np.float32).reshape(-1, POSE_FLOATS)[:, POSE_ORDER] for p in self.poses])
        states = np.stack([np.frombuffer(s, np.float32) for s in self.states])
        rows = [_row(action, self.environment) for action in self.actions]
        width = max((row.size for row in rows), default=0)
        actions = np.full((len(rows), width), np.nan, np.float32)
        for k, row in enumerate(rows):
            actions[k, : row.size] = row
        names = np.array(list(self.entities), dtype=str)
        return dict(environment=np.array(self.environment), entities=names, poses=poses, states=states, actions=actions)


def _row(action: Any, environment: int) -> np.ndarray:
    """One environment's part of an action, flat; empty if it is no array of all environments."""
    if not isinstance(action, np.ndarray | torch.Tensor) or action.ndim < 2 or len(action) <= environment:
        return np.zeros(0, np.float32)
    with np.errstate(over="ignore"):
        return np.asarray(torch.as_tensor(action[environment]).detach().cpu(), np.float32).ravel()


class StateRecorder:
    """Writes at most `MOST` files, tells the first one's path, and never raises."""

    def __init__(self) -> None:
        self._written = 0

    @property
    def full(self) -> bool:
        """Whether no more files are written."""
        return self._written >= MOST

    def write(self, record: Record) -> None:
        """Write a record into the folder, as `<process>-<number>.npz`; what goes wrong is logged."""
        self._written += 1
        folder = Path(os.environ.get(RECORDS) or Path(tempfile.gettempdir()) / FOLDER)
        said = f"The simulation of environment {record.environment} is not finite or blew up: it was put back and its"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"{os.getpid()}-{_next_number()}.npz"
            stream = io.BytesIO()
            np.savez_compressed(stream, **record.arrays())  # pyright: ignore[reportArgumentType]
            write_bytes(path, stream.getvalue())
            _remove_oldest(folder)
        except (OSError, InputError, ValueError) as error:
            logger.warning(f"{said} episode ended; its last states could not be written to {folder} ({error}).")
            return
        if self._written == 1:
            logger.warning(f"{said} episode ended; its last states are in {path}. Further ones are only counted.")


_numbers = iter(range(10**9))


def _next_number() -> int:
    """Numbers of files of this process."""
    return next(_numbers)


def _remove_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*-*.npz"), key=lambda path: path.stat().st_mtime)
    for path in files[:-MOST_IN_FOLDER]:
        path.unlink(missing_ok=True)
