"""Tables and curves from finished runs: everything a README may claim, made from files."""

import csv
import html
import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from urllib.parse import quote

from dora.errors import InputError
from dora.files import write_bytes
from dora.tables import html_page, markdown_table

COLOURS = {
    ("ppo", "affordance"): "#c0392b",
    ("ppo", "none"): "#e59866",
    ("sac", "affordance"): "#1f618d",
    ("sac", "none"): "#85c1e9",
}
"""Line colour of each learner with and without guidance; others take matplotlib's."""
CURVE_COLUMNS = ("env_steps", "wall_seconds", "success_rate", "return_mean", "penetration_p95_mm")
"""Columns of a learning curve that the report reads."""
HEADINGS = (
    "task", "preset", "agent", "guidance", "seeds", "success %", "scripted (zero correction) %", "penetration p95 mm",
    "steps", "minutes",
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
{%- for figure in figures %}
<p><img src="{{ figure | urlencode }}"></p>
{%- endfor %}
"""
"""Template of `report.html`."""
SECONDS_PER_MINUTE = 60.0
"""Seconds per minute [s]."""

DEFAULT_PRESET = "standard"
"""Preset of a run of a Dora task that names none."""

Group = tuple[str, str, str, str, int]
"""Environment, preset, agent, guidance, steps in thousands (rounded): what the runs of one row of the table share."""


@dataclass(frozen=True)
class Run:
    """One finished run: its `result.json` and the rows of its `curve.csv`."""

    folder: Path
    result: dict
    curve: list[dict[str, float]]

    @property
    def group(self) -> Group:
        """Runs that differ only in their seed share it; guidance names its parts if the run did."""
        task = self.result if "preset" in self.result else self.result.get("task", {})
        parts = task.get("guidance_parts")
        guidance = self.result["guidance"] + (f" ({', '.join(parts)})" if parts else "")
        thousands = round(self.result["env_steps"] / 1000)
        return self.result["env"], task.get("preset", DEFAULT_PRESET), self.result["agent"], guidance, thousands


def find_runs(root: Path) -> list[Run]:
    """All finished runs under `root`, by path; unfinished ones are left out.

    Raises:
        InputError: if there is none, or a result file is damaged.
    """
    runs = []
    for path in sorted(root.rglob("result.json")):
        try:
            result = json.loads(path.read_text())
        except json.JSONDecodeError as error:
            raise InputError(f"{path} is damaged ({error}); repeat the run or remove its folder.") from error
        curve = path.with_name("curve.csv")
        if result.get("finished"):
            runs.append(Run(path.parent, result, _rows(curve) if curve.exists() else []))
    if not runs:
        raise InputError(f"there is no finished run under {root}: point at a folder with result.json files in it.")
    return runs


def _rows(path: Path) -> list[dict[str, float]]:
    with path.open() as file:
        return [{k: float(row[k]) for k in CURVE_COLUMNS} for row in csv.DictReader(file)]


def _spread(values: list[float], digits: int = 1) -> str:
    deviation = f" ± {stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{mean(values):.{digits}f}{deviation}"


def _zero_rates(results: list[dict]) -> list[float]:
    """Success of no correction in the runs that have a prior."""
    return [r["zero_success_rate"] for r in results if r["zero_success_rate"] is not None]


def table_rows(runs: list[Run]) -> list[list[str]]:
    """Cells under `HEADINGS`: one row per group of runs (`Run.group`), mean and deviation over seeds."""
    groups: dict[Group, list[dict]] = defaultdict(list)
    for run in runs:
        groups[run.group].append(run.result)
    rows = []
    for (env, preset, agent, guidance, thousands), results in sorted(groups.items()):
        zero = [100 * rate for rate in _zero_rates(results)]
        rows.append([
            env, preset, agent.upper(), guidance, str(len(results)),
            _spread([100 * r["success_rate"] for r in results]),
            _spread(zero) if zero else "-",
            _spread([r["penetration_p95_mm"] for r in results]),
            f"{thousands}k",
            _spread([r["wall_seconds"] / SECONDS_PER_MINUTE for r in results]),
        ])  # fmt: skip
    return rows


def tables(runs: list[Run]) -> str:
    """`table_rows` as Markdown, success in bold; names are escaped."""
    at = HEADINGS.index("success %")
    rows = [[html.escape(cell) for cell in row] for row in table_rows(runs)]
    return markdown_table(HEADINGS, [[*row[:at], f"**{row[at]}**", *row[at + 1 :]] for row in rows]) + "\n"


def draw_curves(runs: list[Run], env: str, preset: str, path: Path) -> None:
    """Success and return over environment steps and minutes, one line per learner: mean and range over seeds;
    dotted, the success of no correction in the last evaluations."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    groups: dict[Group, list[Run]] = defaultdict(list)
    for run in runs:
        if run.group[:2] == (env, preset) and run.curve:
            groups[run.group].append(run)
    figure, axes = pyplot.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    by_steps, by_minutes = ("env_steps", 1e3), ("wall_seconds", SECONDS_PER_MINUTE)
    views = ((*by_steps, "success_rate"), (*by_minutes, "success_rate"), (*by_steps, "return_mean"))
    for axis, (x, unit, y) in zip(axes, views, strict=True):
        for (_, _, agent, guidance, thousands), members in sorted(groups.items()):
            length = min(len(m.curve) for m in members)
            values = [[m.curve[i][y] for m in members] for i in range(length)]
            at = [mean(m.curve[i][x] for m in members) / unit for i in range(length)]
            colour = COLOURS.get((agent, guidance))
            label = f"{agent.upper()}, guidance {guidance}, {thousands}k ({len(members)})"
            (line,) = axis.plot(at, [mean(v) for v in values], color=colour, marker="o", markersize=3, label=label)
            colour = line.get_color()
            axis.fill_between(at, [min(v) for v in values], [max(v) for v in values], color=colour, alpha=0.15)
            zero = _zero_rates([m.result for m in members])
            if zero and y == "success_rate":
                axis.axhline(mean(zero), color=colour, linestyle=":")
        axis.set_xlabel("environment steps [1000]" if x == "env_steps" else "minutes")
        axis.set_ylabel(y.replace("_", " "))
        axis.grid(alpha=0.3)
    axes[0].set_ylim(-0.02, 1.02)
    axes[1].set_ylim(-0.02, 1.02)
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=2)
    about = "greedy evaluation during training (mean and range over seeds; dotted: no correction)"
    figure.suptitle(f"{env}, preset {preset}: {about}")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def write_report(root: Path, out: Path) -> list[Path]:
    """Writes `tables.md`, a figure for each task and preset, and `report.html` into `out`; returns their paths."""
    runs = find_runs(root)
    out.mkdir(parents=True, exist_ok=True)
    write_bytes(out / "tables.md", tables(runs).encode())
    figures = []
    for env, preset in sorted({run.group[:2] for run in runs}):
        name = env if preset == DEFAULT_PRESET else f"{env}-{preset}"
        figures.append(out / f"{quote(name, safe='')}.png")
        draw_curves(runs, env, preset, figures[-1])
    page = html_page(PAGE, root=root.name, head=HEADINGS, rows=table_rows(runs), figures=[p.name for p in figures])
    write_bytes(out / "report.html", page.encode())
    return [out / "tables.md", out / "report.html", *figures]
