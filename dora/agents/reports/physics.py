"""Trained policies under other physics than that of their training: does what they do depend on the time step?"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dora.agents.reports.run_results import Group, Run, grouped, seeds_of
from dora.agents.reports.section import NONE, OVERLAP, TOO_NARROW, Section, rate_of, success_of, with_interval
from dora.agents.reports.statistics import difference_of_pairs

PHYSICS = ("physics_frequency", "solver_iterations", "contact_offset", "persistent_contacts")
"""Numbers of a task that say how its physics is computed, and nothing about the task."""
UNITS = {"physics_frequency": " Hz", "contact_offset": " m"}
"""Of those that have one."""


@dataclass(frozen=True)
class Check:
    """A policy that was evaluated under other physics, and the run that trained it."""

    run: Run
    trained: Run

    @property
    def physics(self) -> str:
        """What is other, in words: the values of the evaluation, and in brackets those of the training."""
        there, here = (run.settings for run in (self.run, self.trained))
        return ", ".join(
            f"{name} {there[name]}{UNITS.get(name, '')} ({here[name]})"
            for name in PHYSICS
            if name in there and name in here and there[name] != here[name]
        )


def apart(runs: Sequence[Run]) -> tuple[list[Run], list[Check]]:
    """Runs without those evaluations that differ from a training among them in physics alone, and these evaluations."""
    trained = [run for run in runs if not run.evaluated_again]
    checks = [check for run in runs for check in _of_trained(run, trained)]
    taken = {check.run.folder for check in checks}
    return [run for run in runs if run.folder not in taken], checks


def _of_trained(run: Run, trained: Sequence[Run]) -> Iterator[Check]:
    """The evaluation with the run of its policy, if it is one under other physics."""
    if not run.evaluated_again or not run.result.get("task_config"):
        return
    own = _others(run)
    for other in trained:
        theirs = _others(other)
        common = own.keys() & theirs.keys()
        alike = _kind(run) == _kind(other) and all(own[name] == theirs[name] for name in common)
        if other.result.get("task_config") and alike and _same_policy(run, other):
            check = Check(run, other)
            if check.physics:
                yield check
            return


def _same_policy(run: Run, trained: Run) -> bool:
    """Whether an evaluation is of the policy of a training: by the file's digest where both are known, else by the
    training's seed. Results of earlier versions have the seed of their starts alone, which is that of the training
    where the starts are its own."""
    ours, theirs = run.result, trained.result
    digests = [result.get("policy_digest") for result in (ours, theirs)]
    if None not in digests:
        return digests[0] == digests[1]
    if ours.get("policy_seed") is not None:
        return ours["policy_seed"] == theirs.get("seed")
    return ours.get("seed") == theirs.get("seed") and ours.get("first_seed") == theirs.get("first_seed")


def _kind(run: Run) -> tuple[Any, ...]:
    """What a policy's evaluations share with its training, beside settings and seed."""
    env, preset, _, guidance, thousands = run.group
    return env, preset, run.result["agent"], run.result.get("reward", "dense"), guidance, thousands


def _others(run: Run) -> dict[str, Any]:
    """Settings of a run but for its physics, and for the number of environments, which an evaluation may choose anew;
    results of earlier versions do not have all."""
    return {name: value for name, value in run.settings.items() if name not in (*PHYSICS, "environments")}


def physics_section(runs: Sequence[Run], checks: Sequence[Check]) -> Section:
    """Success and overlap of trained policies under other physics, beside those under that of their training.

    Args:
        runs: all others, for the names of rows.
        checks: the evaluations.
    """
    names = {run.folder: group for group, members in grouped(runs).items() for run in members}
    found: dict[tuple[Group, str], list[Check]] = defaultdict(list)
    for check in checks:
        found[names[check.trained.folder], check.physics].append(check)
    rows = []
    for ((env, preset, agent, guidance, _), physics), members in sorted(found.items()):
        there, here = [check.run for check in members], [check.trained for check in members]
        rows.append(
            [env, preset, agent, guidance, str(seeds_of(here)), physics,
             f"{rate_of(here):.1f}", f"{rate_of(there):.1f}",
             _difference(there, here), _overlap(here), _overlap(there), _scripted(here), _scripted(there)]
        )  # fmt: skip
    head = ("task", "preset", "learner", "guidance", "seeds", "physics (in training)", "success as trained %",
            "success %", "points", "overlap p95 as trained [mm]", "overlap p95 [mm]", "scripted as trained %",
            "scripted %")  # fmt: skip
    note = (
        "The policies of training, not trained again. Differences with an interval are of the starts that both have, "
        "and the interval is the bootstrap's over seeds and starts; without one the starts are others. " + TOO_NARROW
    )
    return Section("Trained policies under other physics", head, rows, note)


def _difference(there: Sequence[Run], here: Sequence[Run]) -> str:
    ours, theirs = success_of(there), success_of(here)
    starts = {run.result.get("first_seed") for run in (*there, *here)}
    if ours is None or theirs is None or len(starts) > 1:
        return f"{rate_of(there) - rate_of(here):+.1f}"
    common = min(ours.shape[1], theirs.shape[1])
    return with_interval(*difference_of_pairs(ours[:, :common], theirs[:, :common]), sign=True)


def _overlap(runs: Sequence[Run]) -> str:
    tables = [run.episodes[OVERLAP] for run in runs if OVERLAP in run.episodes]
    return f"{np.percentile(np.concatenate(tables), 95):.1f}" if tables else NONE


def _scripted(runs: Sequence[Run]) -> str:
    """Success of no correction, which is the same for all of them where the starts are."""
    rates = [run.result["zero_success_rate"] for run in runs if run.result["zero_success_rate"] is not None]
    return f"{100 * rates[0]:.1f}" if rates else NONE
