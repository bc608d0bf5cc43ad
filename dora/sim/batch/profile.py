"""Where the time of an environment step goes: physics, reading, writing, contacts, and the rest."""

import time

PARTS = ("write", "physics", "read", "contacts")


class StepProfile:
    """Seconds spent in each of ``PARTS`` since the last `clear`.

    A batch system adds to it while it is assigned to ``env.unwrapped.scene.px.profile``; while that is
    None, measuring costs one comparison per batch operation. Wall-clock time is used because its clock is
    cheap enough to be read for every environment; other programs on the machine lengthen all parts alike,
    so the shares stay meaningful.
    """

    def __init__(self):
        self.clear()

    def clear(self) -> None:
        """Start again from zero."""
        self.seconds: dict[str, float] = {part: 0.0 for part in PARTS}
        self._last = self._started = time.perf_counter()

    def mark(self) -> None:
        """Begin to measure a part."""
        self._last = time.perf_counter()

    def add(self, part: str) -> None:
        """Count the time since the last `mark` or `add` as time of ``part``."""
        now = time.perf_counter()
        self.seconds[part] += now - self._last
        self._last = now

    @property
    def total(self) -> float:
        """Seconds since the last `clear`."""
        return time.perf_counter() - self._started

    def shares(self) -> dict[str, float]:
        """Fraction of all time since `clear` for each part; ``"other"`` is what remains."""
        total = self.total
        shares = {part: seconds / total for part, seconds in self.seconds.items()}
        shares["other"] = 1.0 - sum(shares.values())
        return shares
