"""Tables and figures of finished runs: `dora report DIR`, or several folders, `dora report DIR DIR --out REPORT`."""

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
    more: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Further ones, such as that of evaluations under other physics."""
    out: Path | None = None
    """Folder for the report; the first of those by default."""


@command
def main() -> int:
    """Run the command; returns the exit status."""
    arguments = tyro.cli(Arguments, description=__doc__)
    roots = arguments.dir, *arguments.more
    for path in write_report(roots, arguments.out or arguments.dir, present_rules()):
        print(path)
    return 0
