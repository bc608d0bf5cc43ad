"""The loop of a sweep: begins runs while there is room, repeats those that fail, and says how it stands."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from dora.errors import InputError
from dora.sweeps.finished import Finished, finished_runs, result_of, seconds_per_step
from dora.sweeps.launching import NOT_THE_RUN, Launcher, check_folder, is_finished, is_locked, prepare, steps_of
from dora.sweeps.plan import Row

POLL_SECONDS = 1.0
"""Time between two looks at the runs [s]."""


class State(Enum):
    """How a run of a sweep stands."""

    WAITING = "waiting"
    RUNNING = "running"
    ELSEWHERE = "running (another process)"
    DONE = "done"
    FAILED = "failed"


@dataclass
class Entry:
    """A run of a sweep and how it stands.

    Attributes:
        row: the run.
        folder: in which it is trained, or that holds its result.
        state: how it stands.
        rate: time for an environment step that is expected [s].
        tries: how often it was begun or gone on with.
        complaint: what went wrong last.
        success_rate: of a finished run.
        seconds: wall time of a finished run [s].
        taken: environment steps of a finished run, fewer than its budget if it was good enough early.
        zero: it was begun here, and evaluates zero correction at its end.
    """

    row: Row
    folder: Path
    state: State = State.WAITING
    rate: float = 0.0
    tries: int = 0
    complaint: str = ""
    success_rate: float | None = None
    seconds: float | None = None
    taken: int = 0
    zero: bool = False

    @property
    def under_way(self) -> bool:
        """Whether it is being trained, here or elsewhere."""
        return self.state in (State.RUNNING, State.ELSEWHERE)

    @property
    def env_steps(self) -> int:
        """Environment steps that were taken."""
        return self.taken if self.state is State.DONE else steps_of(self.folder)

    @property
    def seconds_left(self) -> float:
        """Time that the rest is expected to take alone on the machine [s]."""
        if self.state in (State.DONE, State.FAILED):
            return 0.0
        return max(self.row.config.total_steps - self.env_steps, 0) * self.rate


@dataclass
class Sweep:
    """The runs of a sweep.

    Attributes:
        entries: the runs, in their order.
        out: folder of the sweep.
        known: folders whose finished runs count, besides `out`.
        jobs: runs at the same time.
        retries: how often a run is gone on with after it failed.
    """

    rows: Sequence[Row]
    out: Path
    known: Sequence[Path] = ()
    jobs: int = 1
    retries: int = 1
    entries: list[Entry] = field(init=False)

    def __post_init__(self) -> None:
        found = self._found(strict=True)
        self.entries = [Entry(row, self.out / row.name, rate=seconds_per_step(row, found)) for row in self.rows]
        for entry in self.entries:
            self._settle(entry, found)

    def _found(self, strict: bool = False) -> list[Finished]:
        return finished_runs((folder for folder in (self.out, *self.known) if folder.is_dir()), strict)

    @property
    def seconds_left(self) -> float:
        """Time until all runs are finished, as far as known [s]."""
        longest = max((entry.seconds_left for entry in self.entries), default=0.0)
        return max(sum(entry.seconds_left for entry in self.entries) / max(self.jobs, 1), longest)

    def count(self, state: State) -> int:
        """Number of runs that stand so."""
        return sum(entry.state is state for entry in self.entries)

    @property
    def without_zero(self) -> list[Entry]:
        """A finished run of each kind whose zero correction no finished run has, because the one that was to evaluate
        it failed or has not ended."""
        done = [e for e in self.entries if e.state is State.DONE and e.row.config.has_prior]
        told = [e for e in done if any((path / "zero.csv").is_file() for path in (e.folder, self.zero_folder(e)))]
        found = list[Entry]()
        for entry in done:
            if not any(entry.row.same_zero(other.row) for other in (*told, *found)):
                found.append(entry)
        return found

    def zero_folder(self, entry: Entry) -> Path:
        """Where zero correction of a run may be evaluated later on."""
        return self.out / "zero" / entry.row.name

    def run(self, launcher: Launcher, tell: Callable[["Sweep"], None], check: Callable[[], None]) -> None:
        """Train until every run is finished or has failed too often.

        Args:
            launcher: trains them.
            tell: called in every turn, to show how it stands.
            check: called in every turn; what it raises ends the sweep, when the runs have saved their states.

        A run whose folder turns out to be unusable later on has failed; the others go on.

        Raises:
            InputError: the folder of a run holds another one; nothing has been trained then.
        """
        for entry in self.entries:
            if entry.state is State.WAITING:
                check_folder(entry.row, entry.folder)
        try:
            while self.count(State.DONE) + self.count(State.FAILED) < len(self.entries):
                check()
                for row, complaint in launcher.ended():
                    self._note_end(row, complaint)
                self._look_elsewhere()
                self._begin(launcher)
                tell(self)
                time.sleep(POLL_SECONDS)
        finally:
            launcher.stop()
        tell(self)

    def _note_end(self, row: Row, complaint: str | None) -> None:
        entry = next(entry for entry in self.entries if entry.row is row)
        self._settle(entry, finished_runs([entry.folder], strict=False))
        if entry.state is State.DONE:
            return
        if complaint is not None and is_locked(entry.folder):  # another process was there first, and trains in it
            entry.state, entry.tries = State.ELSEWHERE, entry.tries - 1
            return
        entry.complaint = complaint or NOT_THE_RUN
        entry.state = State.WAITING if entry.tries <= self.retries else State.FAILED

    def _look_elsewhere(self) -> None:
        """Notes which runs another process trains, such as one of a sweep that was killed, and which have ended."""
        for entry in self.entries:
            if entry.state in (State.WAITING, State.ELSEWHERE):
                try:
                    locked = is_locked(entry.folder)
                    entry.state = State.ELSEWHERE if locked else State.WAITING
                    if not locked and is_finished(entry.folder):
                        self._settle(entry, finished_runs([entry.folder], strict=False))
                except (InputError, OSError) as error:  # its folder is no good; the others may be
                    entry.state, entry.complaint = State.FAILED, str(error)

    def _begin(self, launcher: Launcher) -> None:
        """Begins as many runs as there is room for."""
        for entry in self.entries:
            if self.count(State.RUNNING) + self.count(State.ELSEWHERE) >= self.jobs:
                return
            if entry.state is State.WAITING:
                try:
                    prepare(entry.row, entry.folder)
                    entry.zero = not self._has_zero(entry)
                    launcher.start(entry.row, entry.folder, entry.zero)
                except (InputError, OSError) as error:  # its folder is no good; the others may be
                    entry.state, entry.complaint = State.FAILED, str(error)
                else:
                    entry.state, entry.tries = State.RUNNING, entry.tries + 1

    def _has_zero(self, entry: Entry) -> bool:
        """Whether zero correction has been evaluated, or is, on the starts and in the task of a run: whatever learns
        there and with whatever seed, it is the same, and reports take it from there."""
        alike = (other for other in self.entries if other.row.same_zero(entry.row) and other is not entry)
        return any(
            (other.folder / "zero.csv").is_file() if other.state is State.DONE else other.under_way and other.zero
            for other in alike
        )

    def _settle(self, entry: Entry, found: Sequence[Finished]) -> None:
        """Notes the result of a run, if there is one."""
        one = result_of(entry.row, found)
        if one is not None:
            entry.state, entry.folder = State.DONE, one.folder
            entry.success_rate, entry.seconds, entry.taken = one.success_rate, one.seconds, one.env_steps
