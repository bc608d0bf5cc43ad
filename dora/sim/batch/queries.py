"""Contact impulse queries with the interface of SAPIEN's GPU queries, evaluated on CPU contact lists."""

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
import torch

BodyPair = tuple[Any, Any]
"""Two SAPIEN bodies of one environment."""


class _Impulses:
    """Result (rows, 3) of a query as of its last evaluation, with the interface of a `sapien.CudaArray`."""

    def __init__(self, rows: int):
        self._values = torch.zeros(rows, 3)

    def set(self, values: np.ndarray) -> None:
        """Store float64 values (rows, 3)."""
        self._values = torch.from_numpy(values.astype(np.float32))

    def torch(self) -> torch.Tensor:
        """(rows, 3) impulses in the world frame [N s], float32."""
        return self._values


class PairImpulses:
    """Query of the impulse on the first body of each pair by the second, in the last physics step [N s]."""

    def __init__(self, slots: Sequence[int], signs: Sequence[float]):
        self.slots = np.array(slots, np.int64)
        self.signs = np.array(signs)[:, None]
        self.cuda_impulses = _Impulses(len(slots))


class BodyImpulses(PairImpulses):
    """Query of the net impulse on each body by all others, in the last physics step [N s]."""

    def __init__(self, slots: Sequence[int]):
        super().__init__(slots, [1.0] * len(slots))


class ContactScanner:
    """Scans the contacts of every environment at most once per physics step, and only on demand.

    If the contacts of the last step were asked for, those of the next step are scanned right after it,
    environment by environment. Contact objects are not kept, because SAPIEN frees them in the next step. Environments
    in `muted` have none. Subclasses implement `clear` and `take`.
    """

    def __init__(self, readers: Sequence[Callable[[], list]]):
        self.muted: Collection[int] = ()
        self._readers = list(readers)
        self._scanned = False
        self._asked = False

    def clear(self) -> None:
        """Drop the results of earlier scans."""
        raise NotImplementedError

    def take(self, environment: int, contacts: list) -> None:
        """Process the contacts of one environment."""
        raise NotImplementedError

    def begin_step(self) -> bool:
        """Drop the results before a physics step; returns True if its contacts are to be scanned right after it."""
        self._scanned, self._asked = self._asked, False
        self.clear()
        return self._scanned

    def scan(self, environment: int) -> None:
        """Scan the contacts of one environment."""
        if environment not in self.muted:
            self.take(environment, self._readers[environment]())

    def forget(self) -> None:
        """Scan all environments again when the contacts are next asked for."""
        self._scanned = False

    def scan_missing(self) -> None:
        """Scan all environments unless they were scanned since the last step."""
        self._asked = True
        if not self._scanned:
            self.clear()
            for environment in range(len(self._readers)):
                self.scan(environment)
            self._scanned = True


class ContactImpulses(ContactScanner):
    """Impulses between the pairs and on the bodies of all queries.

    Sums have the order and precision of ManiSkill's single CPU environment (points in float32, contacts in
    float64), so that the results are equal bit for bit.
    """

    def __init__(self, readers: Sequence[Callable[[], list]]):
        super().__init__(readers)
        self._pairs: dict[tuple[int, int], tuple[int, float]] = {}
        self._bodies: dict[int, int] = {}
        self._kept_alive: list[Any] = []
        self._impulses = np.zeros((0, 3))

    def pairs(self, pairs: Sequence[BodyPair]) -> PairImpulses:
        """A query for pairs of bodies, each pair of one environment."""
        found = [self._pair_slot(first, second) for first, second in pairs]
        return PairImpulses([slot for slot, _ in found], [sign for _, sign in found])

    def bodies(self, bodies: Sequence[Any]) -> BodyImpulses:
        """A query for the net impulses on bodies."""
        return BodyImpulses([self._body_slot(body) for body in bodies])

    def answer(self, query: PairImpulses) -> None:
        """Write the result of a query, after `scan_missing`."""
        query.cuda_impulses.set(self._impulses[query.slots] * query.signs + 0.0)  # + 0 avoids negative zeros

    def clear(self) -> None:
        """Set all impulses to zero."""
        self._impulses[:] = 0.0

    def take(self, environment: int, contacts: list) -> None:
        """Sum up the impulses of those contacts that belong to a query."""
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
