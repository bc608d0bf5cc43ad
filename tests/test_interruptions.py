"""How interrupted runs are judged: invented outcomes, and the words for what is wrong with them."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dora.agents.checkpoint import Checkpoint
from dora.agents.config import RunConfig
from dora.agents.runs.run_folder import RunFolder
from dora.commands import interruptions
from dora.commands.interruptions import END, FIRST_LINE, SHORT, Outcome, judged, resumed

GOOD: dict[str, Any] = {"line": 0.3, "end": 2.0, "status": 143, "said": "Interrupted: saving.\n", "left": frozenset()}
"""What SIGTERM should make of a run."""
LEFT = frozenset({"/dev/shm/sem.mp-dora-1-2-3"})


def judge(folder: Path, monkeypatch: pytest.MonkeyPatch, number: int = signal.SIGTERM, **change: Any) -> Outcome:
    """The judgement of an interruption that ended as `GOOD` says, but for some changes."""
    found = GOOD | change
    end = found["line"], found["end"], found["status"], found["said"], 4711
    monkeypatch.setattr(interruptions, "interrupt", lambda *_: end)
    monkeypatch.setattr(interruptions, "left_behind", lambda process: found["left"])
    return judged(number, 5.0, folder, group=False, options=SHORT)


@pytest.mark.parametrize(
    ("change", "problems"),
    [
        ({}, []),
        ({"status": 0, "line": None}, []),  # it had finished before
        ({"status": 130}, ["exit status 130 instead of 143"]),
        ({"line": None}, [f"no line within {FIRST_LINE:.0f} s"]),
        ({"line": FIRST_LINE + 0.1}, [f"no line within {FIRST_LINE:.0f} s"]),
        ({"end": END + 0.1}, [f"not ended within {END:.0f} s"]),
        ({"said": "Traceback (most recent call last):\n  ...\nKeyError: 3\n"}, ["traceback: KeyError: 3"]),
        ({"left": LEFT}, [f"left {min(LEFT)}"]),
        ({"status": 1, "line": None}, ["exit status 1 instead of 143", f"no line within {FIRST_LINE:.0f} s"]),
    ],
)
def test_what_is_wrong_with_an_interrupted_run_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], problems: list[str]
):
    outcome = judge(tmp_path, monkeypatch, **change)
    assert outcome.problems == problems
    assert outcome.steps is None
    assert str(outcome).endswith("; ".join(problems) or "good")


def test_of_a_killed_run_neither_line_nor_status_nor_what_is_left_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    outcome = judge(tmp_path, monkeypatch, signal.SIGKILL, status=-9, line=None, left=LEFT)
    assert outcome.problems == []
    assert outcome.left == LEFT


def test_semaphores_that_nobody_can_remove_are_a_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(interruptions, "SHARED", tmp_path)
    there = [tmp_path / "sem.mp-before0", tmp_path / "sem.mp-dora-1-2-3-abcdefgh", tmp_path / "other"]
    for path in there:
        path.touch()
    assert interruptions.nameless() == {str(there[0])}
    found: list[frozenset[str]] = [frozenset(), frozenset({"sem.mp-abcdefgh"})]
    monkeypatch.setattr(interruptions, "nameless", lambda: found.pop(0))
    assert "sem.mp-abcdefgh" in judge(tmp_path, monkeypatch, signal.SIGKILL).problems[0]


def test_the_steps_of_a_run_are_those_of_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    Checkpoint(RunConfig("Fake-v1", "ppo", "none"), (4, 2), {}, {"env_steps": 512}).write(folder.latest)
    assert judge(tmp_path, monkeypatch).steps == 512


@pytest.mark.parametrize("begun", [True, False])
def test_a_run_that_cannot_go_on_is_a_problem_if_it_had_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun: bool
):
    left = tmp_path / "left"
    left.touch()
    words = ["python", "-c", "raise SystemExit('Nothing fits.')"]
    monkeypatch.setattr(interruptions, "command", lambda *_: words)
    if begun:
        (tmp_path / "config.yaml").touch()
    outcome = Outcome(5.0, 0.3, 2.0, 143, None, frozenset({str(left)}))
    resumed(outcome, tmp_path)
    assert outcome.problems == (["cannot be resumed: Nothing fits.", f"left for good: {left}"] if begun else [])


def test_training_begins_with_the_first_row_of_its_table(tmp_path: Path):
    table = tmp_path / "progress.csv"
    write = (
        "import sys, time; t = open(sys.argv[1], 'w', 1); print('a,b', file=t); time.sleep(0.5); print('1,2', file=t)"
    )
    with subprocess.Popen([sys.executable, "-c", f"{write}; time.sleep(60)", str(table)], text=True) as process:
        interruptions.wait_for_rows(table, process)
        assert table.read_text() == "a,b\n1,2\n"
        process.kill()
    interruptions.wait_for_rows(tmp_path / "nothing", process)  # it has ended


@pytest.mark.parametrize(
    ("line", "problems", "words"),
    [
        (0.34, [], "5.0 s: line 0.3 s, end 2.0 s, status 143, steps 512, left 1: good"),
        (None, ["a", "b"], "5.0 s: line -, end 2.0 s, status 143, steps 512, left 1: a; b"),
    ],
)
def test_an_interruption_is_told_in_a_line(line: float | None, problems: list[str], words: str):
    assert str(Outcome(5.0, line, 2.0, 143, 512, LEFT, problems)) == words


WAITS = """
import pathlib, signal, sys, time
def ends(number, frame):
    print("Interrupted: saving.", file=sys.stderr, flush=True)
    time.sleep(0.05)
    sys.exit(128 + number)
