"""Writes, steps and reads the environments, one after the other."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import sapien
from sapien import physx

from dora.sim.batch.packed import PackedSource
from dora.sim.batch.queries import ContactImpulses
from dora.sim.profile import StepProfile

Setters = Sequence[Callable[[float], None]]


class TargetQueue:
    """Drive targets that wait for the next physics step of their environment."""

    def __init__(self, environments: int):
        self._edges = np.arange(environments + 1)
        self._batches: list[tuple[Setters, list[int], list[float], list[int]]] = []

    def __len__(self) -> int:
        return len(self._batches)

    def add(self, setters: Setters, numbers: np.ndarray, values: np.ndarray, environments: np.ndarray) -> None:
        """Let ``setters[numbers[k]](values[k])`` wait for environment ``environments[k]``."""
        order = np.argsort(environments, kind="stable")
        edges = np.searchsorted(environments[order], self._edges)
        self._batches.append((setters, numbers[order].tolist(), values[order].tolist(), edges.tolist()))

    def write(self, environment: int) -> None:
        """Set what waits for one environment, in the order in which it came."""
        for setters, numbers, values, edges in self._batches:
            part = slice(edges[environment], edges[environment + 1])
            for number, value in zip(numbers[part], values[part], strict=True):
                setters[number](value)

    def clear(self) -> None:
        """Forget everything, after all environments were written."""
        self._batches.clear()


class Stepper:
    """Keeps the simulators of all environments and what was read of them in step.

    The processor's caches hold one environment but not all of them, so everything that has to be done with an
    environment in a control step is done at one go: its drive targets are set, all its physics steps made, its state
    and its contacts read; then comes the next. To that end `defer` lets writes and steps wait. Environments do not
    interact, so results do not depend on this order.
    """

    def __init__(self, scenes: Sequence[sapien.Scene]):
        systems: list[physx.PhysxCpuSystem] = [scene.physx_system for scene in scenes]
        self.poses = PackedSource([scene.pack_poses for scene in scenes])
        self.state = PackedSource([system.pack for system in systems])
        self.contacts = ContactImpulses([system.get_contacts for system in systems])
        self.profile: StepProfile | None = None
        self.resized: Callable[[], None] = lambda: None
        self._steps = [system.step for system in systems]
        self._targets = TargetQueue(len(systems))
        self._epoch = 0
        self._stale = True
        self._targets_stale = False
        self._waiting = 0
        self._limit = 0

    def epoch(self) -> int:
        """A number that changes whenever anything may have changed in the simulators."""
        return self._epoch

    def defer(self, steps: int) -> None:
        """Let drive targets and up to ``steps`` physics steps wait until a value is read or set otherwise.

        While they wait, sapien objects must not be used directly. ``defer(0)``, the initial setting, makes up for
        all that waits and lets nothing wait.
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
        """Do all that waits."""
        if not self._waiting and not self._targets:
            return
        steps, self._waiting = range(self._waiting), 0
        if not steps:
            self._write_all()
        elif self.profile is None:
            self._advance_all(steps, read=self._limit > 0)
        else:
            self._advance_all_measured(steps, self.profile, read=self._limit > 0)
        self._targets.clear()
        if steps:
            self.contacts.forget()

    def _write_all(self) -> None:
        for environment in range(len(self._steps)):
            self._targets.write(environment)

    def _advance_all(self, steps: range, read: bool) -> None:
        write, read_poses, read_state = self._targets.write, self.poses.read, self.state.read
        for environment, step in enumerate(self._steps):
            write(environment)
            for _ in steps:
                step()
            if read:
                read_poses(environment)
                read_state(environment)

    def _advance_all_measured(self, steps: range, profile: StepProfile, read: bool) -> None:
        profile.mark()
        for environment, step in enumerate(self._steps):
            self._targets.write(environment)
            profile.add("write")
            for _ in steps:
                step()
            profile.add("physics")
            if read:
                self.poses.read(environment)
                self.state.read(environment)
                profile.add("read")
