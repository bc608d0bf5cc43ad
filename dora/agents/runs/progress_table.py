"""`progress.csv` of a run folder: a row per iteration of training, appended at once and mended after a crash."""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from dora.agents.collecting.task_env import EpisodeColumns
from dora.agents.runs.stored_results import LARGEST, MOST_COLUMNS, MOST_ROWS, MOST_TABLE
from dora.errors import InputError
from dora.files import write_bytes
from dora.reading import read_bytes

COLUMNS = ("env_steps", "seconds", "episodes", "success_rate", "raw_success_rate", "return_mean", "penetration_mm")
"""First columns; those of the stages follow. Rates and means are over the episodes that ended in the iteration."""
RENAMED = {
    "success": "success_rate",
    "raw_success": "raw_success_rate",
    "success_at_end": "success_at_end_rate",
    "return": "return_mean",
    "length": "length_mean",
}
"""Names of the means of the columns of episodes."""
MOST_RESUMED = 2**28
"""Size of a table above which its run is not gone on with [bytes]."""
STAGE = "stage/"
"""Beginning of the name of a stage's column."""


def means_of(ended: Float[Tensor, "e k"], columns: EpisodeColumns) -> dict[str, float]:
    """Means over the episodes that ended, by the names that they have in the table and the logs; none of none.

    Args:
        ended: a row for each episode.
        columns: of these rows.
    """
    names = [name for name in columns.names if name != "whole"] if len(ended) else []
    return {RENAMED.get(name, name): float(columns.column(ended, name).mean()) for name in names}


def read_progress(path: Path) -> dict[str, Float[np.ndarray, " rows"]]:
    """Columns of the table by name, NaN where a cell is empty. A row that was being written when its run was killed is
    left out, with all that follow it.

    Raises:
        InputError: it is too large, or its first line is damaged.
    """
    header, rows = _whole_rows(path, MOST_TABLE)
    if len(header) > MOST_COLUMNS or len(rows) > MOST_ROWS:
        raise InputError(f"{path} has {len(header)} columns and {len(rows)} rows, more than a report reads: remove it.")
    if not set(COLUMNS) <= set(header) or len(set(header)) < len(header):
        raise InputError(f"{path} is damaged (its first line lacks a column, or has one twice): remove it.")
    values = np.array([[float(cell or "nan") for cell in row] for row in rows]).reshape(len(rows), len(header))
    return {name: values[:, k] for k, name in enumerate(header)}


def _whole_rows(path: Path, most: int) -> tuple[list[str], list[list[str]]]:
    """Header and rows as text, up to the first row that is damaged, of a file of at most `most` bytes."""
    content = read_bytes(path, "progress.csv", most).decode("utf-8", "replace")
    lines = content.split("\n")[:-1]  # what no line break ends is torn
    header = lines[0].split(",") if lines else []
    rows = []
    for line in lines[1:]:
        cells = line.split(",")
        if len(cells) != len(header) or not cells[0] or not all(map(_is_cell, cells)):
            break
        rows.append(cells)
    return header, rows


def _is_cell(text: str) -> bool:
    try:
        return not abs(float(text or "nan")) >= LARGEST
    except ValueError:
        return False


class ProgressTable:
    """Appends rows to `progress.csv`; each is in the file when `add` returns.

    Args:
        path: of the file.
        stages: names of the stages.
        env_steps: environment steps with which the run begins or goes on; rows beyond them are dropped.

    Raises:
        InputError: if the file cannot be written.
    """

    def __init__(self, path: Path, stages: Sequence[str], env_steps: int = 0):
        self.path, self.columns = path, [*COLUMNS, *(STAGE + name for name in stages)]
        header, rows = _whole_rows(path, MOST_RESUMED) if env_steps > 0 and path.exists() else ([], [])
        kept = [row for row in rows if float(row[0]) <= env_steps] if header == self.columns else []
        write_bytes(path, "".join(f"{','.join(row)}\n" for row in (self.columns, *kept)).encode())

    def add(self, values: Mapping[str, int | float]) -> None:
        """Append a row; columns without a finite value stay empty.

        Raises:
            InputError: the disk is full; what is torn by it is dropped when the run goes on.
        """
        row = ",".join(_text(values.get(name)) for name in self.columns)
        try:
            descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND)
            try:
                os.write(descriptor, f"{row}\n".encode())
            finally:
                os.close(descriptor)
        except OSError as error:
            raise InputError(f"Cannot write {self.path} ({error.strerror}): free some space and --resume.") from error


def _text(value: int | float | None) -> str:
    """Whole numbers in full, others with six digits, and nothing for NaN and infinity."""
    if value is None or not math.isfinite(value):
        return ""
    return str(int(value)) if value == int(value) else f"{value:.6g}"
