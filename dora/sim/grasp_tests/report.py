"""The report of a grasp search: the printed table and the two files."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dora.affordance.candidates import GraspCandidates
from dora.affordance.maps.confusion import Confusion
from dora.errors import InputError
from dora.files import write_json
from dora.reading import read_json
from dora.sim.grasp_tests.failures import FEW
from dora.sim.grasp_tests.generation import KINDS

SUFFIX, REPORT_SUFFIX = ".safetensors", ".json"
"""Suffixes of a file of candidates, and of the report beside it."""
KEYS_OF_A_REPORT = {"object": "", "requested": 0, "optimised": 0}
"""Some of the keys that every report has."""
ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "candidates": lambda r: f"{r['optimised']} of {r['requested']}",
    "search": lambda r: f"{r['optimise_seconds']:.1f} s",
    "simulation": lambda r: f"{r['validate_seconds']:.1f} s",
    "passed the simulation": lambda r: _percent(r["sim_success_rate"]),
    "valid": lambda r: f"{r['valid']} ({_percent(r['valid_share'])})",
    "strictly valid": lambda r: _percent(r["strict_share"]),
    "valid per second": lambda r: f"{r['valid_per_second']:.1f}",
    "penetration, median / p90 / max": lambda r: _lengths(r["penetration_mm"]),
    "self-penetration, median / p90 / max": lambda r: _lengths(r["self_penetration_mm"]),
    "classes of the valid": lambda r: (
        ", ".join(f"{n} {c} ({_percent(r['class_shares'][n])})" for n, c in r["classes"].items()) or "-"
    ),
}
"""Functions that format each row of the printed table; the medians of the energy terms follow."""


def print_report(report: dict[str, Any], console: Console | None = None) -> None:
    """Print a summary and, beside it, those that it holds under "baselines" and "by_region"; below, the votes."""
    console = console or Console(markup=False)
    beside = report.get("by_region", {}) | report.get("baselines", {})
    table = Table(title=f"{report['object']}, {report['region'] or 'any region'}, {report['robot']}")
    table.add_column()
    for name in ("grasps", *beside):
        table.add_column(name.replace("_", " "), overflow="fold")
    for name, cell in ROWS.items():
        table.add_row(name, *(cell(column) for column in (report, *beside.values())))
    for name in report["energy"]:
        table.add_row(f"energy: {name}", *(_energy(column, name) for column in (report, *beside.values())))
    console.print(table)
    if "voting" in report:
        console.print(_votes(report["voting"]))
    if report["valid"] < FEW * report["optimised"]:
        console.print(_causes(report["failures"]))
        console.print(report["failures"].get("hint", ""), highlight=False, soft_wrap=True)


def _causes(failures: dict[str, Any]) -> Table:
    """Number of candidates by the cause for which they are not valid."""
    table = Table(title=f"why {failures['failed']} candidates are not valid")
    table.add_column("cause", overflow="fold")
    table.add_column("candidates", justify="right")
    for cause, count in failures["causes"].items():
        table.add_row(cause, str(count))
    table.add_section()
    table.add_row("of all, valid or not: the hand overlaps with itself", str(failures["self_contact"]))
    return table


def _energy(column: dict[str, Any], name: str) -> str:
    return f"{column['energy'][name]:.3g}" if name in column["energy"] else "-"


def _votes(voting: dict[str, Any]) -> Table:
    """Balanced accuracy and confusion of the votes by the region of largest contact force."""
    labels = voting["labels"]
    table = Table(title="part that carries most force after closing, and what the contacts vote for")
    for heading in ("grasps", "contacts", "balanced accuracy", *(f"{name} held: voted" for name in labels)):
        table.add_column(heading, overflow="fold")
    for group in ("all", "clear", "valid", "valid_clear"):
        for kind in KINDS:
            found = voting[group][kind]
            cells = [_confused(row, [*labels, "none"]) for row in found["confusion"]]
            accuracy = found["balanced_accuracy"]
            share = "-" if accuracy is None else f"{accuracy:.3f}"
            table.add_row(
                f"{group.replace('_', ', ')} ({voting[group]['grasps']})", kind.replace("_", " "), share, *cells
            )
    return table


def print_agreement(agreement: Confusion) -> None:
    """Print what the contact maps of grasps vote for, a line per region of their class."""
    for name, row in zip(agreement.names, agreement.counts.tolist(), strict=True):
        print(f"{name} {sum(row)}: contact maps vote {_confused(row, [*agreement.names, 'none'])}")


def _confused(row: list[int], names: list[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in zip(names, row, strict=True) if count) or "-"


def check_out(out: Path) -> None:
    """Create the folder of a file of candidates and check that it can be written, before the search begins.

    Raises:
        InputError: the name does not end in .safetensors, the file cannot be written, or it or the report beside it
            would replace a file that is no such set or report.
    """
    if out.suffix != SUFFIX:
        raise InputError(f"--out is {out}: give a name that ends in {SUFFIX}.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out.parent).close()
    except OSError as error:
        raise InputError(f"Cannot write into {out.parent} ({error.strerror}): choose another --out.") from error
    if out.is_dir():
        raise InputError(f"--out is {out}, which is a folder: choose another name.")
    if not _is_set(out):
        raise InputError(f"{out} exists and is no set of grasps: choose another --out, or move the file.")
    if not _is_report(out.with_suffix(REPORT_SUFFIX)):
        beside = f"{out.with_suffix(REPORT_SUFFIX)}, where the report is written, exists and is no such report"
        raise InputError(f"{beside}: choose another --out, or move the file.")


def _is_set(path: Path) -> bool:
    """Whether a file holds candidates, if it exists."""
    try:
        return not path.exists() or len(GraspCandidates.load(path)) > 0
    except InputError:
        return False


def _is_report(path: Path) -> bool:
    """Whether a file is a report of candidates, if it exists."""
    try:
        report = read_json(path, "report of grasps") if path.exists() else KEYS_OF_A_REPORT
    except InputError:
        return False
    return isinstance(report, dict) and KEYS_OF_A_REPORT.keys() <= report.keys()


def write_report(report: dict[str, Any], candidates: GraspCandidates, out: Path) -> None:
    """Write the candidates to `out` and the report beside it as .json, each atomically.

    Raises:
        InputError: a file cannot be written.
    """
    candidates.save(out)
    write_json(out.with_suffix(REPORT_SUFFIX), report)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"


def _lengths(spread: dict[str, float]) -> str:
    return " / ".join(f"{spread[name]:.2f}" for name in ("median", "p90", "max")) + " mm"
