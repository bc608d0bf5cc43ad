"""Files with the last states of environments whose simulation became bad."""

import io
import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from mani_skill import logger

from dora.arguments import as_tensor
from dora.errors import RECORDS
from dora.files import write_bytes
from dora.sim.batch.packed import POSE_FLOATS, POSE_ORDER

FOLDER = "dora-nonfinite"
"""Name of the folder of the files among temporary files, unless the environment variable `RECORDS` names another."""
MOST = 4
"""Files that one scene writes at most [1]."""
MOST_IN_FOLDER = 16
"""Files in the folder at most [1]; the oldest are removed."""
OURS = re.compile(r"\d+-\d+\.npz")
"""Names of these files, `<process>-<number>.npz`; whatever else is in the folder stays."""


@dataclass(frozen=True)
class Record:
    """What is written about one environment: states before each of the last control steps, then the bad one.

    environment: its index.
    states, poses: as SAPIEN packs them, in order of time.
    actions: its rows (a,), one per control step; None where there was none.
    entities: names of the entities, in the order of `poses`.
    """

    environment: int
    states: Sequence[bytes]
    poses: Sequence[bytes]
    actions: Sequence[np.ndarray | None]
    entities: Sequence[str]

    def arrays(self) -> dict[str, np.ndarray]:
        """What the file holds: `environment`; `entities` (e,) names; `poses` (k, e, 7) position [m] and quaternion wxyz
        in the world frame; `states` (k, s) as `PhysxCpuSystem.pack` orders them; `actions` (k - 1, a), NaN where
        unknown."""
        poses = np.stack([np.frombuffer(p, np.float32).reshape(-1, POSE_FLOATS)[:, POSE_ORDER] for p in self.poses])
        states = np.stack([np.frombuffer(s, np.float32) for s in self.states])
        rows = [np.zeros(0, np.float32) if action is None else action for action in self.actions]
        width = max((row.size for row in rows), default=0)
        actions = np.full((len(rows), width), np.nan, np.float32)
        for k, row in enumerate(rows):
            actions[k, : row.size] = row
        names = np.array(list(self.entities), dtype=str)
        return dict(environment=np.array(self.environment), entities=names, poses=poses, states=states, actions=actions)


def action_rows(action: Any, environments: int) -> Float[np.ndarray, "n a"] | None:
    """A copy of an action as a record holds it: a flat row for each environment; None if it is none, or has no rows.

    Parts of a dictionary by robot come one after the other in the order of their names.
    """
    try:
        if action is None:
            return None
        if isinstance(action, Mapping):
            names = ["action"] if "control_mode" in action else sorted(action)
            parts = [as_tensor(action[name], "The action") for name in names]
        else:
            parts = [as_tensor(action, "The action")]
        rows = [part.float().reshape(environments, -1).numpy(force=True) for part in parts]
        return np.concatenate(rows, 1)
    except Exception:  # a record without actions is better than none
        return None


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
        said = f"The simulation of environment {record.environment} is not finite or blew up: it was put back and its"
        folder = os.environ.get(RECORDS)
        try:
            folder = Path(folder or Path(tempfile.gettempdir()) / FOLDER)
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"{os.getpid()}-{_next_number()}.npz"
            stream = io.BytesIO()
            np.savez_compressed(stream, **record.arrays())  # pyright: ignore[reportArgumentType]
            write_bytes(path, stream.getvalue())
            _remove_oldest(folder)
        except Exception as error:  # whatever it is, the simulation goes on
            where = folder or "temporary files"
            logger.warning(f"{said} episode ended; its last states could not be written to {where} ({error}).")
            return
        if self._written == 1:
            logger.warning(f"{said} episode ended; its last states are in {path}. Further ones are only counted.")


_numbers = iter(range(10**9))


def _next_number() -> int:
    """Numbers of files of this process."""
    return next(_numbers)


def _remove_oldest(folder: Path) -> None:
    ours = (path for path in folder.glob("*-*.npz") if OURS.fullmatch(path.name))
    files = sorted(ours, key=lambda path: path.stat().st_mtime)
    for path in files[:-MOST_IN_FOLDER]:
        path.unlink(missing_ok=True)
