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


class ContactImpulses:
    """Impulses between pairs and on bodies that somebody asked for, from one pass over the contacts of a step.

    The sums are made in the order and precision of ManiSkill's single CPU environment (points in float32, contacts
    in float64), so that the results are equal bit for bit. No contact is kept: SAPIEN frees them in the next step.
    """

    def __init__(self, readers: Sequence[Callable[[], list]]):
        self._readers = list(readers)
        self._pairs: dict[tuple[int, int], tuple[int, float]] = {}
        self._bodies: dict[int, int] = {}
        self._kept_alive: list[Any] = []
        self._impulses = np.zeros((0, 3))
        self._read_at = -1

    def pairs(self, pairs: Sequence[BodyPair]) -> PairImpulses:
        """A query for pairs of bodies (of the same environment each)."""
        found = [self._pair_slot(first, second) for first, second in pairs]
        return PairImpulses([slot for slot, _ in found], [sign for _, sign in found])

    def bodies(self, bodies: Sequence[Any]) -> BodyImpulses:
        """A query for the net impulses on bodies."""
        return BodyImpulses([self._body_slot(body) for body in bodies])

    def answer(self, query: PairImpulses, epoch: int) -> None:
        """Fill in the query's result; contacts are read once per epoch."""
        if epoch != self._read_at:
            self._read()
            self._read_at = epoch
        query.cuda_impulses.set(self._impulses[query.slots] * query.signs + 0.0)  # + 0: no negative zeros

    def _new_slot(self, *bodies: Any) -> int:
        self._kept_alive.extend(bodies)
        self._impulses = np.concatenate([self._impulses, np.zeros((1, 3))])
        self._read_at = -1
        return len(self._impulses) - 1

    def _pair_slot(self, first: Any, second: Any) -> tuple[int, float]:
        key = (id(first), id(second))
        if key not in self._pairs:
            slot = self._new_slot(first, second)
            self._pairs[key], self._pairs[key[::-1]] = (slot, 1.0), (slot, -1.0)
        return self._pairs[key]

    def _body_slot(self, body: Any) -> int:
        if id(body) not in self._bodies:
            self._bodies[id(body)] = self._new_slot(body)
        return self._bodies[id(body)]

    def _read(self) -> None:
        self._impulses[:] = 0.0
        for read in self._readers:
            for contact in read():
                first, second = contact.bodies
                self._add(contact, id(first), id(second))

    def _add(self, contact: Any, first: int, second: int) -> None:
        pair = self._pairs.get((first, second))
        signed = [] if pair is None else [pair]
        if first in self._bodies:
            signed.append((self._bodies[first], 1.0))
        if second in self._bodies:
            signed.append((self._bodies[second], -1.0))
        if signed and (points := contact.points):
            impulse = np.add.reduce([point.impulse for point in points])
            for slot, sign in signed:
                self._impulses[slot] += sign * impulse
