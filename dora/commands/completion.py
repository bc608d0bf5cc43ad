"""Completion of the command `dora` in a shell: a script that tyro writes from the options of all commands."""

import contextlib
import io
from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, Any, Literal, Union

import tyro

from dora.agents.config import LEARNER_CONFIGS
from dora.agents.runs.recommended import learners_of, recommended
from dora.commands import bench, demos, grasps, play, report, run, sweep, view
from dora.tasks import find_task
from dora.tasks.env.options import task_config


def script(names: Iterable[str], shell: str) -> str:
    """The script that completes `dora` and the options of its commands; source it, or put it where the shell looks.

    Args:
        names: commands, of `FORMS`.
        shell: bash, zsh or fish.
    """
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        tyro.cli(_choice({name: FORMS[name]() for name in names}), prog="dora", args=["--tyro-print-completion", shell])
    return output.getvalue()


def _choice(forms: dict[str, Any]) -> Any:
    """The type of a command line that begins with one of these names and goes on with the options of its form."""
    parts = [
        Annotated[Any, tyro.conf.subcommand(name, constructor=form, **DEFAULTS.get(name, dict)())]
        for name, form in forms.items()
    ]
    return Union[tuple(parts)]  # noqa: UP007


def _run() -> Any:
    """Options of `dora run`, those of the task that its help shows."""
    task, base = find_task(run.SHOWN), recommended(run.SHOWN)
    agents = Literal[tuple(learners_of(task.LEARNERS))]  # pyright: ignore[reportInvalidTypeForm]
    form: Any = run.Args[task.CONFIG, LEARNER_CONFIGS[base.agent], agents]  # pyright: ignore[reportInvalidTypeArguments, reportInvalidTypeForm]
    return form


def _run_default() -> dict[str, Any]:
    task, base = find_task(run.SHOWN), recommended(run.SHOWN)
    return {"default": run.Args(run=replace(base, task=task_config(task.CONFIG, base.preset, base.task)))}


def _bench() -> Any:
    """Options of `dora bench` with its own commands."""
    return _choice(bench.KINDS)


FORMS = {
    "run": _run,
    "play": lambda: play.Args,
    "demos": lambda: demos.Args,
    "grasps": lambda: grasps.Args,
    "view": lambda: view.Args,
    "bench": _bench,
    "sweep": lambda: sweep.Args,
    "report": lambda: report.Arguments,
}
"""By command, a function that returns the type from which tyro makes its options."""
DEFAULTS = {"run": _run_default}
"""By command, a function that returns their defaults, where the type has none."""
