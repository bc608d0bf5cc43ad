"""What `result.json` and the tables of a run folder may hold, for those who read them: names, types and ranges."""

import csv
import io
from pathlib import Path
from typing import Any

from dora.errors import InputError, shown
from dora.reading import read_json, read_text

MOST_RESULT, MOST_TABLE = 1_000_000, 16_000_000
"""Size of a result.json and of a table above which it is not read [bytes]."""
MOST_ROWS, MOST_CURVE = 200_000, 20_000
"""Largest number of rows of a progress.csv and of a curve.csv [1]."""
MOST_COLUMNS, LONGEST_NAME = 1000, 200
"""Largest number of columns of a table, and of characters of a text [1]."""
LARGEST = 1e12
"""Every number is smaller."""
CURVE_COLUMNS = ("env_steps", "wall_seconds", "success_rate", "return_mean", "penetration_p95_mm")
"""Columns of a learning curve that a report reads."""
REQUIRED = {
    "env": "text", "agent": "text", "guidance": "text", "env_steps": "count", "wall_seconds": "number",
    "success_rate": "share", "zero_success_rate": "share or none", "penetration_p95_mm": "number or none",
}  # fmt: skip
"""Entries of the result of a finished run, and what they are."""
OPTIONAL = {
    "preset": "text", "guidance_parts": "texts or none", "reward": "text", "checkpoint": "text or none",
    "eval_episodes": "count", "total_steps": "count", "first_seed": "count or none", "task": "mapping",
    "other_load": "number or none",
}  # fmt: skip
"""The same of entries that results of some versions have."""
NESTED = {"preset": "text", "guidance_parts": "texts or none"}
"""The same of entries of `task`, where the first version put them."""
WORDS = {
    "text": f"a text of 1 to {LONGEST_NAME} characters", "texts": "a list of texts", "mapping": "a mapping",
    "share": "a number from 0 to 1", "count": "a whole number of at least 0", "number": f"a number below {LARGEST:g}",
}  # fmt: skip
"""How messages say what an entry has to be."""


def _fits(value: Any, kind: str) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST
    return {
        "text": lambda: isinstance(value, str) and 0 < len(value) <= LONGEST_NAME,
        "texts": lambda: isinstance(value, list) and len(value) < MOST_COLUMNS and all(_fits(v, "text") for v in value),
        "mapping": lambda: isinstance(value, dict),
        "share": lambda: number and 0 <= value <= 1,
        "count": lambda: number and isinstance(value, int) and value >= 0,
        "number": lambda: number,
    }[kind]()


def _check(content: dict[str, Any], entries: dict[str, str], path: Path, required: bool) -> None:
    for name, wanted in entries.items():
        kind, _, none = wanted.partition(" or ")
        if name not in content and not required:
            continue
        value = content.get(name)
        if (name in content and none and value is None) or (name in content and _fits(value, kind)):
            continue
        found = shown(value) if name in content else "missing"
        raise InputError(
            f"{path} is damaged ({name} is {found}, and has to be {WORDS[kind]}); repeat the run or remove its folder."
        )


def read_result(path: Path) -> dict[str, Any] | None:
    """Content of the result.json of a finished run; None of one that did not finish.

    Raises:
        InputError: it is too large, no JSON, or lacks an entry or has one of another type or out of range.
    """
    try:
        result = read_json(path, "result.json", MOST_RESULT)
    except InputError as error:
        reason = str(error).rstrip(".").removeprefix(f"{path} ")
        raise InputError(f"{path} is damaged ({reason}); repeat the run or remove its folder.") from error
    if not isinstance(result, dict):
        raise InputError(f"{path} is damaged (it is no mapping); repeat the run or remove its folder.")
    finished = result.get("finished", False)
    if not isinstance(finished, bool):
        raise InputError(f"{path} is damaged (finished is {shown(finished)}); repeat the run or remove its folder.")
    if not finished:
        return None
    _check(result, REQUIRED, path, required=True)
    _check(result, OPTIONAL, path, required=False)
    _check(result.get("task", {}), NESTED, path, required=False)
    return result


def read_curve(path: Path) -> list[dict[str, float]]:
    """Rows of a curve.csv with the columns of `CURVE_COLUMNS`; NaN is a value that was not measured.

    Raises:
        InputError: it is too large, no table, or lacks a column or has a cell that is no number.
    """
    text = read_text(path, "curve.csv", MOST_TABLE)
    rows = []
    try:
        lines = csv.reader(io.StringIO(text), strict=True)
        header = next(lines, [])
        if len(header) > MOST_COLUMNS or len(set(header)) < len(header) or not set(CURVE_COLUMNS) <= set(header):
            raise ValueError("it lacks a column, or has one twice")
        at = [header.index(name) for name in CURVE_COLUMNS]
        for line in lines:
            if len(line) != len(header):
                raise ValueError(f"line {lines.line_num} has {len(line)} cells and not {len(header)}")
            row = dict(zip(CURVE_COLUMNS, (float(line[k]) for k in at), strict=True))
            if not (0 <= row["env_steps"] < LARGEST and 0 <= row["wall_seconds"] < LARGEST):
                raise ValueError(f"line {lines.line_num} has steps or seconds out of range")
            if any(abs(value) >= LARGEST for value in row.values()):
                raise ValueError(f"line {lines.line_num} has a number out of range")
            rows.append(row)
            if len(rows) > MOST_CURVE:
                raise ValueError(f"it has more than {MOST_CURVE} rows")
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path} is damaged ({error}); remove it, or repeat the run.") from error
    return rows
