"""Puts the best trained policies into the package: `python -m dora.policies.bundle results/tasks`.

It takes for each task the run whose evaluation during training was the best (success, then return), among runs with
full guidance, the usual reward, the preset `standard` and the task's own switches. Runs that were only evaluated again,
whose training saw other definitions, come after them, and results of earlier rules last. The figures of its card are
those of the run's `result.json`; what the policy fails at is counted here, on the same starts. `docs/policies.md` is
made of the cards.
"""

import datetime
import functools
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from dora.agents.checkpoint import Checkpoint, read_checkpoint
from dora.agents.config import RunConfig
from dora.agents.evaluation.evaluate import FINAL_SEED, Evaluation
from dora.agents.evaluation.play import evaluate_checkpoint
from dora.agents.reports.failures import first_causes
from dora.agents.reports.run_results import DEFAULT_PRESET, SECONDS_PER_MINUTE, Run, find_runs
from dora.configs import plain
from dora.errors import InputError, command
from dora.files import make_folder, write_bytes
from dora.policies.card import HEADINGS, Card
from dora.policies.policy import bundled_files, bundled_ids
from dora.tables import markdown_table, wilson
from dora.tasks import find_task, make_task, present_rules, task_ids
from dora.tasks.env.options import task_config
from dora.tools.task_pages import refreshed
from dora.version import source_commit

POLICY = "policy.safetensors"
"""Name of the policy in the folder of a committed run."""
NEEDED = ("seed", "eval_episodes", "stage_rates")
"""Entries of a result that a card needs and that those of the first versions lack."""
PAGE = Path("docs") / "policies.md"
"""Page with the table of all cards, in a checkout."""


@dataclass(frozen=True)
class Args:
    """Choose a policy for each task and put it, with its card, into the package."""

    results: tyro.conf.Positional[Path] = Path("results/tasks")
    """Folder that is searched for runs with their policies."""
    env: tuple[str, ...] = ()
    """Ids of the tasks; all of which there are runs by default."""
    workers: int = 1
    """Processes that evaluate."""
    again: bool = False
    """Make the card of a policy that is bundled already again, too."""


@dataclass(frozen=True)
class Choice:
    """The run whose policy is bundled, and among how many it was chosen."""

    run: Run
    checkpoint: Checkpoint
    among: int

    @property
    def path(self) -> Path:
        """The checkpoint."""
        return self.run.folder / POLICY


@command
def main() -> int:
    """Run the command; returns the exit status."""
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=__doc__)
    commit = source_commit()  # before files of the checkout are replaced
    runs = find_runs(args.results, present_rules())
    for env_id in args.env or task_ids():
        if (choice := chosen(runs, env_id)) is None:
            if args.env:
                raise InputError(f"there is no run of {env_id} under {args.results} that a bundle may hold.")
            continue
        if not args.again and is_bundled(choice):
            count_runs(choice)
            print(f"{env_id}: {choice.run.folder} is bundled already (--again makes its card anew).")
            continue
        print(f"{env_id}: {choice.run.folder}, best of {choice.among}; counting what it fails at ...")
        print(bundle(choice, args.results, commit, args.workers))
    if PAGE.is_file():
        write_bytes(PAGE, refreshed(PAGE.read_text(), cards_table()).encode())
    return 0


def chosen(runs: list[Run], env_id: str) -> Choice | None:
    """The run of a task whose evaluation during training was the best; None if there is none that a bundle may hold.

    Runs of earlier rules come last, and before these those that were evaluated again.
    """
    found = []
    for run in runs:
        if run.result["env"] == env_id and (run.folder / POLICY).is_file():
            checkpoint = read_checkpoint(run.folder / POLICY)
            known = all(run.result.get(name) is not None for name in NEEDED)
            if known and is_usual(checkpoint.config) and checkpoint.progress.get("best"):
                age = not run.outdated, not run.result.get("checkpoint")
                found.append(((*age, checkpoint.progress["best"]), run, checkpoint))
    if not found:
        return None
    _, run, checkpoint = max(found, key=lambda item: item[0])
    return Choice(run, checkpoint, len(found))


def is_usual(config: RunConfig) -> bool:
    """Whether a policy was trained in what `gym.make` makes without options, but for numbers that tune the task."""
    if (config.guidance, config.guidance_parts, config.reward) != ("affordance", None, "dense"):
        return False
    cls = find_task(config.env).CONFIG
    own, theirs = (plain(task_config(cls, config.preset, numbers)) for numbers in (None, config.task))
    switches = [name for name, value in own.items() if isinstance(value, bool | str)] + ["pose_filter"]
    return config.preset == DEFAULT_PRESET and all(own[name] == theirs[name] for name in switches)


def is_bundled(choice: Choice) -> bool:
    """Whether the package has this very policy with the card of this very result."""
    policy, card = bundled_files(choice.run.result["env"])
    if not (policy.is_file() and card.is_file()) or policy.read_bytes() != choice.path.read_bytes():
        return False
    try:
        known, result = Card.read(card), choice.run.result
    except InputError:  # it is made anew
        return False
    return (known.success_rate, known.episodes, known.run_commit) == (
        result["success_rate"], result.get("eval_episodes"), result.get("commit")
    )  # fmt: skip


def count_runs(choice: Choice) -> None:
    """Bring the number of runs on the card of a bundled policy up to date; it stays the best of more or fewer."""
    path = bundled_files(choice.run.result["env"])[1]
    card = Card.read(path)
    if card.chosen_among != choice.among:
        replace(card, chosen_among=choice.among).write(path)


def bundle(choice: Choice, results: Path, commit: str | None, workers: int = 1) -> Card:
    """Copy a policy into the package and write its card, which is returned.

    Args:
        choice: what to bundle.
        results: folder below which the run lies; the card names the run from there.
        commit: of the code that runs.
        workers: processes that evaluate.

    Raises:
        InputError: the policy does not do what its result says, so that the result has to be made anew.
    """
    result, config = choice.run.result, choice.checkpoint.config
    numbers = result.get("task_config") or config.task
    settings = replace(config, task=numbers, final_episodes=result["eval_episodes"], workers=workers)
    make = functools.partial(make_task, config.env, **settings.task_options)
    first_seed = result.get("first_seed") or FINAL_SEED
    _, evaluation, _ = evaluate_checkpoint(choice.path, settings, make, zero=False, first_seed=first_seed)
    check_agrees(evaluation, choice.run)
    card = make_card(choice, evaluation, os.path.relpath(choice.run.folder, results), commit)
    policy, card_file = bundled_files(config.env)
    make_folder(policy.parent)
    write_bytes(policy, choice.path.read_bytes())
    card.write(card_file)
    return card


def check_agrees(evaluation: Evaluation, run: Run) -> None:
    """Refuse a result that the policy does not reach now: the rate of one is outside of the interval of the other.

    Raises:
        InputError: naming both rates.
    """
    stored, low, high = run.result["success_rate"], *evaluation.success_interval
    if not low <= stored <= high:
        raise InputError(
            f"{run.folder} says success {stored:.3f}, and its policy now has {evaluation.success_text} on the same "
            f"starts: evaluate it by dora run --eval-only --checkpoint {run.folder / POLICY}, and store that result."
        )


def make_card(choice: Choice, evaluation: Evaluation, run: str, commit: str | None) -> Card:
    """The card of a policy.

    Args:
        choice: the run.
        evaluation: in which its failures are counted.
        run: how the card calls the run.
        commit: of the code that counted them.
    """
    result, config, progress = choice.run.result, choice.checkpoint.config, choice.checkpoint.progress
    task = find_task(config.env)
    limit = task_config(task.CONFIG, config.preset, result.get("task_config") or config.task).penetration_limit
    rate, episodes = result["success_rate"], result["eval_episodes"]
    table = {name: evaluation.values(name).numpy() for name in evaluation.columns.names}
    shared: dict[str, Any] = {name: result[name] for name in ("env", "agent", "guidance", "seed", "stage_rates")}
    return Card(
        **shared,
        preset=config.preset,
        env_steps=progress["env_steps"],
        total_steps=config.total_steps,
        minutes=result["wall_seconds"] / SECONDS_PER_MINUTE,
        chosen_among=choice.among,
        training_success=progress["best"][0],
        training_episodes=config.eval_episodes,
        success_rate=rate,
        success_interval=wilson(round(rate * episodes), episodes),
        zero_success_rate=result["zero_success_rate"],
        episodes=episodes,
        first_seed=evaluation.first_seed,
        overlap_p95_mm=result["penetration_p95_mm"],
        overlap_limit_mm=1000.0 * limit,
        counted_successes=round(evaluation.success_rate * len(evaluation.table)),
        failures=first_causes(table, task.MAX_STEPS),
        run=run,
        run_commit=result.get("commit"),
        commit=commit,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
    )


def cards_table() -> str:
    """Markdown table of the cards of all bundled policies."""
    cards = [card for env_id in bundled_ids() if (card := bundled_files(env_id)[1]).is_file()]
    return markdown_table(HEADINGS, [Card.read(card).row() for card in cards])


if __name__ == "__main__":
    raise SystemExit(main())
