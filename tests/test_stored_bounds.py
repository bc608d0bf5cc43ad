"""The largest and smallest that results and tables of a run folder may hold, and what is beyond."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from dora.agents.runs import progress_table
from dora.agents.runs.progress_table import COLUMNS, ProgressTable, read_progress
from dora.agents.runs.stored_results import check_agreement, read_curve, read_episodes, read_result
from dora.errors import InputError

NAN = float("nan")
BASE: dict[str, Any] = {
    "env": "Toy-v1", "agent": "ppo", "guidance": "affordance", "env_steps": 1000, "wall_seconds": 90.0,
    "success_rate": 0.5, "zero_success_rate": None, "penetration_p95_mm": None, "finished": True,
}  # fmt: skip
CURVE = "env_steps,wall_seconds,success_rate,return_mean,penetration_p95_mm\n"

# ------------------------------------------------------------------ results and tables


@pytest.mark.parametrize(
    ("name", "fits", "wrong"),
    [
        ("env", ["x", "x" * 200], ["", "x" * 201, 3, None]),
        ("checkpoint", ["x", "x" * 4096, None], ["", "x" * 4097, 3]),
        ("guidance_parts", [[], ["x"], ["x"] * 999, None], [["x"] * 1000, ["x", ""], "x", {}]),
        ("task_config", [{}, {"a": 1}, None], [[], "x"]),
        ("task", [{}], [None, []]),
        ("stage_rates", [{}, {"x": 0, "y": 1.0}, {str(k): 0.5 for k in range(999)}],
         [{"x": 1.5}, {"": 0.5}, {"x": 0.5, "y": "1"}, {str(k): 0.5 for k in range(1000)}, [0.5], None]),
        ("success_rate", [0, 1, 0.25], [-0.01, 1.01, 2, NAN, None, True, "1"]),
        ("zero_success_rate", [0, 1, None], [-0.01, 1.01, True]),
        ("env_steps", [0, 1, 10**12 - 1], [-1, 1.5, 10**12, True, None]),
        ("seed", [0, 1], [-1, 0.0, None]),
        ("wall_seconds", [0, 0.5], [-0.5, 1e12, NAN, True]),
        ("penetration_p95_mm", [0.0, 3, None], [-0.5, 1e12]),
        ("other_load", [0.0, None], [-0.5]),
    ],
)  # fmt: skip
def test_an_entry_of_a_result_is_read_up_to_its_bound(tmp_path: Path, name: str, fits: list[Any], wrong: list[Any]):
    path = tmp_path / "result.json"
    for value in fits:
        path.write_text(json.dumps(BASE | {name: value}))
        found = read_result(path)
        assert found is not None
        assert found[name] == value
    for value in wrong:
        path.write_text(json.dumps(BASE | {name: value}))
        with pytest.raises(InputError, match=rf"damaged \({name} is "):
            read_result(path)


@pytest.mark.parametrize("name", [name for name in BASE if name != "finished"])
def test_a_result_has_all_that_are_needed(tmp_path: Path, name: str):
    (tmp_path / "result.json").write_text(json.dumps({key: value for key, value in BASE.items() if key != name}))
    with pytest.raises(InputError, match=rf"damaged \({name} is missing"):
        read_result(tmp_path / "result.json")


def test_what_the_first_version_put_under_the_task_is_checked_too(tmp_path: Path):
    path = tmp_path / "result.json"
    path.write_text(json.dumps(BASE | {"task": {"preset": "hard", "guidance_parts": None}}))
    assert read_result(path)
    path.write_text(json.dumps(BASE | {"task": {"preset": 3}}))
    with pytest.raises(InputError, match="preset is 3"):
        read_result(path)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("0,0,0,-3,0\n", None),
        ("0,0.5,1,0,0.5\n0,0.5,0.5,0,nan\n", None),
        ("0,0,nan,nan,nan\n", None),
        ("1,1,0,0,0\n0,2,0,0,0\n", "line 3 has steps"),
        ("1,1,0,0,0\n2,0.5,0,0,0\n", "line 3 has steps"),
        ("-1,1,0,0,0\n", "line 2 has steps"),
        ("1,1,0,0,0\n2,2,1.01,0,0\n", "line 3 has a success rate"),
        ("1,1,-0.01,0,0\n", "line 2 has a success rate"),
        ("1,1,0,0,-0.01\n", "negative depth"),
        ("1,1,0,1e12,0\n", "line 2 has a number out of range"),
        ("1,1,0,0,0\n1,1,0,-1e12,0\n", "line 3 has a number out of range"),
        ("1,1,0,9.9e11,0\n", None),
        ("1,1,0,0,0\n" * 20_000, None),
        ("1,1,0,0,0\n" * 20_001, "more than 20000 rows"),
        ("1,1,0,0,0\n1,1,0,0\n", "line 3 has 4 cells and not 5"),
    ],
)
def test_a_curve_rises_and_its_rates_are_shares(tmp_path: Path, rows: str, words: str | None):
    path = tmp_path / "curve.csv"
    path.write_text(CURVE + rows)
    if words is None:
        assert len(read_curve(path)) == rows.count("\n")
    else:
        with pytest.raises(InputError, match=words):
            read_curve(path)


@pytest.mark.parametrize(
    ("names", "fits"),
    [
        ([f"c{k}" for k in range(998)], True),
        ([f"c{k}" for k in range(999)], False),
        (["x" * 200], True),
        (["x" * 201], False),
        (["x", "x"], False),
    ],
)
def test_a_table_of_episodes_has_no_more_columns_and_no_longer_names(tmp_path: Path, names: list[str], fits: bool):
    path = tmp_path / "eval.csv"
    path.write_text(",".join(["episode", "success", *names]) + "\n" + ",".join(["0", "1", *["2"] * len(names)]) + "\n")
    if fits:
        assert read_episodes(path) == {"episode": [0.0], "success": [1.0], **{name: [2.0] for name in names}}
    else:
        with pytest.raises(InputError, match="damaged"):
            read_episodes(path)


@pytest.mark.parametrize("numbers", [(1, 0, 2), (0, 1, 3), (1, 2, 3), (0, 0, 1), (0.5, 1, 2)])
def test_episodes_that_are_not_in_their_order_are_refused(tmp_path: Path, numbers: tuple[float, ...]):
    """Such as of a table that was sorted: tables of episodes are compared row by row."""
    path = tmp_path / "eval.csv"
    path.write_text("episode,success\n0,1\n1,0\n2,1\n")
    assert read_episodes(path)["success"] == [1.0, 0.0, 1.0]
    path.write_text("episode,success\n" + "".join(f"{number},1\n" for number in numbers))
    with pytest.raises(InputError, match=r"its episodes are not 0, 1, 2, \.\.\. from line to line"):
        read_episodes(path)


def test_a_table_agrees_with_the_share_and_the_number_that_are_known():
    path, episodes = Path("eval.csv"), {"success": [1.0, 0.0, 0.0]}
    for share, count in ((None, None), (0.3333, 3), (1 / 3, None), (None, 3), (0.33339, 3)):
        check_agreement(path, episodes, share, count)
    with pytest.raises(InputError, match=r"it has 3 episodes, and result\.json says 4"):
        check_agreement(path, episodes, 1 / 3, 4)
    for share in (0.3331, 0.3336, 0.0, 1.0):
        with pytest.raises(InputError, match=r"a share of 0\.3333 are successes"):
            check_agreement(path, episodes, share, None)


def test_a_table_of_iterations_has_no_more_columns_and_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, stages = tmp_path / "progress.csv", [str(k) for k in range(1000 - len(COLUMNS))]
    monkeypatch.setattr(progress_table, "MOST_ROWS", 2)
    table = ProgressTable(path, stages)
    for step in (1, 2):
        table.add({"env_steps": step})
        assert read_progress(path)["env_steps"].tolist() == [1, 2][:step]
    table.add({"env_steps": 3})
    with pytest.raises(InputError, match="1000 columns and 3 rows, more than a report reads"):
        read_progress(path)
    ProgressTable(path, [*stages, "more"])
    with pytest.raises(InputError, match="1001 columns and 0 rows"):
        read_progress(path)


@pytest.mark.parametrize(
    "torn", ["2,1e12,0,,,,\n", "2,x,0,,,,\n", ",1,0,,,,\n", "2,1,0,,,\n", "2,1,0,,,,,\n", "2,1,0,,,,"]
)
def test_rows_from_the_first_that_is_damaged_on_are_left_out(tmp_path: Path, torn: str):
    path = tmp_path / "progress.csv"
    path.write_text(",".join(COLUMNS) + "\n1,9.9e11,0,,nan,,\n" + torn + "3,1,0,,,,\n")
    assert read_progress(path)["env_steps"].tolist() == [1]
    ProgressTable(path, [], 1)
    assert path.read_text().count("\n") == 2
    ProgressTable(path, [], 0)  # a run that begins
    assert path.read_text().count("\n") == 1


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (3.0, "3"),
        (-2, "-2"),
        (0.25, "0.25"),
        (1 / 3, "0.333333"),
        (1e6 + 0.5, "1e+06"),
        (NAN, ""),
        (math.inf, ""),
        (None, ""),
    ],
)
def test_cells_are_whole_numbers_six_digits_or_empty(tmp_path: Path, value: float | None, text: str):
    table = ProgressTable(tmp_path / "progress.csv", [])
    table.add({"env_steps": 7} | ({} if value is None else {"return_mean": value}))
    assert (tmp_path / "progress.csv").read_text().splitlines()[1] == f"7,,,,,{text},"
