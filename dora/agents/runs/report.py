"""Tables and curves from finished runs: everything a README may claim, made from files."""

import html
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from urllib.parse import quote

from dora.agents.evaluation.intervals import share_text
from dora.agents.runs.figures import SECONDS_PER_MINUTE, draw_curves
from dora.agents.runs.run_results import DEFAULT_PRESET, Run, find_runs, grouped, success_shares, zero_shares
from dora.files import write_bytes
from dora.tables import html_page, markdown_table

HEADINGS = (
    "task", "preset", "agent", "guidance", "seeds", "success %", "each seed %", "scripted (zero correction) %",
    "penetration p95 mm", "steps", "minutes",
)  # fmt: skip
"""Of the table."""
PAGE = """\
<!doctype html>
<meta charset="utf-8">
<title>Dora runs</title>
<style>body{font-family:sans-serif;margin:2em}td,th{text-align:left;padding:.2em .8em;border-bottom:1px solid #ccc}
img{max-width:100%}</style>
<h1>Runs in {{ root }}</h1>
<table>
<tr>{% for name in head %}<th>{{ name }}</th>{% endfor %}</tr>
{%- for row in rows %}
<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{%- endfor %}
</table>
<p>{{ note }}</p>
{%- for figure in figures %}
<p><img src="{{ figure | urlencode }}"></p>
{%- endfor %}
"""
"""Template of `report.html`."""
NOTE = (
    "In brackets Wilson's 95 % interval over the evaluation episodes of all seeds, which does not hold how much seeds "
    "differ. Episodes of zero correction on the same starts are the same and count once. Other columns: mean and "
    "deviation over seeds."
)
"""What stands below the table."""


def _spread(values: Sequence[float | None], digits: int = 1) -> str:
    """Mean and deviation of the values that there are."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    deviation = f" ± {stdev(known):.{digits}f}" if len(known) > 1 else ""
    return f"{mean(known):.{digits}f}{deviation}"


def pooled(shares: Sequence[tuple[float, int]]) -> str:
    """A share [%] over the episodes of several runs with its interval; the mean alone if their number is not known.

    Args:
        shares: share and episodes of each run.
    """
    trials = sum(n for _, n in shares)
    if not shares:
        return "-"
    if not all(n for _, n in shares):
        return f"{100 * mean(share for share, _ in shares):.1f}"
    return share_text(sum(share * n for share, n in shares) / trials, trials, scale=100.0, digits=1)


def table_rows(runs: Sequence[Run]) -> list[list[str]]:
    """Cells under `HEADINGS`: one row per group of runs (`Run.group`), success over the episodes of all seeds."""
    rows = []
    for (env, preset, agent, guidance, thousands), members in grouped(runs).items():
        rows.append([
            env, preset, agent, guidance, str(len(members)),
            pooled(success_shares(members)),
            ", ".join(f"{100 * share:.1f}" for share, _ in success_shares(members)),
            pooled(zero_shares(members)),
            _spread([m.result["penetration_p95_mm"] for m in members]),
            f"{thousands}k",
            _spread([m.result["wall_seconds"] / SECONDS_PER_MINUTE for m in members]),
        ])  # fmt: skip
    return rows


def tables(runs: Sequence[Run]) -> str:
    """`table_rows` as Markdown, success in bold; names are escaped."""
    at = HEADINGS.index("success %")
    rows = [[html.escape(cell, quote=False) for cell in row] for row in table_rows(runs)]
    return markdown_table(HEADINGS, [[*row[:at], f"**{row[at]}**", *row[at + 1 :]] for row in rows]) + "\n"


def write_report(root: Path, out: Path) -> list[Path]:
    """Writes `tables.md`, a figure for each task and preset, and `report.html` into `out`; returns their paths."""
    runs = find_runs(root)
    out.mkdir(parents=True, exist_ok=True)
    write_bytes(out / "tables.md", f"{tables(runs)}\n{NOTE}\n".encode())
    figures = []
    for env, preset in sorted({run.group[:2] for run in runs if run.curve or run.progress}):
        name = env if preset == DEFAULT_PRESET else f"{env}-{preset}"
        figures.append(out / f"{quote(name, safe='')}.png")
        draw_curves(runs, env, preset, figures[-1])
    rows, names = table_rows(runs), [p.name for p in figures]
    page = html_page(PAGE, root=root.name, head=HEADINGS, rows=rows, note=NOTE, figures=names)
    write_bytes(out / "report.html", page.encode())
    return [out / "tables.md", out / "report.html", *figures]
