"""Which tests execute a line of the source: found by one run of the whole suite under coverage."""

import ast
import functools
import os
import subprocess
import sys
from pathlib import Path

from coverage import CoverageData
from coverage.exceptions import CoverageException

from dora.errors import InputError
from dora.tools.mutation.sites import Mutant

SETTINGS = "[run]\nrelative_files = true\nsource = dora\n"
"""Settings of coverage: files are named below the root, as those of mutants."""
PHASE = "|"
"""What stands between a test and its phase (setup, run, teardown) in the contexts of coverage."""
SUFFIX = ".coverage"
"""Ending of the files of a run under coverage."""


class Executions:
    """Tests that execute a line, by a file of coverage.

    What a fixture of a whole module or session executes counts for its first test alone, and what runs in other
    processes, compiled or while modules are imported, for none.

    Args:
        root: of the repository that has been run.
        path: of the file.

    Raises:
        InputError: the file is damaged.
    """

    def __init__(self, root: Path, path: Path):
        self._root, self._data = root, CoverageData(basename=str(path))
        try:
            self._data.read()
        except CoverageException as error:
            raise InputError(f"{path} cannot be read: delete it, and it is made anew.") from error

    def tests(self, mutant: Mutant) -> list[str]:
        """Tests that execute the statement of a mutant, as pytest names them, sorted."""
        by_line = self._contexts(mutant.module)
        first, last = statement_lines((self._root / mutant.module).read_text(), mutant.line)
        contexts = {context for line in range(first, last + 1) for context in by_line.get(line, ())}
        return sorted({context.rpartition(PHASE)[0] for context in contexts} - {""})

    @functools.cache  # noqa: B019 - lives as long as the program
    def _contexts(self, module: str) -> dict[int, list[str]]:
        return self._data.contexts_by_lineno(module)


def statement_lines(source: str, line: int) -> tuple[int, int]:
    """First and last line of the innermost statement at a line; of one that holds others, what stands before them."""
    found, size = (line, line), float("inf")
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.stmt | ast.excepthandler | ast.match_case):
            continue
        body = getattr(node, "body", None)
        first = node.pattern.lineno if isinstance(node, ast.match_case) else node.lineno
        last = body[0].lineno - 1 if body else getattr(node, "end_lineno", first)
        last = max(first, last)
        if first <= line <= last and last - first < size:
            found, size = (first, last), last - first
    return found


def executed(copy: Path, out: Path, processes: int) -> Executions:
    """Runs the suite of a copy under coverage, unless a file of the same tree is there.

    Args:
        copy: of the repository.
        out: folder of the file, which is named after the tree.
        processes: worker processes of the tests.
    """
    tree = subprocess.run(["git", "rev-parse", "HEAD^{tree}"], cwd=copy, check=True, capture_output=True, text=True)
    path = out.absolute() / f"{tree.stdout.strip()[:12]}{SUFFIX}"
    if not path.exists():
        out.mkdir(parents=True, exist_ok=True)
        _run_under_coverage(copy, path, processes)
    return Executions(copy, path)


def _run_under_coverage(copy: Path, path: Path, processes: int) -> None:
    """Runs the suite; the file appears when it is whole.

    Raises:
        InputError: pytest ended otherwise than by tests that pass or fail.
    """
    settings, part = copy / ".coveragerc", path.with_suffix(".part")
    settings.write_text(SETTINGS)
    options = ["-q", "-p", "no:cacheprovider", "--tb=no", "-n", str(processes), "--cov", f"--cov-config={settings}"]
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "pytest", *options, "--cov-context=test", "--cov-report="],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy), "COVERAGE_FILE": str(part)},
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
    finally:
        settings.unlink()
    if ended.returncode not in (0, 1) or not part.exists():
        raise InputError(f"pytest ended with {ended.returncode} under coverage: {ended.stdout.strip()[-300:]}")
    part.rename(path)
