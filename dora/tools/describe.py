"""What a task is: `python -m dora.tools.describe DoraJug-v1` prints the tables in force.

    python -m dora.tools.describe DoraJug-v1 --preset hard --task.lift 0.12

Stages, reward terms with weights, observations, limits, and every number under the name that overrides it.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import tyro

from dora.errors import InputError, command
from dora.tasks import find_task, make_task, task_ids
from dora.tasks.env.options import task_config
from dora.tools.command_line import HELP, read_some

SHOWN = "DoraJug-v1"
"""Task whose options `--help` shows if none is named."""
Numbers = TypeVar("Numbers")
"""Numbers of the task that is named."""


@dataclass(frozen=True, kw_only=True)
class Args(Generic[Numbers]):
    """Print the tables of a task."""

    env: tyro.conf.Positional[str]
    """Task id, for example DoraJug-v1."""
    preset: Literal["none", "standard", "hard"] = "standard"
    """How much episodes are randomised and perturbed."""
    guidance: Literal["affordance", "grasps", "none"] = "affordance"
    """Use affordance maps and grasp candidates, candidates of a search that knows no region, or neither."""
    task: Numbers
    """Numbers of the task."""


@dataclass(frozen=True)
class First:
    """The option that decides the defaults of the numbers, as in `Args`."""

    preset: str = "standard"


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Prints the tables of the task that is named; returns the exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    otherwise = SHOWN if HELP & set(words) else words[0] if words else "-"
    named = next((word for word in words if word in task_ids()), otherwise)
    if named.startswith("-"):
        raise InputError("Say which task, for example: python -m dora.tools.describe DoraJug-v1")
    cls, preset = find_task(named).CONFIG, read_some(First, words).preset
    form: Any = Args[cls]
    default = Args(env=named, task=task_config(cls, preset, None))
    args: Args = tyro.cli(form, default=default, description=__doc__, args=words)
    options = {"guidance": args.guidance, "preset": args.preset, "config": args.task}
    task = make_task(args.env, 1, sim_backend="physx_cpu", **options)
    print(task)
    task.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
