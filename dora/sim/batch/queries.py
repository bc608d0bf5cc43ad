"""Contact impulse queries with the interface of SAPIEN's GPU queries, answered from CPU contact lists."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

BodyPair = tuple[Any, Any]


class _Impulses:
    """Result of a query; ``torch()`` is a float32 tensor (rows, 3) in N s, as of the last time it was asked."""

    def __init__(self, rows: int):
        self._values = torch.zeros(rows, 3)

    def set(self, values: np.ndarray) -> None:
        """Store float64 values (rows, 3)."""
        self._values = torch.from_numpy(values.astype(np.float32))

    def torch(self) -> torch.Tensor:
        """Impulses [N s], world frame, shape (rows, 3)."""
        return self._values


class PairImpulses:
    """Impulse on the first body of each pair by the second, in the last physics step."""

    def __init__(self, slots: Sequence[int], signs: Sequence[float]):
        self.slots = np.array(slots, np.int64)
        self.signs = np.array(signs)[:, None]
        self.cuda_impulses = _Impulses(len(slots))


class BodyImpulses(PairImpulses):
    """Net impulse on each body by all others, in the last physics step."""

    def __init__(self, slots: Sequence[int]):
        super().__init__(slots, [1.0] * len(slots))


class ContactScanner:
    """Looks at the contacts of every environment at most once per physics step, and only if somebody asks.

    If the contacts of the last step were asked for, those of the next are scanned right after it,
    environment by environment. No contact is kept: SAPIEN frees them in the next step. Subclasses say what
    to `clear` and what to `take` from a contact.
    """

    def __init__(self, readers: Sequence[Callable[[], list]]):
        self._readers = list(readers)
        self._scanned = False
        self._asked = False

    def clear(self) -> None:
        """Forget what was taken."""
        raise NotImplementedError

    def take(self, environment: int, contacts: list) -> None:
        """Take what matters from the contacts of an environment."""
        raise NotImplementedError

    def begin_step(self) -> bool:
        """Forget the contacts; True if those of the coming step shall be scanned at once."""
        self._scanned, self._asked = self._asked, False
        self.clear()
        return self._scanned

    def scan(self, environment: int) -> None:
        """Scan the contacts of one environment."""
        self.take(environment, self._readers[environment]())

    def scan_missing(self) -> None:
        """Scan all environments unless that was done since the last step."""
        self._asked = True
        if not self._scanned:
            self.clear()
            for environment in range(len(self._readers)):
                self.scan(environment)
            self._scanned = True


class ContactImpulses(ContactScanner):
    """Impulses between pairs and on bodies that somebody asked for.

    The sums are made in the order and precision of ManiSkill's single CPU environment (points in float32,
    contacts in float64), so that the results are equal bit for bit.
    """

    def __init__(self, readers: Sequence[Callable[[], list]]):
        super().__init__(readers)
        self._pairs: dict[tuple[int, int], tuple[int, float]] = {}
        self._bodies: dict[int, int] = {}
        self._kept_alive: list[Any] = []
        self._impulses = np.zeros((0, 3))

    def pairs(self, pairs: Sequence[BodyPair]) -> PairImpulses:
        """A query for pairs of bodies (of the same environment each)."""
        found = [self._pair_slot(first, second) for first, second in pairs]
        return PairImpulses([slot for slot, _ in found], [sign for _, sign in found])

    def bodies(self, bodies: Sequence[Any]) -> BodyImpulses:
        """A query for the net impulses on bodies."""
        return BodyImpulses([self._body_slot(body) for body in bodies])

    def answer(self, query: PairImpulses) -> None:
        """Fill in the query's result, after `scan_missing`."""
        query.cuda_impulses.set(self._impulses[query.slots] * query.signs + 0.0)  # + 0: no negative zeros

    def clear(self) -> None:
        """Set all impulses to zero."""
        self._impulses[:] = 0.0

    def take(self, environment: int, contacts: list) -> None:
        """Add up the impulses of the contacts that a query is about."""
        pairs, bodies = self._pairs, self._bodies
        for contact in contacts:
            first, second = contact.bodies
            first, second = id(first), id(second)
            if (first, second) in pairs or first in bodies or second in bodies:
                self._add(contact, first, second)

    def _add(self, contact: Any, first: int, second: int) -> None:
        points = contact.points
        if not points:
            return
        impulse = np.add.reduce([point.impulse for point in points])
        slot, sign = self._pairs.get((first, second), (None, 0.0))
        for found, signed in ((slot, sign), (self._bodies.get(first), 1.0), (self._bodies.get(second), -1.0)):
            if found is not None:
                self._impulses[found] += signed * impulse

    def _new_slot(self, *bodies: Any) -> int:
        self._kept_alive.extend(bodies)
        self._impulses = np.concatenate([self._impulses, np.zeros((1, 3))])
        self._scanned = False
        return len(self._impulses) - 1

    def _pair_slot(self, first: Any, second: Any) -> tuple[int, float]:
        key = (id(first), id(second))
        if key not in self._pairs:
            slot = self._new_slot(first, second)
            self._pairs[key], self._pairs[id(second), id(first)] = (slot, 1.0), (slot, -1.0)
        return self._pairs[key]

    def _body_slot(self, body: Any) -> int:
        if id(body) not in self._bodies:
            self._bodies[id(body)] = self._new_slot(body)
        return self._bodies[id(body)]
