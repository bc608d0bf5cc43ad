"""Tables and figures of finished runs: `dora report DIR`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dora.agents.reports.report import write_report
from dora.errors import command
from dora.tasks import find_task, task_ids
from dora.tasks.env.options import task_config


@dataclass
class Arguments:
    """Makes tables.md, report.html and one figure per task from the runs under a folder."""

    dir: Annotated[Path, tyro.conf.Positional]
    """Folder that is searched for result.json files."""
    out: Path | None = None
    """Folder for the report; the searched folder by default."""


@command
def main() -> int:
    """Run the command; returns the exit status."""
    arguments = tyro.cli(Arguments, description=__doc__)
    rules = {env_id: task_config(find_task(env_id).CONFIG, "standard", None).definition for env_id in task_ids()}
    for path in write_report(arguments.dir, arguments.out or arguments.dir, rules):
        print(path)
    return 0
