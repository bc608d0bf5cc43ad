"""What `result.json` and the tables of a run folder may hold, for those who read them: names, types and ranges."""

import csv
import hashlib
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dora.digests import SEAL, is_whole, sealed
from dora.errors import InputError, shown
from dora.reading import read_json, read_text

MOST_RESULT, MOST_TABLE = 1_000_000, 16_000_000
"""Size of a result.json and of a table above which it is not read [bytes]."""
MOST_ROWS, MOST_CURVE, MOST_EPISODES = 200_000, 20_000, 20_000
"""Largest number of rows of a progress.csv, of a curve.csv, and of an eval.csv [1]."""
MOST_COLUMNS, LONGEST_NAME, LONGEST_PATH = 1000, 200, 4096
"""Largest number of columns of a table, and of characters of a text and of a path [1]."""
PIECE = 2**20
"""Size of the pieces in which a table's digest is computed [bytes]."""
NO_CORRECTION = "zero"
"""Agent of a result of zero correction alone."""
ROUNDING = 1e-4
"""Largest difference of a share that is written twice [1]."""
LARGEST = 1e12
"""Every number is smaller."""
CURVE_COLUMNS = ("env_steps", "wall_seconds", "success_rate", "return_mean", "penetration_p95_mm")
"""Columns of a learning curve that a report reads."""
RISING = ("env_steps", "wall_seconds")
"""Those that never fall from row to row."""
EPISODE_COLUMNS = ("episode", "success")
"""Columns that an eval.csv has at least."""
TABLES = ("curve.csv", "progress.csv", "eval.csv", "zero.csv")
"""Tables of a run folder of which the result holds the digests."""
OF_TABLES = "table_digests"
"""Entry of a result with these digests by the table's name."""
REQUIRED = {
    "env": "text", "agent": "text", "guidance": "text", "env_steps": "count", "wall_seconds": "amount",
    "success_rate": "share", "zero_success_rate": "share or none", "penetration_p95_mm": "amount or none",
}  # fmt: skip
"""Entries of the result of a finished run, and what they are."""
OPTIONAL = {
    "preset": "text", "guidance_parts": "texts or none", "reward": "text", "checkpoint": "path or none",
    "eval_episodes": "count", "total_steps": "count", "first_seed": "count or none", "task": "mapping",
    "other_load": "amount or none", "raw_success_rate": "share or none", "steps_to_80": "count or none",
    "stage_rates": "shares", "seed": "count", "task_config": "mapping or none", "learner_config": "mapping or none",
    "training_config": "mapping or none", "num_envs": "count or none", "workers": "count or none",
    "policy_seed": "count or none", "policy_digest": "text or none",
    "overlap_share": "share", "config_digest": "text", OF_TABLES: "mapping", SEAL: "text",
}  # fmt: skip
"""The same of entries that results of some versions have."""
NESTED = {"preset": "text", "guidance_parts": "texts or none"}
"""The same of entries of `task`, where the first version put them."""
WORDS = {
    "text": f"a text of 1 to {LONGEST_NAME} characters", "path": f"a text of 1 to {LONGEST_PATH} characters",
    "texts": "a list of texts", "mapping": "a mapping",
    "shares": "a mapping of names to numbers from 0 to 1", "share": "a number from 0 to 1",
    "count": "a whole number of at least 0", "amount": f"a number from 0 to {LARGEST:g}",
}  # fmt: skip
"""How messages say what an entry has to be."""


