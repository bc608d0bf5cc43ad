"""What stands in the way of a higher success: information, the bounds of the residual action, or the learner.

    python -m dora.tools.oracle DoraJug-v1 --preset hard --episodes 200

Runs the same starts three times: with zero correction; with zero correction and candidates without an error, which is
what is lost to everything but that error; and with the exact correction of that error as the action, within its bounds.
A policy that learned cannot be expected above the second; if the third falls short of it, the bounds are too narrow; if
a policy falls short of the third, it is the learner, or what the policy observes. These two are told apart by a policy
that is trained with the exact correction in its observation: dora run --env DoraJug-v1 --task.observe-correction
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from dora.errors import InputError, command
from dora.parallel import one_thread
from dora.progress import ProgressDisplay
from dora.tables import share_text, text_table
from dora.tasks import make_task
from dora.tasks.env.env import DoraEnv
from dora.tools.episodes import play_out

BATCH = 50
"""Episodes that run together."""
SEED = 30_000
"""First seed; training and evaluation use none of these."""
HEAD = ("candidates, action", "success", "overlap not counted", "size of the action")
"""Head of the table."""
Act = Callable[[DoraEnv], Float[Tensor, "n a"]]


@dataclass
class Args:
    """Compare zero correction, candidates without an error, and the exact correction of their error."""

    env: tyro.conf.Positional[str]
    """Task, for example DoraJug-v1."""
    episodes: int = 200
    """Episodes of each, rounded up to batches of 50."""
    preset: Literal["none", "standard", "hard"] = "standard"
    """How much episodes are randomised."""
    guidance: Literal["affordance", "grasps"] = "affordance"
    """Where candidates come from: a search in the regions of the object, or one that knows no region."""
    misplaced: Literal["candidates", "object"] = "candidates"
    """What is off by the candidates' error: they, or the measured pose of their object."""
    pose_filter: float | None = None
    """Share of the newest measurement in the estimated pose of an object, 1: no filter; the task's own if not given."""


@dataclass(frozen=True)
class Outcome:
    """Of e episodes: success, success without regard to overlap, and the root mean square of the actions (1 is the
    bound)."""

    success: Bool[Tensor, " e"]
    raw: Bool[Tensor, " e"]
    action: float


def no_action(task: DoraEnv) -> Float[Tensor, "n a"]:
    """Zero correction."""
    return torch.zeros(task.num_envs, task.action_size, device=task.device)


def exact_action(task: DoraEnv) -> Float[Tensor, "n a"]:
    """The exact correction of every arm, as far as the bounds allow."""
    return torch.cat(list(task.arms.exact_corrections(task.snapshot, task.perturbations).values()), -1)


@one_thread()
def outcome(args: Args, act: Act, error: float, report: Callable[[int, int], object]) -> Outcome:
    """Runs the episodes.

    Args:
        args: task, preset, how many.
        act: the action of an episode, decided at its beginning.
        error: share of the candidates' error that is in force.
        report: is told episodes done and in all.

    Raises:
        InputError: there is no such task.
    """
    changed: dict[str, Any] = {"misplaced": args.misplaced}
    changed |= {} if args.pose_filter is None else {"pose_filter": args.pose_filter}
    task = make_task(args.env, BATCH, args.guidance, preset=args.preset, config=changed)
    task.anneal(error=error)
    success, raw, sizes = [], [], []
    batches = -(-args.episodes // BATCH)
    for batch in range(batches):
        task.reset(seed=[SEED + batch * BATCH + row for row in range(BATCH)])
        action = act(task)
        sizes.append(float(action.square().mean()))
        won, failed, info = play_out(task, lambda _, action=action: action)
        success.append(won.cpu())
        raw.append((info["raw_success"] & ~failed).cpu())
        report((batch + 1) * BATCH, batches * BATCH)
    task.close()
    return Outcome(torch.cat(success), torch.cat(raw), (sum(sizes) / len(sizes)) ** 0.5)


ROWS: tuple[tuple[str, Act, float], ...] = (
    ("as they are, none", no_action, 1.0),
    ("without error, none", no_action, 0.0),
    ("as they are, the exact correction", exact_action, 1.0),
)
"""Names, actions, and shares of the candidates' error."""


@command
def main() -> None:
    """Print the table."""
    args = tyro.cli(Args, description=__doc__)
    if args.episodes < 1:
        raise InputError(f"--episodes is {args.episodes}; it has to be at least 1.")
    rows = []
    with ProgressDisplay() as phases:
        for name, act, error in ROWS:
            found = outcome(args, act, error, phases.phase(name, "episodes"))
            shares = (share_text(float(x.float().mean()), len(x)) for x in (found.success, found.raw))
            rows.append((name, *shares, f"{found.action:.2f}"))
    about = "" if args.pose_filter is None else f", pose filter {args.pose_filter:g}"
    about += ", objects misplaced" if args.misplaced == "object" else ""
    print(f"\n{args.env}, {args.preset}, guidance {args.guidance}{about}:")
    print(text_table(HEAD, rows))


if __name__ == "__main__":
    sys.exit(main())
