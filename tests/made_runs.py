"""Finished runs that are made up without files, for tests of reports."""

from pathlib import Path
from typing import Any

import numpy as np

from dora.agents.reports.comparison import sections
from dora.agents.reports.run_results import Run


def made(
    guidance: str = "affordance", rate: float = 0.5, env: str = "DoraJug-v1", agent: str = "ppo", **more: Any
) -> Run:
    """A finished run; `curve`, `episodes`, `zero` and `outdated` are those of `Run`, all else of its result."""
    own = {name: more.pop(name) for name in ("curve", "episodes", "zero", "outdated") if name in more}
    result = {
        "env": env, "agent": agent, "guidance": guidance, "preset": "standard", "seed": 10, "env_steps": 1000,
        "total_steps": 1000, "wall_seconds": 600.0, "success_rate": rate, "zero_success_rate": None,
        "penetration_p95_mm": None, "eval_episodes": 4, "first_seed": 5,
    }  # fmt: skip
    return Run(Path(f"{env}-{agent}-{guidance}"), result | more, own.pop("curve", []), **own)


def of(*values: float) -> dict[str, np.ndarray]:
    """Episodes that end so."""
    return {"success": np.array(values, float)}


def rows(runs: list[Run], title: str) -> list[list[str]]:
    """Those of the section whose title begins so; none where there is no such section."""
    return next((section.rows for section in sections(runs) if section.title.startswith(title)), [])