def _fits(value: Any, kind: str) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST
    return {
        "text": lambda: isinstance(value, str) and 0 < len(value) <= LONGEST_NAME,
        "path": lambda: isinstance(value, str) and 0 < len(value) <= LONGEST_PATH,
        "texts": lambda: isinstance(value, list) and len(value) < MOST_COLUMNS and all(_fits(v, "text") for v in value),
        "mapping": lambda: isinstance(value, dict),
        "shares": lambda: (
            isinstance(value, dict)
            and len(value) < MOST_COLUMNS
            and all(_fits(name, "text") and _fits(share, "share") for name, share in value.items())
        ),
        "share": lambda: number and 0 <= value <= 1,
        "count": lambda: number and isinstance(value, int) and value >= 0,
        "amount": lambda: number and value >= 0,
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


def with_digests(result: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A result with digests of the tables that lie in its folder now and of itself, which `read_result` compares."""
    tables = {name: _table_digest(folder / name) for name in TABLES if (folder / name).is_file()}
    return sealed({**result, OF_TABLES: tables})


def _table_digest(path: Path) -> str:
    """sha256 of a table of any size, the same whichever line ends a tool has given it."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(PIECE):
            digest.update(piece.replace(b"\r", b""))
    return digest.hexdigest()


def _check_digests(result: dict[str, Any], path: Path) -> None:
    """Refuse a result that has digests (those of earlier versions have none) and differs from them."""
    if (SEAL in result or OF_TABLES in result) and not is_whole(result):
        raise InputError(f"{path} is damaged (its digest differs); repeat the run or remove its folder.")
    if result.get("finished"):  # else the tables go on
        for table in (path.with_name(name) for name in TABLES if OF_TABLES in result):
            digest = result[OF_TABLES].get(table.name)
            if table.is_file() and table.stat().st_size <= MOST_TABLE and _table_digest(table) != digest:
                raise _damaged(table, "its digest in result.json differs" if digest else "result.json does not know it")


def read_result(path: Path) -> dict[str, Any] | None:
    """Content of the result.json of a finished run; None of one that did not finish.

    Raises:
        InputError: it is too large, no JSON, lacks an entry or has one of another type or out of range, or it or a
            table beside it was changed after it was written.
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
        _check_digests(result, path)
        return None
    _check(result, REQUIRED, path, required=True)
    _check(result, OPTIONAL, path, required=False)
    _check(result.get("task", {}), NESTED, path, required=False)
    _check_digests(result, path)
    return result


def read_curve(path: Path) -> list[dict[str, float]]:
    """Rows of a curve.csv with the columns of `CURVE_COLUMNS`; NaN is a value that was not measured.

    Raises:
        InputError: it is too large, no table, lacks a column, or has a cell that is no number or out of range.
    """
    columns = _read_table(path, CURVE_COLUMNS, MOST_CURVE)
    rows: list[dict[str, float]] = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    earlier = dict.fromkeys(RISING, 0.0)
    for line, row in enumerate(rows, 2):
        if not all(row[name] >= earlier[name] for name in RISING):
            raise _damaged(path, f"line {line} has steps or seconds out of range, or fewer than the line before")
        if row["success_rate"] < 0 or row["success_rate"] > 1 or row["penetration_p95_mm"] < 0:
            raise _damaged(path, f"line {line} has a success rate that is not from 0 to 1, or a negative depth")
        earlier = row
    return rows


def read_episodes(path: Path) -> dict[str, list[float]]:
    """Columns of an eval.csv or a zero.csv, a value for each episode.

    Raises:
        InputError: it is too large, no table, has no row, lacks a column, has a cell that is no number or a success
            but 0 or 1, or its episodes are not in their order: tables are compared row by row.
    """
    columns = _read_table(path, EPISODE_COLUMNS, MOST_EPISODES, all_columns=True)
    if not columns["success"]:
        raise _damaged(path, "it has no episode")
    if not all(value in (0.0, 1.0) for value in columns["success"]):
        raise _damaged(path, "success is not 0 or 1 everywhere")
    if columns["episode"] != list(range(len(columns["episode"]))):
        raise _damaged(path, "its episodes are not 0, 1, 2, ... from line to line")
    if unknown := [name for name, values in columns.items() if any(map(math.isnan, values))]:
        raise _damaged(path, f"{unknown[0]} is no number somewhere")
    return columns


def check_agreement(path: Path, episodes: dict[str, list[float]], share: float | None, count: int | None) -> None:
    """Refuse a table of episodes that are not those of the result beside it.

    Args:
        path: of the table.
        episodes: its columns, as of `read_episodes`.
        share: successes among them, and
        count: their number, as the result says; None if it does not.

    Raises:
        InputError: they differ.
    """
    successes = episodes["success"]
    if count is not None and len(successes) != count:
        raise _damaged(path, f"it has {len(successes)} episodes, and result.json says {count}")
    if share is not None and successes and abs(sum(successes) / len(successes) - share) > ROUNDING:
        found = sum(successes) / len(successes)
        raise _damaged(path, f"a share of {found:.4g} are successes, and result.json says {share:.4g}")


def _damaged(path: Path, reason: object) -> InputError:
    return InputError(f"{path} is damaged ({reason}); remove it, or repeat the run.")


def _read_table(path: Path, needed: tuple[str, ...], most: int, all_columns: bool = False) -> dict[str, list[float]]:
    """Columns of a table of numbers by name: those that are needed, or all.

    Raises:
        InputError: as of `read_curve`.
    """
    text = read_text(path, path.name, MOST_TABLE)
    try:
        lines = csv.reader(io.StringIO(text), strict=True)
        header = next(lines, [])
        if len(header) > MOST_COLUMNS or len(set(header)) < len(header) or not set(needed) <= set(header):
            raise ValueError("it lacks a column, or has one twice")
        if any(len(name) > LONGEST_NAME for name in header):
            raise ValueError(f"a column has a name of more than {LONGEST_NAME} characters")
        names = tuple(header) if all_columns else needed
        at, columns = [header.index(name) for name in names], {name: list[float]() for name in names}
        for count, line in enumerate(lines, 1):
            if len(line) != len(header):
                raise ValueError(f"line {lines.line_num} has {len(line)} cells and not {len(header)}")
            for name, k in zip(names, at, strict=True):
                columns[name].append(float(line[k]))
                if abs(columns[name][-1]) >= LARGEST:
                    raise ValueError(f"line {lines.line_num} has a number out of range")
            if count > most:
                raise ValueError(f"it has more than {most} rows")
    except (ValueError, csv.Error) as error:
        raise _damaged(path, error) from error
    return columns
