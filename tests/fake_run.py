"""Stands in for `dora run --resume FOLDER` in tests of sweeps: notes that it was begun, and writes a result.

    python fake_run.py FOLDER MODE RESULT

MODE: "well" ends at once; "slow" takes two seconds and ends early when it is interrupted; "fails" and "fails-once" end
with a line and status 1, the latter only for the first time. RESULT is the content of the result.json.
"""

import fcntl
import json
import os
import signal
import sys
import time
from pathlib import Path

TURNS, SECONDS = 20, 0.1
"""Steps of a slow run, and the time that each takes [s]."""
STARTS, PARENT = "starts", "parent"
"""Files: one letter for each time that the run was begun; the process that began it last."""


def fake_words(folder: Path, mode: str) -> list[str]:
    """The process that does in a folder with settings what the mode says."""
    from dora.agents.runs.run_folder import RunFolder

    c = RunFolder(folder).read_config()
    result = {
        "env": c.env, "agent": c.agent, "guidance": c.guidance, "env_steps": c.total_steps, "wall_seconds": 600.0,
        "success_rate": 0.5, "zero_success_rate": None, "penetration_p95_mm": None, "config_digest": c.digest(),
        "total_steps": c.total_steps, "finished": True,
    }  # fmt: skip
    return [sys.executable, __file__, str(folder), mode, json.dumps(result)]


def main(folder: Path, mode: str, result: str) -> int:
    """The exit status of the run."""
    lock = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with (folder / STARTS).open("a") as starts:
        starts.write("x")
    (folder / PARENT).write_text(str(os.getppid()))
    if mode == "fails" or (mode == "fails-once" and (folder / STARTS).read_text() == "x"):
        print("the disk is full")
        return 1
    interrupted = []
    signal.signal(signal.SIGINT, lambda *_: interrupted.append(True))
    for turn in range(TURNS if mode == "slow" else 1):
        (folder / "progress.csv").write_text(f"env_steps,seconds\n{turn + 1},{turn * SECONDS}\n")
        if interrupted:
            return 130
        time.sleep(SECONDS if mode == "slow" else 0.0)
    for name in ("eval.csv", "zero.csv"):
        (folder / name).write_text("episode,success\n0,1\n")
    (folder / "half").write_text(result)
    (folder / "half").rename(folder / "result.json")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), *sys.argv[2:]))
