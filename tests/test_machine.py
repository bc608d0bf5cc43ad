"""How busy other programs keep the machine, told apart from this one and what it has started."""

import subprocess
import sys
import time
from typing import Any

import psutil
import pytest

from dora.agents.runs.machine import OtherLoad, own_seconds

SPIN = "import time; end = time.process_time() + {}\nwhile time.process_time() < end: pass"
"""Program that takes so much processor time [s]."""
TICK = 0.1
"""Processor times are known to some ticks of the system [s]."""


def test_own_work_and_that_of_children_is_own():
    before = own_seconds()
    subprocess.run([sys.executable, "-c", SPIN.format(0.5)], check=True)
    after = own_seconds()
    assert after - before >= 0.5 - TICK
    exec(SPIN.format(0.3))
    assert own_seconds() - after >= 0.3 - TICK


def test_work_of_a_child_that_goes_on_is_own():
    before = own_seconds()
    with subprocess.Popen([sys.executable, "-c", SPIN.format(60)]) as child:
        process: Any = psutil.Process(child.pid)
        while process.cpu_times().user < 0.4:
            time.sleep(0.05)
        used = own_seconds() - before
        child.kill()
    assert used >= 0.4 - TICK


def test_work_of_others_is_not():
    load = OtherLoad()
    # The shell ends at once, so that the program is nobody's child.
    program = f'"{sys.executable}" -c "{SPIN.format(1.0)}" & echo $!'
    pid = int(subprocess.run(["sh", "-c", program], capture_output=True, text=True, check=True).stdout)
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        time.sleep(0.05)
    assert load.seconds() >= 1.0 - TICK


def test_each_call_tells_of_the_time_since_the_last_one(monkeypatch: pytest.MonkeyPatch):
    """The clock of others may run back a little, because two clocks are subtracted: that is no work."""
    totals = iter([5.0, 7.5, 7.25, 8.0])
    monkeypatch.setattr(OtherLoad, "_others", lambda _: next(totals))
    load = OtherLoad()
    assert [load.seconds() for _ in range(3)] == [2.5, 0.0, 0.75]
