"""Tables and figures of finished runs: `dora report DIR`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dora.agents.reports.report import write_report
from dora.errors import command
from dora.tasks import present_rules


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
    for path in write_report(arguments.dir, arguments.out or arguments.dir, present_rules()):
        print(path)
    return 0
