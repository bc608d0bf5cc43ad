"""A result and its tables are those that were written, or are refused."""

import json
from pathlib import Path

import pytest
from probes import write_result

from dora.agents.reports.run_results import find_runs
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.stored_results import OF_TABLES, TABLES, read_result
from dora.digests import SEAL
from dora.errors import InputError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_result(tmp_path)
    return tmp_path


def change(path: Path, **entries: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def test_a_result_that_was_changed_is_refused(folder: Path):
    path = folder / "result.json"
    change(path)  # other spaces and line breaks are no change
    assert read_result(path)
    for entry in ({"success_rate": 0.51}, {"commit": "0" * 12}, {SEAL: "0" * 64}, {OF_TABLES: {}}):
        before = path.read_text()
        change(path, **entry)
        with pytest.raises(InputError, match="its digest differs"):
            find_runs(folder)
        path.write_text(before)
    change(path, finished=False)
    with pytest.raises(InputError, match="its digest differs"):
        read_result(path)


@pytest.mark.parametrize("name", TABLES)
def test_a_table_that_was_changed_is_refused_and_one_that_was_left_out_is_not(folder: Path, name: str):
    table = folder / name
    table.write_bytes(table.read_bytes().replace(b"\n", b"\r\n"))
    find_runs(folder)
    content = table.read_bytes()
    at = content.rindex(b"1")
    table.write_bytes(content[:at] + b"0" + content[at + 1 :])
    with pytest.raises(InputError, match=rf"{name} is damaged \(its digest in result.json differs\)"):
        find_runs(folder)
    table.unlink()
    find_runs(folder)


def test_tables_of_a_run_that_goes_on_may_change(folder: Path):
    RunFolder(folder).mark_unfinished()
    (folder / "progress.csv").unlink()
    assert read_result(folder / "result.json") is None


def test_a_result_of_an_earlier_version_has_no_digest(folder: Path):
    path = folder / "result.json"
    content = json.loads(path.read_text())
    del content[SEAL], content[OF_TABLES]
    path.write_text(json.dumps(content | {"success_rate": 0.5}))
    assert read_result(path)


def test_every_stored_result_has_its_digests(project_root: Path):
    found = sorted((project_root / "results").rglob("result.json"))
    assert found
    for path in found:
        assert SEAL in json.loads(path.read_text()), path
        assert read_result(path), path
