"""Profile of the time of environment steps: physics, reading, writing, contacts, and the rest."""

import time

PARTS = ("write", "physics", "read", "contacts")
"""Names of the parts of a step that are timed."""


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
