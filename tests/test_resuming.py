"""What `--resume` refuses: evaluations, and runs that cannot go on, whose folders it leaves as they are."""

from pathlib import Path

import pytest
from commands import call, refusal
from fake_task import PointMass

from dora.agents.runs.run_folder import RunFolder
from dora.commands import run

EVALUATE = "--eval-only --zero-correction --env DoraCube-v1 --episodes 2 --workers 1"
"""Options of a short evaluation."""


@pytest.fixture(autouse=True)
def point_mass(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands get a point mass in place of the task that they name."""
    monkeypatch.setattr(run, "make_task", lambda env, num_envs, **options: PointMass(num_envs))


def state_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("state", ["interrupted", "finished", "of an earlier version", "just begun"])
def test_an_evaluation_is_not_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], state: str
):
    folder = tmp_path / "eval"
    if state == "interrupted":
        usual = run.evaluate_zero
        monkeypatch.setattr(run, "evaluate_zero", interrupted)
        with pytest.raises(KeyboardInterrupt):
            call(run, monkeypatch, *EVALUATE.split(), "--out", str(folder))
        monkeypatch.setattr(run, "evaluate_zero", usual)
        assert not (folder / "result.json").exists()
    else:
        assert call(run, monkeypatch, *EVALUATE.split(), "--out", str(folder)) == 0
    if state == "of an earlier version":
        (folder / "evaluation.txt").unlink()
    if state == "just begun":
        for path in {path for path in folder.rglob("*") if path.is_file()} - {folder / "evaluation.txt"}:
            path.unlink()
    before = state_of(folder)
    capsys.readouterr()
    for more in ("", " --total-steps 9000000"):
        said = refusal(run, monkeypatch, capsys, f"--resume {folder}{more}")
        assert f"{folder} holds an evaluation, in which nothing is trained" in said
    ended = (folder / "result.json").exists()
    for words in (*[EVALUATE][:ended], "--env DoraCube-v1 --workers 0"):
        said = refusal(run, monkeypatch, capsys, f"{words} --out {folder}")
        assert f"{folder} holds an evaluation already" in said
        assert "--resume" not in said
    assert state_of(folder) == before
    assert ended or call(run, monkeypatch, *EVALUATE.split(), "--out", str(folder)) == 0  # it is begun again


@pytest.mark.parametrize("damage", ["damaged", "missing"])
def test_a_run_that_cannot_go_on_keeps_its_folder_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], damage: str
):
    words = "--env DoraCube-v1 --total-steps 1024 --num-envs 16 --workers 0 --episodes 2 --no-zero-correction --out"
    folder = tmp_path / "run"
    assert call(run, monkeypatch, *words.split(), str(folder)) == 0
    latest = RunFolder(folder).latest
    latest.unlink() if damage == "missing" else latest.write_bytes(latest.read_bytes()[:-1])
    before = state_of(folder)
    capsys.readouterr()
    said = refusal(run, monkeypatch, capsys, f"--resume {folder} --total-steps 4096 --no-zero-correction")
    assert str(latest) in said
    assert state_of(folder) == before
