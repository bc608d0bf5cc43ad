"""Sweeps of runs that a fake process stands in for."""

import json
from pathlib import Path

from fake_run import STARTS, fake_words

from dora.sweeps.launching import LocalLauncher
from dora.sweeps.plan import Row, rows_of
from dora.sweeps.sweep import State, Sweep


def fake(mode: str) -> LocalLauncher:
    """Trains with the process that stands in for a run."""
    return LocalLauncher(lambda folder, zero: fake_words(folder, mode))


def few(count: int = 3) -> list[Row]:
    return rows_of("paper", envs=["DoraCube-v1"], agents=["ppo"], guidance=["affordance"], seeds=range(count))


def result(row: Row, folder: Path, **other: object) -> None:
    """Writes the result of a finished run."""
    content = {
        "env": row.config.env, "agent": row.config.agent, "guidance": row.config.guidance, "wall_seconds": 600.0,
        "env_steps": row.config.total_steps, "success_rate": 0.75, "zero_success_rate": None,
        "penetration_p95_mm": None, "config_digest": row.config.digest(), "total_steps": row.config.total_steps,
        "finished": True,
    } | other  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps(content))


def states(sweep: Sweep) -> list[State]:
    return [entry.state for entry in sweep.entries]


def starts(sweep: Sweep) -> list[int]:
    """How often each run was begun."""
    return [len((sweep.out / entry.row.name / STARTS).read_text()) for entry in sweep.entries]


def nothing(*_: object) -> None:
    pass
