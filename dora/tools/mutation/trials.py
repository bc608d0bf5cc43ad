"""Trials of mutants: a copy of the repository, its tests in processes of their own, and what they find."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from dora.errors import InputError
from dora.tools.mutation.matching import tests_of
from dora.tools.mutation.sites import Mutant

Verdict = Literal["caught", "timeout", "survived", "unjudged"]
"""What became of a mutant; "timeout" is caught, too, "unjudged" one whose tests are too slow without any fault."""
CAUGHT = ("caught", "timeout")
"""Verdicts that count as caught."""
PYTEST = (
    "-x", "-q", "-p", "no:cacheprovider", "--no-loadscope-reorder", "--color=no", "--tb=no", "-rfE",
)  # fmt: skip
"""How tests are run: until the first that fails, in the order given."""


@dataclass(frozen=True)
class Outcome:
    """What a run of tests found.

    Attributes:
        ended: "passed", "failed" or "timeout".
        test: the first that failed, as pytest names it; "" where collecting failed as a whole.
    """

    ended: Literal["passed", "failed", "timeout"]
    test: str = ""


Runner = Callable[[Path, Sequence[str], float], Outcome]
"""Runs arguments of pytest, such as test modules, in a copy of the repository, for at most a time [s]."""


def copied(root: Path, target: Path) -> Path:
    """Copies the files of a repository that git knows, and makes the copy a repository, for tests that ask git.

    Raises:
        InputError: `root` is no checkout.
    """
    if shutil.which("git") is None:
        raise InputError("git is not installed, and it lists the files that are copied: install it.")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True)
    names = [name for name in listed.stdout.split("\0") if name and (root / name).is_file()]
    if listed.returncode or not names:
        raise InputError(f"{root} is no git checkout: mutants are tried on a copy of the files that git knows.")
    for name in names:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(root / name, target / name)
    who = ["-c", "user.name=dora", "-c", "user.email=dora@localhost", "-c", "commit.gpgsign=false"]
    for command in (["init"], ["add", "-A", "-f"], [*who, "commit", "-m", "copy"]):
        subprocess.run(["git", *command], cwd=target, check=True, capture_output=True)
    return target


def run_pytest(copy: Path, arguments: Sequence[str], limit: float, processes: int = 2) -> Outcome:
    """Runs pytest with some worker processes in a copy, in a session of its own that is ended at the limit [s]."""
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest", *PYTEST, "-n", str(processes), *arguments],
        cwd=copy,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        return Outcome("timeout")
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.returncode == 0:
        return Outcome("passed")
    found = re.search(r"^(?:FAILED|ERROR) (\S+?\.py(?:::.*?)?)(?: - .*)?$", output, re.M)
    return Outcome("failed", found[1] if found else "")


@dataclass(frozen=True)
class Trial:
    """What became of a mutant: by which test, and after how many stages of tests if it survived."""

    verdict: Verdict
    test: str = ""
    stages: int = 0


@dataclass
class Judge:
    """Tries mutants in a copy of the repository, one at a time; the copy is as it was after each.

    A mutant meets up to three stages of tests: those that execute its line, the rest of its module's, all others. A
    failure counts if the same test passes without the fault; a test that does not is left out from then on.

    Attributes:
        copy: root of the copy.
        limit: longest run of the first two stages, each [s].
        suite_limit: longest run of the third one [s]; None leaves it out.
        run: runs tests.
        executing: tests that execute the line of a mutant, as far as is known.
    """

    copy: Path
    limit: float
    suite_limit: float | None
    run: Runner = run_pytest
    executing: Callable[[Mutant], Sequence[str]] = lambda mutant: ()
    left_out: list[str] = field(default_factory=list)
    _sound: dict[tuple[str, ...], bool] = field(default_factory=dict)

    @property
    def stages(self) -> int:
        """How many stages of tests there are."""
        return 2 if self.suite_limit is None else 3

    def judge(self, mutant: Mutant, survived: int = 0) -> Trial:
        """What becomes of a mutant that has already survived so many stages."""
        own, others = tests_of(self.copy, mutant.module)
        near = {module: place for place, module in enumerate([*own, *others])}
        first = sorted(self.executing(mutant), key=lambda test: near.get(test.partition("::")[0], len(near)))
        stages = [(first, self.limit), (own, self.limit), (others, self.suite_limit)]
        done: Sequence[str] = []
        for tests, limit in stages[survived : self.stages]:
            trial = None if limit is None else self._tried(mutant, tests, done, limit)
            if tests is not first:
                if trial is not None:
                    return trial
            elif trial is None:
                done = first
            elif trial.verdict != "unjudged":  # else its module's tests judge it, all of them
                return trial
        return Trial("survived", stages=max(self.stages, survived))

    def _tried(self, mutant: Mutant, tests: Sequence[str], done: Sequence[str], limit: float) -> Trial | None:
        """The verdict of some tests, without those that are done; None if they notice nothing."""
        path = self.copy / mutant.module
        source = path.read_text()
        while wanted := [test for test in tests if test not in self.left_out]:
            skipped = [f"--deselect={test}" for test in [*done, *self.left_out] if test.partition("::")[0] in wanted]
            path.write_text(mutant.applied(source))
            try:
                outcome = self.run(self.copy, [*wanted, *skipped], limit)
            finally:
                path.write_text(source)
            if outcome.ended == "passed":
                return None
            if outcome.ended == "timeout":
                return Trial("timeout" if self._passes([*wanted, *skipped], limit) else "unjudged")
            one = [outcome.test] if "::" in outcome.test else [outcome.test, "--collect-only"]
            if self._passes(one if outcome.test else [*wanted, *skipped], limit):
                return Trial("caught", outcome.test)
            if not outcome.test or outcome.test in self.left_out:
                return Trial("unjudged", outcome.test)
            self.left_out.append(outcome.test)
        return None

    def _passes(self, arguments: Sequence[str], limit: float) -> bool:
        """Whether tests pass without any fault; each is asked once."""
        key = tuple(arguments)
        if key not in self._sound:
            self._sound[key] = self.run(self.copy, arguments, limit).ended == "passed"
        return self._sound[key]
