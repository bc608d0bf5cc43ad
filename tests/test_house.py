"""Where things are: the top level as users know it, rooms of a size that can be overlooked, thin scripts."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TOP_LEVEL = {
    ".ci", ".gitignore", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "README.md", "docs", "dora",
    "examples", "experiments", "hatch_build.py", "mkdocs.yml", "objects", "pyproject.toml", "results", "robots",
    "tests",
}  # fmt: skip
"""All that lies in the repository's root."""
MOST_FILES = 14
"""Modules side by side in one folder, besides tests [1]."""
MOST_LINES = 400
"""Lines of a module [1]; about 300 are the aim."""
LONGEST_FUNCTION = 60
"""Lines of a function without its docstring [1]."""
SCRIPTS = ("bench", "demos", "grasps", "play", "report", "run", "sweep", "view")
"""Commands of experiments/."""
OURS = {"DoraEnv", "DescribedRobot", "Task"}
"""Classes that users subclass."""


def tracked(root: Path) -> list[Path]:
    """Files of the repository, or all that lie there where it is no checkout."""
    if (root / ".git").exists():
        listed = subprocess.run(["git", "ls-files"], cwd=root, capture_output=True, text=True, check=True).stdout
        return [Path(line) for line in listed.splitlines() if (root / line).exists()]
    return [path.relative_to(root) for path in root.rglob("*") if path.is_file()]


def modules(root: Path) -> list[Path]:
    return sorted((root / "dora").rglob("*.py"))


def test_the_top_level_is_what_users_know(project_root: Path):
    if not (project_root / ".git").exists():
        pytest.fail("run the suite in a checkout: the files of the repository are listed by git")
    if shutil.which("git") is None:
        pytest.skip("git is not installed: it lists the files of the repository")
    assert {path.parts[0] for path in tracked(project_root)} == TOP_LEVEL


def test_rooms_and_modules_are_of_a_size_that_can_be_overlooked(project_root: Path):
    rooms: dict[str, int] = {}
    for path in modules(project_root):
        room = str(path.parent.relative_to(project_root))
        rooms[room] = rooms.get(room, 0) + (path.name != "__init__.py")
    assert {room: count for room, count in rooms.items() if count > MOST_FILES} == {}
    long = {str(p): n for p in modules(project_root) if (n := len(p.read_text().splitlines())) > MOST_LINES}
    assert long == {}


def test_functions_are_of_a_length_that_can_be_overlooked(project_root: Path):
    long = {}
    for path in modules(project_root):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                if ast.get_docstring(node) is not None:
                    lines -= (node.body[0].end_lineno or 0) - node.body[0].lineno + 1
                long |= {f"{path.relative_to(project_root)} {node.name}": lines} if lines > LONGEST_FUNCTION else {}
    assert long == {}


def test_no_helper_is_kept_in_a_room_without_a_concept(project_root: Path):
    names = {path.stem for path in modules(project_root)} | {path.parent.name for path in modules(project_root)}
    assert not names & {"utils", "util", "common", "helpers", "misc"}


def test_classes_of_ours_inherit_at_most_twice_from_ours(project_root: Path):
    bases: dict[str, list[str]] = {}
    for path in modules(project_root):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                bases[node.name] = [b.id for b in node.bases if isinstance(b, ast.Name)]

    def depth(name: str) -> int:
        return 1 + max((depth(base) for base in bases.get(name, []) if base in bases and base != name), default=0)

    chains = {name: depth(name) for name in bases}
    assert {name: n for name, n in chains.items() if n > 3} == {}
    assert set(bases) >= OURS


def test_all_scripts_are_named(project_root: Path):
    assert {path.stem for path in (project_root / "experiments").glob("*.py")} == set(SCRIPTS)


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_thin(project_root: Path, name: str):
    assert len((project_root / "experiments" / f"{name}.py").read_text().splitlines()) <= 10


@pytest.mark.parametrize(
    "name", [name if name == "run" else pytest.param(name, marks=pytest.mark.slow) for name in SCRIPTS]
)
def test_scripts_run(project_root: Path, name: str):
    path = project_root / "experiments" / f"{name}.py"
    done = subprocess.run([sys.executable, str(path), "--help"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout
