"""Finished runs as they lie in folders, and which of them make one row of a report."""

from collections import Counter, defaultdict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from dora.agents.config import NEUTRAL, NEUTRAL_LEARNER, TRAINING, WITHOUT_EFFECT, in_effect
from dora.agents.evaluation.evaluate import FINAL_SEED
from dora.agents.runs.progress_table import read_progress
from dora.agents.runs.stored_results import NO_CORRECTION, check_agreement, read_curve, read_episodes, read_result
from dora.configs import flat
from dora.errors import InputError
from dora.files import files_under

SECONDS_PER_MINUTE = 60.0
"""Seconds in a minute [s]."""
DEFAULT_PRESET = "standard"
"""Preset of a run of a Dora task that names none."""

ALONE = 0.1
"""Cores that other programs may keep busy, on average, while a run counts as alone on its machine [1]."""
SHARED, UNKNOWN = " \N{DAGGER}", " ?"
"""Marks of minutes beside other programs, and of minutes of which that was not measured."""

OF_CANDIDATES = ("optimised",)
"""Switches of tasks that choose the candidates of `affordance`, in which these may differ from other guidance."""
IN_WORDS = {
    ("optimised", "False"): "grasp made by hand",
    ("optimised", "True"): "grasps of the search",
    ("reorient", "in_hand"): "turned in the hand",
    ("hand_action", "fingers"): "one number a finger",
}
"""Values of numbers of tasks, by name and value, as readers of a table know them."""
WITHOUT_OVERLAP = {"after_overlap": "1.0", "placed_after_overlap": "1.0", "weights.penetration": "0.0"}
"""Numbers of a task with which its reward does not depend on overlap: named together."""
ALWAYS = ("optimised",)
"""Numbers of tasks that are named whatever most runs of a row have, since neither of their values is the usual one."""

EASED = ", overlap eased"
"""What is added to the guidance of runs whose training began with a share of the penalty for overlap."""
EARLIER = ", earlier rules"
"""What is added to the guidance of runs whose task has other rules now."""

Value = TypeVar("Value", bound=Hashable)
"""What is counted."""
Group = tuple[str, str, str, str, int]
"""Environment, preset, agent, guidance, steps in thousands (rounded): what the runs of one row of the table share."""


