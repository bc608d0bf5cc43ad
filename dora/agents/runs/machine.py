"""How busy other programs keep the machine while something is timed."""

import contextlib

import psutil

BUSY = ("user", "nice", "system", "irq", "softirq")
"""Kinds of processor time that are work [s]."""


class OtherLoad:
    """Processor time that other programs take, from when it is made; what other virtual machines take is not seen."""

    def __init__(self) -> None:
        self._last = self._others()

    def seconds(self) -> float:
        """Processor time of other programs since the last call, or since it was made [s]; never negative."""
        now, before = self._others(), self._last
        self._last = now
        return max(now - before, 0.0)

    @staticmethod
    def _others() -> float:
        total = psutil.cpu_times()
        busy = sum(getattr(total, kind, 0.0) for kind in BUSY)
        return busy - own_seconds()


def own_seconds() -> float:
    """Processor time of this process and of all that it has started [s]."""
    used, this = 0.0, psutil.Process()
    for process in (this, *this.children(recursive=True)):
        with contextlib.suppress(psutil.Error):  # it has ended: its time is that of children of its parent now
            t = process.cpu_times()
            used += t.user + t.system + getattr(t, "children_user", 0.0) + getattr(t, "children_system", 0.0)
    return used
