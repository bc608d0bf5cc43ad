"""A run folder is of one run: another one is refused, and a run that cannot begin leaves nothing in the way."""

import json
import multiprocessing
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from commands import call, load_command

from dora.agents.runs import run_folder
from dora.agents.runs.recommended import recommended
from dora.agents.runs.run_folder import EVALUATION, RunFolder, default_folder
from dora.errors import InputError

IMPOSSIBLE = "--env DoraCube-v1 --task.hand-action fingers"
"""Settings that are refused only where the task is made: fingers have no reference."""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_command("run")


@pytest.mark.parametrize("options", ["", "--eval-only --zero-correction --episodes 2 --workers 1"])
def test_settings_that_the_task_refuses_can_be_corrected_with_the_same_folder(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str
):
    out = tmp_path / "out"
    words = [*IMPOSSIBLE.split(), *options.split(), "--out", str(out)]
    assert call(script, monkeypatch, *words) == 2
    RunFolder(out).check_free(evaluation="--eval-only" in words)
    assert "--eval-only" in words or not out.exists()


def test_what_a_person_put_into_the_folder_stays(script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "notes.txt").write_text("mine")
    assert call(script, monkeypatch, *IMPOSSIBLE.split(), "--out", str(tmp_path)) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_an_evaluation_that_ended_before_its_result_may_be_begun_again_and_no_training(tmp_path: Path):
    folder, config = RunFolder(tmp_path / "run"), recommended("DoraCube-v1", "ppo")
    folder.create(config, evaluation=True)
    folder.create(config, evaluation=True)
    with pytest.raises(InputError, match="holds an evaluation already"):
        folder.create(config)
    (folder.path / "result.json").write_text(json.dumps({"checkpoint": None}))
    with pytest.raises(InputError, match="holds an evaluation already"):
        folder.create(config, evaluation=True)
    trained = RunFolder(tmp_path / "trained")
    trained.create(config)
    with pytest.raises(InputError, match="holds a run already"):
        trained.create(config, evaluation=True)


def begin(path: Path, together: Any, said: Any) -> None:
    """Make a run folder at the same time as other processes do."""
    config = recommended("DoraCube-v1", "ppo")
    together.wait()
    try:
        RunFolder(path).create(config)
    except InputError as error:
        said.put(str(error))
    else:
        said.put("made")


def test_of_processes_that_begin_at_the_same_time_one_gets_the_folder(tmp_path: Path):
    context = multiprocessing.get_context("fork")
    for turn in range(4):
        together, said = context.Barrier(3), context.Queue()
        path = tmp_path / str(turn)
        processes = [context.Process(target=begin, args=(path, together, said)) for _ in range(3)]
        for process in processes:
            process.start()
        found = sorted(said.get(timeout=60) for _ in processes)
        for process in processes:
            process.join()
        assert found.count("made") == 1, found
        assert all("already" in words or "Another process" in words for words in found if words != "made")


def test_a_folder_is_locked_while_a_policy_is_evaluated_in_it(tmp_path: Path):
    folder = RunFolder(tmp_path)
    folder.create(recommended("DoraCube-v1", "ppo"), evaluation=True)
    with folder.locked(), pytest.raises(InputError, match="Another process is at work in"):
        RunFolder(tmp_path).create(recommended("DoraCube-v1", "ppo"), evaluation=True)
    assert (tmp_path / EVALUATION).is_file()


def test_runs_that_begin_within_a_second_have_folders_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Stopped(run_folder.datetime.datetime):
        """A clock that stands still."""

        @classmethod
        def now(cls, tz: Any = None) -> Any:
            return cls(2026, 11, 30)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_folder.datetime, "datetime", Stopped)
    config, found = recommended("DoraCube-v1", "ppo"), []
    for _ in range(3):
        found.append(default_folder(config, "ppo", "-eval"))
        RunFolder(found[-1]).create(config)
    name = "ppo-affordance-s0-20261130-000000-eval"
    assert found == [Path("runs/DoraCube-v1") / f"{name}{end}" for end in ("", "-2", "-3")]


def test_zero_correction_has_no_learner(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = ["--eval-only", "--zero-correction", "--env", "DoraCube-v1", "--agent", "ppo"]
    assert call(script, monkeypatch, *words) == 2
    assert "--agent has no effect on an evaluation of zero correction" in capsys.readouterr().err