@dataclass(frozen=True)
class Run:
    """One finished run: its `result.json`, the rows of its `curve.csv`, the columns of its `progress.csv`, and those of
    `eval.csv` and `zero.csv` if they are there."""

    folder: Path
    result: dict[str, Any]
    curve: list[dict[str, float]]
    progress: dict[str, Float[np.ndarray, " rows"]] = field(default_factory=dict)
    episodes: dict[str, Float[np.ndarray, " e"]] = field(default_factory=dict)
    zero: dict[str, Float[np.ndarray, " z"]] = field(default_factory=dict)
    outdated: bool = False
    """The task's rules have changed since (`TaskConfig.definition`)."""
    label: str = field(default="", compare=False)
    """In what it differs from the other runs of its task, learner and guidance, in words; set by `grouped`."""

    @property
    def group(self) -> Group:
        """Runs that differ only in their seed share it; guidance names its parts if the run did, and the agent
        another reward than the usual one, and whether it was only evaluated."""
        result = self.result
        task = result if "preset" in result else result.get("task", {})
        guidance = result["guidance"] + parts_of(self)
        agent = result["agent"].upper()
        agent += ", paper's reward" if result.get("reward", "dense") == "paper" else ""
        agent += ", evaluated again" if self.evaluated_again else ""
        guidance += EASED if result.get("overlap_share", 1.0) < 1 else ""
        guidance += EARLIER if self.outdated else ""
        return result["env"], task.get("preset", DEFAULT_PRESET), agent, guidance, round(self.budget / 1000)

    @property
    def evaluated_again(self) -> bool:
        """It is no training, but an evaluation of a policy that was trained before."""
        return bool(self.result.get("checkpoint"))

    @property
    def policy(self) -> tuple[Any, ...]:
        """Tells its policy from the others of its row: the seed of its training; of an evaluation of a checkpoint also
        the file's digest (`seed` is that of the starts there), in results of earlier versions its path."""
        r = self.result
        if not self.evaluated_again:
            return (r.get("seed", self.folder),)
        return r.get("policy_seed", r.get("seed")), r.get("policy_digest", r["checkpoint"])

    @property
    def minutes(self) -> float | None:
        """Wall time of the training, with its evaluations [min]; None where nothing was trained."""
        return None if self.evaluated_again else self.result["wall_seconds"] / SECONDS_PER_MINUTE

    @property
    def budget(self) -> int:
        """Environment steps for which the run was meant."""
        return self.result.get("total_steps", self.result["env_steps"])

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that tell it from a run which is no other seed of it, by name: of task, learner, training."""
        r = self.result
        learner = r.get("learner_config")  # results of earlier versions lack it, and the settings of training
        learned = {} if learner is None else NEUTRAL_LEARNER.get(r["agent"], {}) | learner
        count = r.get("num_envs")
        environments = {} if count is None else {"environments": count * max(r.get("workers") or 0, 1)}
        named = {f"learner.{name}": value for name, value in learned.items()}
        return (
            dict(flat(in_effect(r.get("task_config") or {}))) | named | (r.get("training_config") or {}) | environments
        )


def parts_of(run: Run) -> str:
    """The parts of guidance that a run names, as its row does."""
    parts = (run.result if "preset" in run.result else run.result.get("task", {})).get("guidance_parts")
    return f" ({', '.join(parts)})" if parts else ""


def find_runs(roots: Path | Sequence[Path], rules: Mapping[str, int] | None = None) -> list[Run]:
    """All finished runs under one folder or several, by path; unfinished ones are left out.

    Args:
        roots: folders that are searched.
        rules: `definition` of the present rules of tasks, by id; runs of earlier ones are `outdated`.

    Raises:
        InputError: if there is none in one of them, or a result file is damaged.
    """
    found: dict[Path, Run] = {}
    for root in several(roots):
        runs = _runs_under(root, rules or {})
        if not runs:
            raise InputError(f"there is no finished run under {root}: point at a folder with result.json files in it.")
        found |= {run.folder.resolve(): run for run in runs if run.folder.resolve() not in found}
    return _with_zero(_once(list(found.values())))


def several(roots: Path | Sequence[Path]) -> Sequence[Path]:
    """One folder or several as a sequence."""
    return [roots] if isinstance(roots, Path) else roots


def _runs_under(root: Path, rules: Mapping[str, int]) -> list[Run]:
    """Finished runs under a folder, by path."""
    runs = []
    for path in files_under(root, "result.json"):
        result = read_result(path)
        curve, progress = path.with_name("curve.csv"), path.with_name("progress.csv")
        if result is not None:
            rows = read_curve(curve) if curve.exists() else []
            trained = read_progress(progress) if progress.exists() else {}
            shares = {"eval.csv": result["success_rate"], "zero.csv": result["zero_success_rate"]}
            count = result.get("eval_episodes")
            episodes, zero = (_episodes(path.with_name(name), share, count) for name, share in shares.items())
            definition = (result.get("task_config") or {}).get("definition", NEUTRAL["definition"])
            outdated = definition != rules.get(result["env"], definition)
            runs.append(Run(path.parent, result, rows, trained, episodes, zero, outdated))
    return runs


def _once(runs: Sequence[Run]) -> list[Run]:
    """The runs without copies and repetitions: one with the same settings and seed is no other seed, whatever is said
    of the machine and the last evaluation. Of several that with most episodes counts, the first of equals."""
    found: dict[tuple[Any, ...], Run] = {}
    for run in runs:
        r = run.result
        digest = r.get("config_digest")
        known: Any = digest if digest is not None else (r["env_steps"], r["wall_seconds"], r["success_rate"])
        if r.get("learner_config") is not None and r.get("training_config") is not None:  # since then all are stored
            known = sorted(map(str, run.settings.items()))
        key = run.group, run.policy, str(known), r.get("first_seed")
        if key not in found or r.get("eval_episodes", 0) > found[key].result.get("eval_episodes", 0):
            found[key] = run
    return list(found.values())


def _with_zero(runs: Sequence[Run]) -> list[Run]:
    """The runs, with the zero correction of another one where they did not measure it: on the same starts of the same
    task it is the same, whatever was learned."""

    def starts(run: Run) -> tuple[Any, ...]:
        r = run.result
        first = r.get("first_seed", FINAL_SEED), r.get("eval_episodes")
        numbers = sorted(map(str, task_numbers(run).items()))
        return r["env"], run.group[1], run.group[3], str(numbers), *first

    runs = [replace(run, zero=run.episodes) if run.result["agent"] == NO_CORRECTION else run for run in runs]
    told = (run for run in runs if run.result["zero_success_rate"] is not None)
    measured = {starts(run): run for run in sorted(told, key=lambda run: bool(run.zero))}  # with episodes come last
    filled = []
    for run in runs:
        other = measured.get(starts(run))
        if other is not None and run.result["zero_success_rate"] is None:
            share = {"zero_success_rate": other.result["zero_success_rate"]}
            run = replace(run, result=run.result | share, zero=other.zero)
        filled.append(run)
    return filled


def _episodes(path: Path, share: float | None, count: int | None) -> dict[str, Float[np.ndarray, " e"]]:
    """Columns of a table of episodes, if there is one, which has to agree with the result beside it."""
    if not path.exists():
        return {}
    columns = read_episodes(path)
    check_agreement(path, columns, share, count)
    return {name: np.array(values) for name, values in columns.items()}


def grouped(runs: Sequence[Run]) -> dict[Group, list[Run]]:
    """The runs of each row of a table, in its order; runs whose tasks have other numbers are rows of their own, whose
    guidance names the difference."""
    groups: dict[Group, list[Run]] = defaultdict(list)
    for run in runs:
        groups[run.group].append(run)
    rows: dict[Group, list[Run]] = {}
    for (env, preset, agent, guidance, thousands), members in groups.items():
        for difference, alike in _by_task(members).items():
            row = env, preset, agent, guidance + difference, thousands
            words = row[3].removeprefix(alike[0].result["guidance"] + parts_of(alike[0]))
            rows[row] = [replace(run, label=words.removeprefix(", ")) for run in alike]
    return dict(sorted(rows.items()))


def _by_task(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs by what the numbers of their task differ in, in words, but for numbers that a switch brings with it. What
    more runs have than have anything else goes without saying."""
    numbers = _filled([run.settings for run in runs])
    names = sorted({name for each in numbers for name in each})
    named = [name for name in names if not _brought_along(name, numbers)]
    names = [name for name in named if len({str(each.get(name)) for each in numbers}) > 1]
    values = [tuple(str(each.get(name)) for name in names) for each in numbers]
    usual = most_frequent(values)
    found: dict[str, list[Run]] = defaultdict(list)
    for run, own in zip(runs, values, strict=True):
        said = {
            name: value
            for k, (name, value) in enumerate(zip(names, own, strict=True))
            if usual is None or value != usual[k] or name in ALWAYS
        }
        found["".join(f", {words}" for words in _phrases(said))].append(run)
    return found


