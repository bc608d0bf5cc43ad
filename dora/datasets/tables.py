"""Parquet tables by pyarrow: frames of many episodes over files of bounded size, and small tables of dictionaries."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dora.errors import InputError

MEGABYTE = 2**20
"""Bytes of a megabyte as the format counts them [bytes]."""


def require_pyarrow() -> Any:
    """pyarrow with `pyarrow.parquet`.

    Raises:
        InputError: it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise InputError(
            "A LeRobot dataset needs pyarrow, which is not installed: pip install 'pyarrow>=21'."
        ) from error
    return pyarrow


class EpisodeTable:
    """A table of frames in files `chunk-...`/`file-...`, a row group for each episode.

    Args:
        folder: of the dataset.
        template: place of a file, with `chunk_index` and `file_index`.
        files_per_chunk: files in one folder.
        size: above which a further file is begun [MB of 2^20 bytes].
    """

    def __init__(self, folder: Path, template: str, files_per_chunk: int, size: int | float):
        self.folder, self.template, self.files_per_chunk, self.size = folder, template, files_per_chunk, size
        self._number, self._path, self._writer = 0, folder, None

    def add(self, columns: Mapping[str, np.ndarray]) -> tuple[int, int]:
        """Append the frames of an episode; the numbers of the chunk and of the file where they are."""
        pyarrow = require_pyarrow()
        table = pyarrow.table({name: _column(values) for name, values in columns.items()})
        if self._writer is not None and self._path.stat().st_size > self.size * MEGABYTE:
            self.close()
            self._number += 1
        chunk, file = divmod(self._number, self.files_per_chunk)
        if self._writer is None:
            self._path = self.folder / self.template.format(chunk_index=chunk, file_index=file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pyarrow.parquet.ParquetWriter(self._path, table.schema)
        self._writer.write_table(table)
        return chunk, file

    def close(self) -> None:
        """Finish the file that is being written."""
        if self._writer is not None:
            self._writer.close()
        self._writer = None


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], index: str | None = None) -> None:
    """Write a table with a row for each dictionary.

    Args:
        path: of the file; its folder is made.
        rows: values by name of the column.
        index: column that pandas reads as the index of its rows.
    """
    pyarrow = require_pyarrow()
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pyarrow.Table.from_pylist([dict(row) for row in rows])
    if index is not None:
        table = table.replace_schema_metadata({"pandas": json.dumps(_pandas(table, index))})
    pyarrow.parquet.write_table(table, path)


def _pandas(table: Any, index: str) -> dict[str, Any]:
    """What pandas has to know of a table to take one of its columns as the index."""
    columns = [
        {
            "name": field.name,
            "field_name": field.name,
            "pandas_type": _kind(field.type),
            "numpy_type": _kind(field.type),
        }
        for field in table.schema
    ]
    return {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": None}


def _kind(arrow: Any) -> str:
    return "unicode" if str(arrow) == "string" else str(arrow)


def _column(values: np.ndarray) -> Any:
    """A column of numbers, or of vectors of fixed size."""
    pyarrow = require_pyarrow()
    if values.ndim == 1:
        return pyarrow.array(values)
    return pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(values.reshape(-1)), values.shape[1])