signal.signal(signal.SIGTERM, ends)
print("uninterrupted so far", file=sys.stderr, flush=True)
pathlib.Path(sys.argv[1]).write_text("head\\nrow\\n")
time.sleep(60)
"""
"""A program that says so when it is interrupted, and ends."""


@pytest.mark.parametrize("group", [False, True])
def test_the_line_that_counts_is_the_first_one_after_the_signal(
    group: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(interruptions, "END", 1.0)
    words = [sys.executable, "-S", "-c", WAITS, str(tmp_path / "table.csv")]
    line, end, status, said, process = interruptions.interrupt(
        words, signal.SIGTERM, 0.0, group, tmp_path / "table.csv"
    )
    assert said == "uninterrupted so far\nInterrupted: saving.\n"
    assert line is not None
    assert 0 <= line < 60  # by a thread, which may be late
    assert 0 < end < 60
    assert status == 143
    assert process > 1


def test_a_run_is_interrupted_in_the_folder_and_at_the_moment_that_were_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr(interruptions, "interrupt", lambda *given: asked.append(given) or (0.1, 1.0, 143, "", 4711))
    for training in (False, True):
        outcome = judged(signal.SIGTERM, 5.0, tmp_path, True, ("--env", "E"), training)
        assert outcome.moment == 5.0
    judged(signal.SIGTERM, 5.0, tmp_path, True, ("--env", "E"))
    words = interruptions.command("--env", "E", "--out", str(tmp_path))
    assert words[1:] == ["-m", "dora", "run", "--env", "E", "--out", str(tmp_path)]
    assert asked == [(words, signal.SIGTERM, 5.0, True, after) for after in (None, RunFolder(tmp_path).progress, None)]


@pytest.mark.parametrize("ends", ["pass", "raise SystemExit('The run has ended.')"])
def test_a_run_that_goes_on_or_had_ended_is_no_problem(ends: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "config.yaml").touch()
    monkeypatch.setattr(interruptions, "command", lambda *_: [sys.executable, "-S", "-c", ends])
    outcome = Outcome(5.0, 0.3, 2.0, 143, None, frozenset({str(tmp_path / "gone")}))
    resumed(outcome, tmp_path)
    assert outcome.problems == []


@pytest.mark.parametrize(
    ("words", "problems", "status"),
    [("", [[], []], 0), ("", [["bad"], []], 1), ("--no-resume --agent ppo --signal KILL", [[], ["bad"]], 1)],
)
def test_one_moment_at_which_something_is_wrong_is_enough(
    words: str, problems: list[list[str]], status: int, monkeypatch: pytest.MonkeyPatch
):
    asked: list[tuple[Any, ...]] = []
    gone_on: list[Path] = []

    def invented(number: int, moment: float, folder: Path, *given: Any) -> Outcome:
        asked.append((number, moment, *given))
        assert folder.parent.is_dir()
        return Outcome(moment, 0.1, 1.0, 143, None, frozenset(), problems[len(asked) - 1])

    monkeypatch.setattr(interruptions, "judged", invented)
    monkeypatch.setattr(interruptions, "resumed", lambda outcome, folder: gone_on.append(folder))
    monkeypatch.setattr(sys, "argv", ["interruptions", "--moments", "1", "3", *words.split()])
    assert interruptions.main() == status
    options = *SHORT, "--env", "DoraCube-v1", *(("--agent", "ppo") if words else ())
    number = signal.SIGKILL if words else signal.SIGINT
    assert asked == [(number, moment, False, options, False) for moment in (1.0, 3.0)]
    assert len(gone_on) == (0 if words else 2)
    assert not [folder for folder in gone_on if folder.parent.exists()]
