"""Mutants of the source: which faults are made, which are drawn, and how they are judged."""

import ast
import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from dora.errors import InputError
from dora.tools.mutants import ROOMS, chosen, drawn, judge_all, judged
from dora.tools.mutation.executions import executed, statement_lines
from dora.tools.mutation.matching import tests_of as matching_tests
from dora.tools.mutation.sites import mutants_of
from dora.tools.mutation.trials import Judge, Outcome, Trial, copied

ROOM = {"room": ("dora/room/*.py",)}
"""Rooms of the project that the tests make."""


def faulted(line: str, returns: str = "") -> set[str]:
    """All faults of a line in a function."""
    source = f"def f(a, b, c){returns}:\n    {line}\n"
    return {mutant.after for mutant in mutants_of("m.py", source) if mutant.line == 2}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("return a < b", {"return a > b"}),
        ("return len(a) <= b", {"return len(a) >= b", "return len(a) < b"}),
        ("return a == b != c", {"return a != b != c", "return a == b == c"}),
        ("return (a) is not  None", {"return (a) is  None"}),
        ("return a in b", {"return a not in b"}),
        ("return (a) + (b)", {"return (a) - (b)"}),
        ("return a * b / c", {"return a / b / c", "return a * b * c"}),
        ("a -= b", {"a += b"}),
        ("return a and b or c", {"return a or b or c", "return a and b and c"}),
        ("return a & b | c", {"return a | b | c", "return a & b & c"}),
        ("return ~a & b", {"return a & b", "return ~a | b"}),
        ("return not (a)", {"return (a)"}),
        ("return -a", {"return a"}),
        ("return a[0]", {"return a[1]"}),
        ("return [7, 0.25]", {"return [8, 0.25]", "return [7, 0.5]"}),
        ("return True", {"return False"}),
        ("return a.amin(b)", {"return a.amax(b)"}),
        ("return minimum(a, b)", {"return maximum(a, b)"}),
        ("return a.clamp(min=b)", {"return a.clamp(max=b)"}),
        ("return a.clamp(min=b, max=c)", set()),
        ("return 'ä' + 'b', a < b  # ö < ü", {"return 'ä' + 'b', a > b  # ö < ü"}),
    ],
)
def test_every_operator_gives_the_expected_text(line: str, expected: set[str]):
    assert faulted(line) == expected


def test_a_function_returns_a_constant_by_its_annotation():
    assert faulted("return a(b)", " -> bool") == {"return True", "return False"}
    assert faulted("return a(b)", " -> float") == {"return 0.0"}
    assert faulted("return False", " -> bool") == {"return True"}
    assert faulted("return a(b)", " -> Tensor") == set()


def test_what_is_no_behaviour_is_never_touched():
    source = '''
"""1 < 2 and not True."""
import a.b
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    C = 1 < 2
LIMIT = 3 * 0.5
"""1 < 2 [1]."""
@decorated(True, 1 < 2)
class D(Base[1 < 2]):
    """Holds 1 < 2."""
    x: Field["1 < 2", True] = 0.5
    y: int = 1 / 32
    z: bool = True
    def f(self, a: Int[1 < 2] = 7) -> Float[1 < 2]:
        """Says 1 + 2."""
        b: Float[True, 2]
        print(1 < 2, True)
        assert a < 2
        if a:
            raise ValueError(f"{a + 1} of {2 * a} " + str(not a))
        logger.info("x", 1 < 2)
        scene.add_box_visual([0, 1])
        return zip(a, f"{a < 2}", Term(a, doc="a" * 2), strict=True)
'''
    assert mutants_of("m.py", source) == []


def test_faults_lie_where_they_say_and_leave_the_rest_as_it_is():
    source = "def f(a, b):\n    return (\n        a  # as < it is\n        <\n        b\n    )\n"
    (mutant,) = mutants_of("m.py", source)
    assert (mutant.line, mutant.before, mutant.after) == (4, "<", ">")
    assert mutant.applied(source) == source.replace("        <\n", "        >\n")


def test_faults_of_the_package_are_other_programs(project_root: Path):
    for patterns in ROOMS.values():
        path = sorted(project_root.glob(patterns[0]))[-1]
        source = path.read_text()
        for mutant in mutants_of("m.py", source)[::20]:
            assert ast.dump(ast.parse(mutant.applied(source))) != ast.dump(ast.parse(source))


def test_the_draw_follows_from_the_seed_and_visits_every_room(project_root: Path):
    some = {room: ROOMS[room] for room in ("files", "policies")}
    one, again, other = (drawn(project_root, 4, seed, some) for seed in (0, 0, 1))
    assert one == again != other
    first = drawn(project_root, 2 * len(ROOMS), 0)
    assert len({(mutant.module, mutant.line) for mutant in first}) == len(first)
    for patterns in ROOMS.values():
        files = {str(path.relative_to(project_root)) for each in patterns for path in project_root.glob(each)}
        assert sum(mutant.module in files for mutant in first) == 2


