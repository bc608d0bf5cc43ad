"""The task pages say what the code does."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from dora.tasks import make_task, task_ids
from dora.tools.stage_pictures import GAP, side_by_side, stage_frames
from dora.tools.task_pages import page_of, preset_table, refreshed, tables


@pytest.mark.parametrize("env_id", task_ids())
def test_the_page_of_every_task_is_up_to_date(project_root: Path, env_id: str):
    task = make_task(env_id, 1, sim_backend="physx_cpu")
    page = page_of(env_id, project_root / "docs").read_text()
    assert refreshed(page, tables(task)) == page, "run: python -m dora.tools.task_pages"
    task.close()


def test_the_table_of_presets_is_up_to_date(project_root: Path):
    page = (project_root / "docs" / "guidance.md").read_text()
    assert refreshed(page, preset_table()) == page, "run: python -m dora.tools.task_pages"


def test_a_page_without_marks_is_refused():
    with pytest.raises(ValueError, match="marks"):
        refreshed("no marks", "tables")


class Staged:
    """A task of three stages, the first two completed in one step; its pictures show how far it is."""

    def __init__(self, completed: list[int]):
        self.completed, self.max_steps, self.now = completed, len(completed), 0
        self.machine = SimpleNamespace(stages="abc", furthest=torch.zeros(1, dtype=torch.long))

    def reset(self, seed: int) -> None:
        self.now = 0
        self.machine.furthest[0] = 0

    def scripted_action(self) -> None:
        return None

    def step(self, action: None) -> None:
        self.machine.furthest[0] = self.completed[self.now]
        self.now += 1

    def render(self) -> torch.Tensor:
        return torch.full((1, 8, 10, 3), self.now, dtype=torch.uint8)


def test_stage_pictures_show_the_step_that_completed_each_stage():
    task: Any = Staged([0, 2, 2, 1, 3, 3])
    frames = stage_frames(task, 0)
    assert frames is not None
    assert [int(frame[0, 0, 0]) for frame in frames] == [0, 2, 2, 5]
    assert side_by_side(frames).shape == (4, 4 * 5 + 3 * GAP, 3)
    unfinished: Any = Staged([0, 2, 2])
    assert stage_frames(unfinished, 0) is None
