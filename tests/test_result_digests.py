"""A result and its tables are those that were written, or are refused."""

import json
from pathlib import Path

import pytest
from probes import write_result

from dora.agents.reports.run_results import find_runs
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.stored_results import MOST_TABLE, OF_TABLES, TABLES, read_result
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


@pytest.mark.parametrize("dropped", [(), (SEAL,)], ids=["changed", "without its digest"])
def test_a_changed_result_gets_no_digest_when_its_run_goes_on(folder: Path, dropped: tuple[str, ...]):
    path = folder / "result.json"
    content = json.loads(path.read_text()) | {"success_rate": 0.125}
    path.write_text(json.dumps({name: value for name, value in content.items() if name not in dropped}))
    changed = path.read_bytes()
    RunFolder(folder).mark_unfinished()
    assert path.read_bytes() == changed
    with pytest.raises(InputError, match="its digest differs"):
        read_result(path)


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


def test_a_table_that_the_result_does_not_know_is_refused(folder: Path):
    content = (folder / "zero.csv").read_bytes()
    (folder / "zero.csv").unlink()
    RunFolder(folder).write_result(json.loads((folder / "result.json").read_text()))
    (folder / "zero.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"zero.csv is damaged \(result.json does not know it\)"):
        find_runs(folder)


def test_a_run_whose_table_is_too_large_for_a_report_ends_and_goes_on(folder: Path):
    line = (folder / "progress.csv").read_bytes().splitlines(keepends=True)[-1]
    with (folder / "progress.csv").open("ab") as file:
        file.write(line * (MOST_TABLE // len(line)))
    run = RunFolder(folder)
    result = run.write_result(json.loads((folder / "result.json").read_text()))
    assert read_result(folder / "result.json") == result
    run.mark_unfinished()
    run.write_result(result)
    with pytest.raises(InputError, match="may have at most"):
        find_runs(folder)


def test_the_path_of_a_checkpoint_may_be_long(folder: Path):
    run = RunFolder(folder)
    run.write_result(json.loads((folder / "result.json").read_text()) | {"checkpoint": "/".join(["d" * 60] * 20)})
    assert read_result(folder / "result.json")


def test_episodes_are_numbers(folder: Path):
    table, result = folder / "eval.csv", folder / "result.json"
    table.write_text(table.read_text().replace("0.07", "nan"))
    RunFolder(folder).write_result(json.loads(result.read_text()))
    with pytest.raises(InputError, match=r"eval.csv is damaged \(penetration_mm is no number somewhere\)"):
        find_runs(folder)
