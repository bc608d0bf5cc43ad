"""Which runs of a sweep are finished, whichever command made them, and how long the others will take."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

from dora.agents.runs.stored_results import read_result
from dora.errors import InputError
from dora.files import files_under
from dora.sweeps.plan import Row

EXPECTED = {"DoraCube-v1": 1.1e-3, "DoraJug-v1": 1.9e-3, "DoraHammer-v1": 3.4e-3, "DoraMicrowave-v1": 3.3e-3}
"""Time for an environment step of each task, evaluations included, on two idle cores, where no run tells it [s]."""
UNKNOWN = 3e-3
"""The same of other tasks [s]."""


@dataclass(frozen=True)
class Finished:
    """A finished run.

    Attributes:
        folder: that holds its result.json.
        env: task.
        agent: learner.
        digest: of its settings.
        budget: environment steps for which it was meant.
        env_steps: those that it took; fewer if it was good enough early.
        seconds: wall time, evaluations included [s].
        success_rate: [1].
    """

    folder: Path
    env: str
    agent: str
    digest: str
    budget: int
    env_steps: int
    seconds: float
    success_rate: float


def finished_runs(folders: Iterable[Path], strict: bool = True) -> list[Finished]:
    """The finished runs under some folders that were trained, not only evaluated.

    Args:
        folders: with run folders in them.
        strict: refuse a damaged result.json; else it is no finished run.

    Raises:
        InputError: a result.json is damaged.
    """
    found = []
    for path in sorted({path for folder in folders for path in files_under(folder, "result.json")}):
        try:
            result = read_result(path)
        except InputError:
            if strict:
                raise
            continue
        if result is None or result.get("checkpoint") or not result["env_steps"]:
            continue
        found.append(
            Finished(
                path.parent, result["env"], result["agent"], str(result.get("config_digest")),
                result.get("total_steps", result["env_steps"]), result["env_steps"], result["wall_seconds"],
                result["success_rate"],
            )
        )  # fmt: skip
    return found


def result_of(row: Row, found: Sequence[Finished]) -> Finished | None:
    """A finished run with the settings and the budget of a run of the sweep."""
    digests = row.digests
    fitting = (one for one in found if one.digest in digests and one.budget == row.config.total_steps)
    return next(fitting, None)


def seconds_per_step(row: Row, found: Sequence[Finished]) -> float:
    """Time that an environment step of a run takes, evaluations included, from runs of the task and learner, else of
    the task, else as once measured [s]."""
    known = [one for one in found if one.env == row.config.env]
    same = [one for one in known if one.agent == row.config.agent] or known
    if same:
        return mean(one.seconds / one.env_steps for one in same)
    return EXPECTED.get(row.config.env, UNKNOWN)
