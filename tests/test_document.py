"""The task pages say what the code does."""

from pathlib import Path

import pytest

from dora.tasks import make_task, task_ids
from dora.tasks.document import page_of, preset_table, refreshed, tables


@pytest.mark.parametrize("env_id", task_ids())
def test_the_page_of_every_task_is_up_to_date(project_root: Path, env_id: str):
    task = make_task(env_id, 1, sim_backend="physx_cpu")
    page = page_of(env_id, project_root / "docs").read_text()
    assert refreshed(page, tables(task)) == page, "run: python -m dora.tasks.document"
    task.close()


def test_the_table_of_presets_is_up_to_date(project_root: Path):
    page = (project_root / "docs" / "guidance.md").read_text()
    assert refreshed(page, preset_table()) == page, "run: python -m dora.tasks.document"


def test_a_page_without_marks_is_refused():
    with pytest.raises(ValueError, match="marks"):
        refreshed("no marks", "tables")