def _brought_along(name: str, settings: Sequence[dict[str, Any]]) -> bool:
    """Whether a number is there with some value of a switch alone, and the same in all runs that have it."""
    having = {str(each[name]) for each in settings if name in each}
    return name.partition(".")[0] in WITHOUT_EFFECT and len(having) == 1


def _filled(settings: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The settings of runs; of those of learner and training what a result of an earlier version does not say is what
    most others have."""
    found: dict[str, list[Any]] = defaultdict(list)
    for name, value in (item for each in settings for item in each.items()):
        if name in TRAINING or name.startswith("learner."):
            found[name].append(value)
    usual = {name: max(values, key=values.count) for name, values in found.items()}
    return [usual | each for each in settings]


def most_frequent(values: Sequence[Value]) -> Value | None:
    """What stands more often among `values` than anything else; None if nothing does."""
    first, *others = Counter(values).most_common(2)
    return None if others and others[0][1] == first[1] else first[0]


def _phrases(said: Mapping[str, str]) -> list[str]:
    """Numbers of a task in words."""
    together = said.items() >= WITHOUT_OVERLAP.items()
    single = [in_words(name, value) for name, value in said.items() if not (together and name in WITHOUT_OVERLAP)]
    return [*single, "reward without overlap"] if together else single


def in_words(name: str, value: str) -> str:
    """A number or switch of a task with its value."""
    return IN_WORDS.get((name, value), f"{name} {value}")


def success_shares(runs: Sequence[Run]) -> list[tuple[float, int]]:
    """Success rate and episodes of each run; 0 episodes if it does not say how many."""
    return [(r.result["success_rate"], r.result.get("eval_episodes", 0)) for r in runs]


def zero_episodes(runs: Sequence[Run]) -> list[dict[str, Float[np.ndarray, " z"]]]:
    """The episodes of no correction of the first run that has them: on the same starts they are the same for all."""
    return [run.zero for run in runs if run.zero][:1]


def zero_shares(runs: Sequence[Run]) -> list[tuple[float, int]]:
    """The same of no correction in the runs that have a prior. Zero action on the same starts is the same episodes,
    whatever was learned, so those that begin with the same start count once: the longest evaluation."""
    found: dict[int, tuple[float, int]] = {}
    for run in runs:
        r = run.result
        first, rate, count = r.get("first_seed", FINAL_SEED), r["zero_success_rate"], r.get("eval_episodes", 0)
        if rate is not None and (first not in found or count >= found[first][1]):
            found[first] = rate, count
    return list(found.values())


def same_task(one: Run, other: Run) -> bool:
    """Whether two runs have the same numbers of the task, of those that are known of both, whatever chooses the
    candidates."""
    return same_values(task_numbers(one), task_numbers(other))


def task_numbers(run: Run) -> dict[str, Any]:
    """Numbers of the task of a run that have an effect, by name; none if it does not say."""
    known = run.result.get("task_config")
    return dict(flat(in_effect(known))) if known else {}


def same_values(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether settings agree, of those that are known of both, whatever chooses the candidates."""
    return all(one[name] == other[name] for name in one.keys() & other.keys() - set(OF_CANDIDATES))


def seeds_of(runs: Sequence[Run]) -> int:
    """Number of policies among the runs: those of one row differ in their seed."""
    return len({run.policy for run in runs})


def shared_mark(runs: Sequence[Run]) -> str:
    """The mark of minutes that were not measured on a machine of their own, or of which that is not known."""
    loads = [run.result.get("other_load") for run in runs if run.minutes is not None]
    if any(load is not None and load > ALONE for load in loads):
        return SHARED
    return UNKNOWN if None in loads else ""