def test_rooms_are_chosen_by_name_with_those_inside():
    rooms = {"agents": ("a",), "agents.runs": ("b",), "agents_of_others": ("c",), "files": ("d",)}
    assert chosen((), rooms) == rooms
    assert list(chosen(("agents",), rooms)) == ["agents", "agents.runs"]
    assert chosen(("files", "agents.runs"), rooms) == {"agents.runs": ("b",), "files": ("d",)}
    with pytest.raises(InputError, match=r"no room 'agent'; the rooms are agents, agents\.runs"):
        chosen(("files", "agent"), rooms)


def test_more_mutants_than_there_are_are_refused(project: Path):
    with pytest.raises(InputError, match="between 1 and 2 mutants"):
        drawn(project, 1000, 0, ROOM)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A repository with a module of two faults: a test notices that of `less`, no test that of `more`."""
    files = {
        "dora/__init__.py": "",
        "dora/room/__init__.py": "",
        "dora/room/other.py": "",
        "dora/room/sides.py": "def less(a, b):\n    return a < b\n\n\ndef more(a, b):\n    return a > b\n",
        "tests/test_sides.py": "from dora.room.sides import less\n\n\ndef test_less():\n    assert less(1, 2)\n",
        "tests/helper.py": "import dora.room.other\n",
        "tests/test_useless.py": "import helper\n\n\ndef test_nothing():\n    pass\n",
        "tests/test_stray.py": "",
    }
    root = tmp_path / "project"
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    if shutil.which("git") is None:
        pytest.skip("git is not installed: it lists the files of a project")
    for command in (["init"], ["add", "."]):
        subprocess.run(["git", *command], cwd=root, check=True, capture_output=True)
    return root


class _Runner:
    """Runs the tests of the project without pytest, and counts."""

    def __init__(self, outcome: Outcome | None = None):
        self.outcome, self.asked = outcome, []

    def __call__(self, copy: Path, arguments: Sequence[str], limit: float) -> Outcome:
        self.asked.append(list(arguments))
        names: dict[str, object] = {}
        source = (copy / "dora/room/sides.py").read_text()
        exec(source, names)
        wanted = any(word.startswith("tests/test_sides.py") for word in arguments)
        if self.outcome is not None and "a < b" not in source:
            return self.outcome
        works = names["less"](1, 2)  # pyright: ignore[reportCallIssue]
        return Outcome("passed") if works or not wanted else Outcome("failed", "tests/test_sides.py::test_less")


def test_tests_of_a_module_come_in_the_order_of_their_distance(project: Path):
    own, others = matching_tests(project, "dora/room/sides.py")
    assert own == ["tests/test_sides.py", "tests/test_useless.py"]
    assert others == ["tests/test_stray.py"]


def test_commands_that_tests_load_by_name_are_imported(tmp_path: Path):
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_bad_input.py").write_text("from commands import load_command\n\nload_command('lift')\n")
    (tmp_path / "tests/test_other.py").write_text("from commands import load_command\n\nload_command('sink')\n")
    own, others = matching_tests(tmp_path, "dora/commands/lift.py")
    assert own == ["tests/test_bad_input.py", "tests/test_other.py"]
    assert others == []
    assert matching_tests(tmp_path, "dora/commands/sink.py")[0] == own[::-1]


def test_a_good_test_catches_and_a_useless_one_does_not(project: Path, tmp_path: Path):
    mutants, run, file = drawn(project, 2, 0, ROOM), _Runner(), tmp_path / "out" / "mutants.jsonl"
    judge = Judge(copied(project, tmp_path / "copy"), 60.0, 60.0, run)
    trials = judge_all(mutants, judge, file)
    found = {mutant.before: trials[mutant.key] for mutant in mutants}
    assert found["return a < b"] == Trial("caught", "tests/test_sides.py::test_less")
    assert found["return a > b"] == Trial("survived", stages=3)
    assert ["tests/test_stray.py"] in run.asked
    for root in (project, judge.copy):
        assert "a < b" in (root / "dora/room/sides.py").read_text()

    count = len(run.asked)
    file.write_text(file.read_text() + '{"key": "torn')
    assert judge_all(mutants, judge, file) == trials
    assert len(run.asked) == count
    judge_all(mutants, judge, file, again=True)
    assert len(run.asked) == count + 2
    assert judged(file) == trials
    assert {json.loads(line)["module"] for line in file.read_text().splitlines() if "torn" not in line} == {
        "dora/room/sides.py"
    }


def test_a_survivor_of_its_own_tests_meets_the_rest_of_the_suite_later(project: Path, tmp_path: Path):
    mutants, run, file = drawn(project, 2, 0, ROOM), _Runner(), tmp_path / "mutants.jsonl"
    judge = Judge(copied(project, tmp_path / "copy"), 60.0, None, run)
    assert {trial.stages for trial in judge_all(mutants, judge, file).values()} == {0, 2}
    judge.suite_limit, run.asked = 60.0, []
    judge_all(mutants, judge, file)
    assert run.asked == [["tests/test_stray.py"]]


def test_tests_that_execute_the_line_come_first_and_once(project: Path, tmp_path: Path):
    mutant = next(m for m in drawn(project, 2, 0, ROOM) if m.before == "return a > b")
    run, stray, helped = _Runner(), "tests/test_stray.py::test_a", "tests/test_useless.py::test_nothing"
    judge = Judge(copied(project, tmp_path / "copy"), 60.0, 60.0, run, executing=lambda mutant: [stray, helped])
    assert judge.judge(mutant) == Trial("survived", stages=3)
    assert run.asked[0] == [helped, stray]
    assert run.asked[1][2:] == [f"--deselect={helped}"]
    assert run.asked[2] == ["tests/test_stray.py", f"--deselect={stray}"]


def test_tests_that_cannot_be_run_any_more_leave_the_verdict_to_the_rest_of_the_module(project: Path, tmp_path: Path):
    mutant = next(m for m in drawn(project, 2, 0, ROOM) if m.before == "return a < b")
    run, gone = _Runner(), "tests/test_sides.py::test_of_former_times"

    def without(copy: Path, arguments: Sequence[str], limit: float) -> Outcome:
        if gone in arguments:
            return Outcome("failed")
        return Outcome("passed") if f"--deselect={there}" in arguments else run(copy, arguments, limit)

    there = "tests/test_sides.py::test_less"
    judge = Judge(copied(project, tmp_path / "copy"), 60.0, None, without, executing=lambda mutant: [gone, there])
    assert judge.judge(mutant) == Trial("caught", there)


def test_a_run_under_coverage_tells_which_tests_execute_a_line(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    copy, out = copied(project, tmp_path / "copy"), tmp_path / "out"
    mutants = {mutant.before: mutant for mutant in drawn(project, 2, 0, ROOM)}
    found = executed(copy, out, processes=0)
    assert found.tests(mutants["return a < b"]) == ["tests/test_sides.py::test_less"]
    assert found.tests(mutants["return a > b"]) == []
    assert not (copy / ".coveragerc").exists()
    (kept,) = out.iterdir()
    with monkeypatch.context() as without:
        without.setattr("dora.tools.mutation.executions._run_under_coverage", None)  # what is kept needs no further run
        assert executed(copy, out, processes=0).tests(mutants["return a > b"]) == []
    kept.write_text("nothing")
    with pytest.raises(InputError, match="delete it"):
        executed(copy, out, processes=0).tests(mutants["return a < b"])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (1, (1, 1)),
        (2, (2, 3)),
        (3, (2, 3)),
        (4, (4, 5)),
        (5, (4, 5)),
        (6, (6, 6)),
        (7, (7, 7)),
        (8, (8, 8)),
        (9, (9, 9)),
    ],
)
def test_a_statement_has_all_of_its_lines_and_no_others(line: int, expected: tuple[int, int]):
    source = (
        "def f(a):\n    b = (a +\n         1)\n    if (b >\n            2):\n        b = 3\n"
        "    try:\n        b = 4\n    except ValueError:\n        pass\n"
    )
    assert statement_lines(source, line) == expected


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (Outcome("timeout"), Trial("timeout")),
        (Outcome("failed"), Trial("caught")),
        (Outcome("failed", "tests/test_useless.py"), Trial("caught", "tests/test_useless.py")),
    ],
)
def test_a_timeout_and_a_failing_collection_are_caught(
    project: Path, tmp_path: Path, outcome: Outcome, expected: Trial
):
    mutant = next(m for m in drawn(project, 2, 0, ROOM) if m.before == "return a < b")
    judge = Judge(copied(project, tmp_path / "copy"), 60.0, None, _Runner(outcome))
    assert judge.judge(mutant) == expected


def test_a_test_that_fails_without_any_fault_does_not_count(project: Path, tmp_path: Path):
    always = "tests/test_useless.py::test_nothing"

    def run(copy: Path, arguments: Sequence[str], limit: float) -> Outcome:
        return Outcome("passed") if f"--deselect={always}" in arguments else Outcome("failed", always)

    judge = Judge(copied(project, tmp_path / "copy"), 60.0, None, run)
    trials = judge_all(drawn(project, 2, 0, ROOM), judge, tmp_path / "mutants.jsonl")
    assert {trial.verdict for trial in trials.values()} == {"survived"}
    assert judge.left_out == [always]


def test_a_folder_without_git_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    if shutil.which("git") is not None:
        with pytest.raises(InputError, match="is no git checkout"):
            copied(tmp_path, tmp_path / "copy")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="git is not installed"):
        copied(tmp_path, tmp_path / "copy")
