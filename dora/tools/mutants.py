"""How many small deliberate faults of the source the tests notice.

    python -m dora.tools.mutants --count 40 --seed 0 --out runs/mutants
    python -m dora.tools.mutants --count 40 --seed 0 --out runs/mutants --rooms tasks agents affordance.maps files

Draws mutants (a comparison turned, a sign, an `and` for an `or`, a number changed ...), equally many in each room, or
in those that are named, and runs in a temporary copy of the repository the tests that execute its line, then, as long
as all pass, those of its module, and the rest of the suite. Which tests execute a line is found by one run under
coverage, kept in OUT. The working tree is not changed. Results are appended to OUT/mutants.jsonl; those that are there
are not judged again. The exit status is 1 if fewer than 90 % are caught.
"""

import functools
import json
import random
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from dora.errors import InputError, command
from dora.parallel import name_leftovers, name_of_process
from dora.progress import ProgressDisplay
from dora.tables import text_table
from dora.tools.mutation.executions import executed
from dora.tools.mutation.sites import Mutant, mutants_of
from dora.tools.mutation.trials import CAUGHT, Judge, Trial, copied, run_pytest

ROOMS = {
    "tasks": ("dora/tasks/*.py",),
    "tasks.mdp": ("dora/tasks/mdp/*.py",),
    "tasks.guidance": ("dora/tasks/guidance/*.py",),
    "tasks.env": ("dora/tasks/env/*.py",),
    "tasks.hammer": ("dora/tasks/hammer/*.py",),
    "tasks.microwave": ("dora/tasks/microwave/*.py",),
    "sim": ("dora/sim/*.py",),
    "agents": ("dora/agents/*.py",),
    "agents.collecting": ("dora/agents/collecting/*.py",),
    "agents.learners": ("dora/agents/learners/*.py",),
    "agents.evaluation": ("dora/agents/evaluation/*.py",),
    "agents.runs": ("dora/agents/runs/*.py",),
    "agents.reports": ("dora/agents/reports/*.py",),
    "affordance.maps": ("dora/affordance/maps/*.py",),
    "live": ("dora/live/*.py",),
    "datasets": ("dora/datasets/*.py",),
    "sweeps": ("dora/sweeps/*.py",),
    "policies": ("dora/policies/*.py",),
    "commands": ("dora/commands/*.py",),
    "files": ("dora/files.py", "dora/configs.py", "dora/digests.py"),
}
"""Files of the rooms whose faults are drawn, each room as often as any other. The rest (batched physics, grasp search,
robots, tools) is not drawn from: its tests compare numbers with another implementation, and take longest."""
PICTURES = ("figures.py", "films.py")
"""Modules that only draw pictures: their faults are seen, not tested."""
ENOUGH = 0.9
"""Share of the mutants that the tests have to catch."""
FILE = "mutants.jsonl"
"""File of the results: one JSON object per line."""
HEAD = ("module", "line", "before", "after", "result")
"""Head of the table of mutants."""


@dataclass
class Args:
    """Draw mutants of the source and count those that the tests catch."""

    count: int = 40
    """How many are drawn."""
    seed: int = 0
    """Seed of the draw."""
    rooms: tuple[str, ...] = ()
    """Rooms drawn from, each with the rooms inside it (`agents` with `agents.runs`); without one, all."""
    out: Path = Path("runs/mutants")
    """Folder of the results."""
    list: bool = False
    """Only print which ones are drawn."""
    coverage: bool = True
    """Begin with the tests that execute the line, which takes one run of the whole suite under coverage."""
    whole_suite: bool = True
    """Run the rest of the suite for those that survive the tests of their module."""
    again: bool = False
    """Judge survivors anew, after tests have been added."""
    limit: float = 900.0
    """Longest run of the tests of a line, or of a module [s]; a mutant that needs more while the source does not is
    caught."""
    suite_limit: float = 3600.0
    """Longest run of the rest of the suite [s]."""
    processes: int = 2
    """Worker processes of the tests; 0 runs them in one process."""


def chosen(names: Sequence[str], rooms: Mapping[str, Sequence[str]] = ROOMS) -> dict[str, Sequence[str]]:
    """Rooms that are named, each with the rooms inside it; all where none is named.

    Raises:
        InputError: there is no room of a name.
    """
    unknown = [name for name in names if not any(_is_inside(room, name) for room in rooms)]
    if unknown:
        raise InputError(f"there is no room {unknown[0]!r}; the rooms are {', '.join(rooms)}.")
    return {room: files for room, files in rooms.items() if not names or any(_is_inside(room, n) for n in names)}


def _is_inside(room: str, name: str) -> bool:
    """Whether a room is the one of a name, or inside it."""
    return f"{room}.".startswith(f"{name}.")


