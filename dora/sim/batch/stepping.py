"""Order of writes, physics steps and reads, one environment after the other within a control step, and their times."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien

from dora.sim.batch.packed import PackedSource
from dora.sim.batch.queries import ContactImpulses, ContactScanner

SAFE = 1e14
"""Sum of squares of poses in an environment that PhysX still steps [m^2]; false for NaN and infinity."""
PARTS = ("write", "physics", "read", "contacts")
"""Names of the parts of a step that are timed."""
Setters = Sequence[Callable[[float], None]]
"""Functions that set one value each."""


class TargetQueue:
    """Queue of drive targets that are set before the next physics step of their environment."""

    def __init__(self, environments: int):
        self._edges = np.arange(environments + 1)
        self._batches: list[tuple[Setters, list[int], list[float], list[int]]] = []

    def __len__(self) -> int:
        return len(self._batches)

    def add(self, setters: Setters, numbers: np.ndarray, values: np.ndarray, environments: np.ndarray) -> None:
        """Queue the calls ``setters[numbers[k]](values[k])`` for the environments ``environments[k]``."""
        order = np.argsort(environments, kind="stable")
        edges = np.searchsorted(environments[order], self._edges)
        self._batches.append((setters, numbers[order].tolist(), values[order].tolist(), edges.tolist()))

    def write(self, environment: int) -> None:
        """Make the queued calls of one environment, in the order of their addition."""
        for setters, numbers, values, edges in self._batches:
            part = slice(edges[environment], edges[environment + 1])
            for number, value in zip(numbers[part], values[part], strict=True):
                setters[number](value)

    def clear(self) -> None:
        """Empty the queue, after all environments were written."""
        self._batches.clear()


class Stepper:
    """Steps the simulators of all environments and keeps the values read from them current.

    The processor's caches hold one environment but not all of them. All work on an environment in a control step is
    therefore done at once: its drive targets are set, all its physics steps are made, its state and contacts are
    read; then the next environment follows. `defer` delays writes and steps to that end. Environments do not
    interact, so results do not depend on this order.

    Each of `watchers` is called with the index of an environment after each of its physics steps, and each of
    `contact_watchers` with the contacts of that step as well. Each of `droppers` is called with the index of an
    environment whose contacts since the last control step do not count.
    """

    def __init__(self, scenes: Sequence[sapien.Scene]):
        systems: list[Any] = [scene.physx_system for scene in scenes]
        self.poses = PackedSource([scene.pack_poses for scene in scenes])
        self.state = PackedSource([system.pack for system in systems])
        self._read_contacts = [system.get_contacts for system in systems]
        self.contacts = ContactImpulses(self._read_contacts)
        self.scanners: list[ContactScanner] = []
        self.droppers: list[Callable[[int], None]] = []
        self.watchers: list[Callable[[int], None]] = []
        self.contact_watchers: list[Callable[[int, list], None]] = []
        self.profile: StepProfile | None = None
        self.resized: Callable[[], None] = lambda: None
        self._steps = [system.step for system in systems]
        self._read_poses = [scene.pack_poses for scene in scenes]
        self._targets = TargetQueue(len(systems))
        self._epoch = 0
        self._stale = True
        self._targets_stale = False
        self._waiting = 0
        self._limit = 0
        self._muted: set[int] = set()
        self.add_scanner(self.contacts)

    def add_scanner(self, scanner: ContactScanner) -> None:
        """Scan contacts also with this scanner, environment by environment."""
        scanner.muted = self._muted
        self.scanners.append(scanner)

    def epoch(self) -> int:
        """A counter that changes whenever the state of a simulator may have changed."""
        return self._epoch

    def defer(self, steps: int) -> None:
        """Defer drive targets and up to ``steps`` physics steps until a value is read or set in another way.

        While steps are pending, SAPIEN objects must not be used directly. ``defer(0)``, the initial setting, executes
        everything pending and defers nothing.
        """
        self._limit = steps
        if not steps:
            self.flush()

    def step(self) -> None:
        """Advance every environment by one physics step."""
        self._waiting += 1
        self._epoch += 1
        self._stale = True
        self.poses.invalidate_all()
        self.state.invalidate_all()
        if self._waiting >= self._limit:
            self.flush()

    def flush(self) -> None:
        """Execute all pending writes and steps."""
        if not self._waiting and not self._targets:
            return
        steps, self._waiting = range(self._waiting), 0
        if steps:
            self._advance(steps, sources=(self.poses, self.state) if self._limit else ())
        else:
            for environment in range(len(self._steps)):
                self._targets.write(environment)
        self._targets.clear()

    def _advance(self, steps: range, sources: Sequence[PackedSource]) -> None:
        """Set targets, make steps and read ``sources``, one environment after the other."""
        profile, targets = self.profile, self._targets
        self._muted.clear()
        scanners = [scanner for scanner in self.scanners if scanner.begin_step()]
        if profile:
            profile.mark()
        for environment, step in enumerate(self._steps):
            targets.write(environment)
            if profile:
                profile.add("write")
            for number in steps:
                if not (number == 0 and self._limit) and not self._is_safe(environment):
                    break
                step()
                for watch in self.watchers:
                    watch(environment)
                if self.contact_watchers:
                    if profile:
                        profile.add("physics")
                    contacts = self._read_contacts[environment]()
                    for look in self.contact_watchers:
                        look(environment, contacts)
                    if profile:
                        profile.add("contacts")
            if profile:
                profile.add("physics")
            for source in sources:
                source.read(environment)
            if profile:
                profile.add("read")
            for scanner in scanners:
                scanner.scan(environment)
            if profile:
                profile.add("contacts")

    def _is_safe(self, environment: int) -> bool:
        """Whether all poses are finite and near: PhysX may crash on others. At the beginning of a control step whose
        steps are deferred they are known to be, because `StateGuard` has looked at them."""
        poses = np.frombuffer(self._read_poses[environment](), np.float32)
        return bool(poses.dot(poses) < SAFE)

    def refresh(self) -> None:
        """Execute all pending writes and steps, and read what is out of date."""
        if not self._stale:
            return
        self.flush()
        if self.profile:
            self.profile.mark()
        resized = self.poses.refresh(), self.state.refresh()
        self._stale = False
        if self.profile:
            self.profile.add("read")
        if any(resized):
            self.resized()

    def refresh_targets(self) -> None:
        """`refresh` for drive targets, whose writing changes no other value of the packed state."""
        if self._targets_stale:
            self.flush()
            self.state.invalidate_all()
            self._stale, self._targets_stale = True, False
        self.refresh()

    def scan_contacts(self, scanner: ContactScanner) -> None:
        """Execute all pending steps and scan the contacts, unless they were scanned since the last physics step."""
        self.flush()
        if self.profile:
            self.profile.mark()
        scanner.scan_missing()
        if self.profile:
            self.profile.add("contacts")

    def changed(self, environments: Iterable[int]) -> None:
        """Declare all values of some environments out of date."""
        self._epoch += 1
        self._stale = True
        self.poses.invalidate(environments)
        self.state.invalidate(environments)

    def discard(self, environment: int) -> None:
        """Declare the values of an environment out of date, and drop its contacts until its next physics step."""
        self._muted.add(environment)
        for scanner in self.scanners:
            scanner.forget()
        for drop in self.droppers:
            drop(environment)
        self.changed([environment])

    def set_targets(self, setters: Setters, numbers: np.ndarray, values: np.ndarray, environments: np.ndarray) -> None:
        """Call ``setters[numbers[k]](values[k])`` for environment ``environments[k]``, now or before its next step.
        Steps that are pending are executed with the targets of before."""
        if self._waiting:
            self.flush()
        self._targets.add(setters, numbers, values, environments)
        self._targets_stale = True
        if not self._limit:
            self.flush()

    @contextmanager
    def writing(self, environments: Sequence[int]) -> Iterator[None]:
        """Context for direct changes of environments: executes pending steps before, declares them changed after."""
        self.flush()
        if self.profile:
            self.profile.mark()
        yield
        if self.profile:
            self.profile.add("write")
        self.changed(environments)


class StepProfile:
    """Wall-clock time [s] spent in each of ``PARTS`` since the last `clear`.

    Assign it to ``env.unwrapped.scene.px.profile``; while that is None, profiling costs one comparison per batch
    operation. Wall-clock time is used because its clock can be read for every environment at little cost; other
    programs on the machine lengthen all parts alike, so the shares stay meaningful.
    """

    def __init__(self):
        self.clear()

    def clear(self) -> None:
        """Set all times to zero."""
        self.seconds: dict[str, float] = {part: 0.0 for part in PARTS}
        self._last = self._started = time.perf_counter()

    def mark(self) -> None:
        """Start the clock of the next part."""
        self._last = time.perf_counter()

    def add(self, part: str) -> None:
        """Add the time since the last `mark` or `add` to ``part``."""
        now = time.perf_counter()
        self.seconds[part] += now - self._last
        self._last = now

    @property
    def total(self) -> float:
        """Time since the last `clear` [s]."""
        return time.perf_counter() - self._started

    def shares(self) -> dict[str, float]:
        """Share of the time since `clear` by part [1]; ``"other"`` is the remainder."""
        total = self.total
        shares = {part: seconds / total for part, seconds in self.seconds.items()}
        shares["other"] = 1.0 - sum(shares.values())
        return shares
