"""Tables and curves from finished runs: everything a README may claim, made from files."""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from urllib.parse import quote

from dora.agents.reports.comparison import sections
from dora.agents.reports.figures import draw_curves, draw_overlap, shortened
from dora.agents.reports.physics import apart, physics_section
from dora.agents.reports.run_results import (
    ALONE,
    DEFAULT_PRESET,
    EARLIER,
    SHARED,
    UNKNOWN,
    Run,
    find_runs,
    grouped,
    seeds_of,
    several,
    shared_mark,
    success_shares,
    zero_shares,
)
from dora.agents.reports.section import OVERLAP, Section
from dora.agents.reports.starts import draw_starts, has_starts, starts_section
from dora.digests import digest_of
from dora.files import make_folder, write_bytes
from dora.tables import html_page, markdown_table, markdown_text, share_text

LONGEST_FILE = 180
"""Largest number of characters of the name of a figure, without its ending [1]."""
HEADINGS = (
    "task", "preset", "agent", "guidance", "seeds", "success %", "each seed %", "scripted (zero correction) %",
    "penetration p95 mm", "steps", "minutes",
)  # fmt: skip
"""Of the table."""
NAMES = 4
"""Number of its first columns, which hold names from files."""
PAGE = """\
<!doctype html>
<meta charset="utf-8">
<title>Dora runs</title>
<style>body{font-family:sans-serif;margin:2em}td,th{text-align:left;padding:.2em .8em;border-bottom:1px solid #ccc}
img{max-width:100%}h2{margin-top:2em}</style>
<h1>Runs in {{ root }}</h1>
<table>
<tr>{% for name in head %}<th>{{ name }}</th>{% endfor %}</tr>
{%- for row in rows %}
<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{%- endfor %}
</table>
<p>{{ with_code(note) }}</p>
{%- for name, picture in figures %}
<p><img alt="{{ name }}" src="data:image/png;base64,{{ picture }}"></p>
{%- endfor %}
{%- for section in sections %}
<h2>{{ with_code(section.title) }}</h2>
<table>
<tr>{% for name in section.head %}<th>{{ with_code(name) }}</th>{% endfor %}</tr>
{%- for row in section.rows %}
<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{%- endfor %}
</table>
<p>{{ with_code(section.note) }}</p>
{%- endfor %}
"""
"""Template of `report.html`, which needs no other file."""
NOTE = (
    "In brackets Wilson's 95 % interval over the evaluation episodes of all seeds, which counts neither how much seeds "
    "differ nor that they have the same starts. Episodes of zero correction on the same starts are the same and count "
    f"once. Other columns: mean and deviation over seeds. Minutes with{SHARED}: other programs kept more than {ALONE} "
    f"cores busy meanwhile; with{UNKNOWN}: that was not measured. Guidance '{EARLIER.strip(', ')}': what counts as "
    "a success has changed since (definition in the task's numbers), and the figures are by the earlier rules. A run "
    "that was repeated with the same seed and settings counts once."
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
            env, preset, agent, guidance, str(seeds_of(members)),
            pooled(success_shares(members)),
            ", ".join(f"{100 * share:.1f}" for share, _ in success_shares(members)),
            pooled(zero_shares(members)),
            _spread([m.result["penetration_p95_mm"] for m in members]),
            f"{thousands}k",
            _spread([m.minutes for m in members]) + shared_mark(members),
        ])  # fmt: skip
    return rows


def tables(runs: Sequence[Run]) -> str:
    """`table_rows` as Markdown, success in bold; names are escaped."""
    at = HEADINGS.index("success %")
    rows = [[*map(markdown_text, row[:NAMES]), *row[NAMES:]] for row in table_rows(runs)]
    return markdown_table(HEADINGS, [[*row[:at], f"**{row[at]}**", *row[at + 1 :]] for row in rows]) + "\n"


def file_name(name: str) -> str:
    """A name as that of a file, cut where it would be too long, with some of its digest then."""
    quoted = quote(name, safe="")
    return quoted if len(quoted) <= LONGEST_FILE else f"{quoted[:LONGEST_FILE]}-{digest_of(name)[:8]}"


def write_report(roots: Path | Sequence[Path], out: Path, rules: Mapping[str, int] | None = None) -> list[Path]:
    """Writes `tables.md`, `comparison.md` (sub-tasks, overlap, failures, the paper's tables, starts), curves, overlap
    and success against starts of each task and preset as figures, and `report.html`, which holds all of it, into `out`;
    returns their paths. `roots` and `rules` are those of `find_runs`.

    Raises:
        InputError: there is no finished run, a file of one is damaged, or `out` cannot be written.
    """
    runs, checks = apart(find_runs(roots, rules))
    figures = dict[str, bytes]()
    more = physics_section(runs, checks), starts_section(runs)
    compared = [*sections(runs), *(section for section in more if section.rows)]
    for env, preset in sorted({run.group[:2] for run in runs if run.curve or run.progress}):
        name = file_name(env if preset == DEFAULT_PRESET else f"{env}-{preset}")
        name = f"{name}-{digest_of([env, preset])[:8]}" if f"{name}.png" in figures else name
        figures[f"{name}.png"] = draw_curves(runs, env, preset)
        if any(run.group[:2] == (env, preset) and OVERLAP in run.episodes for run in runs):
            figures[f"{name}-overlap.png"] = draw_overlap(runs, env, preset)
        if has_starts(runs, env, preset):
            figures[f"{name}-starts.png"] = draw_starts(runs, env, preset)
    pictures = [(name, base64.b64encode(content).decode()) for name, content in figures.items()]
    shown = {"head": HEADINGS, "rows": table_rows(runs), "note": NOTE, "figures": pictures, "sections": compared}
    texts = {
        "tables.md": f"{tables(runs)}\n{NOTE}\n",
        "comparison.md": "\n".join(map(_markdown, compared)),
        "report.html": html_page(PAGE, root=" and ".join(shortened(root.name) for root in several(roots)), **shown),
    }
    contents = {name: text.encode() for name, text in texts.items()} | figures
    make_folder(out)  # everything has been read and drawn
    for name, content in contents.items():
        write_bytes(out / name, content)
    return [out / name for name in contents]


def _markdown(section: Section) -> str:
    """A section of `comparison.md`."""
    table = markdown_table(section.head, [[markdown_text(cell) for cell in row] for row in section.rows])
    return f"## {section.title}\n\n{table}\n" + (f"\n{section.note}\n" if section.note else "")