def drawn(root: Path, count: int, seed: int, rooms: Mapping[str, Sequence[str]] = ROOMS) -> list[Mutant]:
    """Mutants of a repository, from each room in turn: first an operator, then one of its faults in the room.

    Raises:
        InputError: fewer than `count` can be made.
    """
    generator = random.Random(seed)
    left: dict[str, list[Mutant]] = {}
    for room, patterns in rooms.items():
        files = sorted(path for each in patterns for path in root.glob(each) if path.name not in PICTURES)
        left[room] = [m for path in files for m in mutants_of(path.relative_to(root).as_posix(), path.read_text())]
    possible, found = sum(map(len, left.values())), []
    if not 1 <= count <= possible:
        raise InputError(f"between 1 and {possible} mutants can be made, not {count}.")
    while len(found) < count:
        for room in generator.sample(sorted(left), len(left)):
            if left[room] and len(found) < count:
                operator = generator.choice(sorted({mutant.operator for mutant in left[room]}))
                found.append(generator.choice([mutant for mutant in left[room] if mutant.operator == operator]))
                # a line is faulted once, so that the draw covers more
                taken = found[-1].module, found[-1].line
                left[room] = [mutant for mutant in left[room] if (mutant.module, mutant.line) != taken]
    return found


def judged(path: Path) -> dict[str, Trial]:
    """Trials by the keys of their mutants, from a file of results; the last one counts, a torn last line does not."""
    found = {}
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            entry = json.loads(line)
            found[entry["key"]] = Trial(entry["verdict"], entry["test"], entry["stages"])
        except (ValueError, KeyError, TypeError):
            continue
    return found


def _is_open(trial: Trial | None, judge: Judge, again: bool) -> bool:
    """Whether a mutant has to be judged, in view of an earlier trial."""
    if trial is None or trial.verdict == "unjudged":
        return True
    return trial.verdict == "survived" and (again or trial.stages < judge.stages)


def judge_all(mutants: Sequence[Mutant], judge: Judge, path: Path, again: bool = False) -> dict[str, Trial]:
    """Judges those mutants that a file of results does not have, and appends each to it.

    Args:
        mutants: to judge.
        judge: does it.
        path: of the file of results.
        again: judge survivors anew.
    """
    trials = judged(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_file() and not path.read_bytes().endswith(b"\n"):
        path.write_bytes(path.read_bytes() + b"\n")
    waiting = [mutant for mutant in mutants if _is_open(trials.get(mutant.key), judge, again)]
    with ProgressDisplay() as display:
        report = display.phase("mutants", "mutants")
        for number, mutant in enumerate(waiting):
            report(number, len(waiting))
            start, former = time.monotonic(), trials.get(mutant.key)
            trial = judge.judge(mutant, former.stages if former is not None and not again else 0)
            trials[mutant.key] = trial
            entry: dict[str, Any] = {"key": mutant.key, **vars(trial), "seconds": round(time.monotonic() - start, 1)}
            entry |= {name: getattr(mutant, name) for name in ("module", "line", "before", "after", "operator")}
            with path.open("a") as stream:
                stream.write(json.dumps(entry) + "\n")
            display.say(f"{mutant.module}:{mutant.line}: {mutant.after}: {result(trial)}, {entry['seconds']:.0f} s")
    return {mutant.key: trials[mutant.key] for mutant in mutants}


def result(trial: Trial) -> str:
    """A trial in words."""
    if trial.verdict == "caught":
        return f"caught by {trial.test or 'all tests'}"
    return {"timeout": "caught (timeout)", "survived": "SURVIVED", "unjudged": "tests fail or are slow anyway"}[
        trial.verdict
    ]


def rows(mutants: Iterable[Mutant], trials: Mapping[str, Trial]) -> list[Sequence[str]]:
    """Rows of the table; without a trial the operator stands in place of the result."""
    return [
        (m.module, str(m.line), m.before, m.after, result(trials[m.key]) if m.key in trials else m.operator)
        for m in mutants
    ]


@command
def main() -> int:
    """Draw, judge, and print the table; the exit status."""
    args = tyro.cli(Args, description=__doc__)
    root = Path(__file__).parents[2]
    mutants = drawn(root, args.count, args.seed, chosen(args.rooms))
    if args.list:
        print(text_table(HEAD, rows(mutants, {})))
        return 0
    name_leftovers()
    with tempfile.TemporaryDirectory(prefix=name_of_process()) as folder:
        run = functools.partial(run_pytest, processes=args.processes)
        judge = Judge(copied(root, Path(folder)), args.limit, args.suite_limit if args.whole_suite else None, run)
        if args.coverage:
            print("finding which tests execute which line ...", flush=True)
            judge.executing = executed(judge.copy, args.out, args.processes).tests
        trials = judge_all(mutants, judge, args.out / FILE, args.again)
    caught = sum(trial.verdict in CAUGHT for trial in trials.values())
    print(f"{text_table(HEAD, rows(mutants, trials))}\n{caught} of {len(mutants)} caught")
    for test in judge.left_out:
        print(f"left out, because it fails without any fault: {test}")
    return int(caught < ENOUGH * len(mutants))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
