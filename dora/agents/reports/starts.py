"""Success against how episodes began: error of the candidate, mass, friction and size."""

import io
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from dora.agents.reports.figures import COLOURS, OTHERS, shortened
from dora.agents.reports.run_results import Run, grouped, seeds_of, zero_episodes
from dora.agents.reports.section import Section
from dora.tables import wilson

PREFIX = "start/"
"""Of the columns of an eval.csv that say how its episode began."""
PARTS = 4
"""Parts with equally many episodes into which those of a group are divided [1]."""
ACROSS, MOST_DRAWN = 3, 30
"""Pictures in a row of the figure, and in all of it; further numbers stand in the table alone [1]."""

Episodes = Mapping[str, Float[np.ndarray, " _"]]
"""Columns of an eval.csv, or of those of several seeds, one after the other."""
Bin = tuple[float, float, int, int]
"""Lowest and highest value of a number, episodes, successes."""


def bins(episodes: Episodes, name: str) -> list[Bin]:
    """Episodes in the order of a number of their start, in `PARTS` parts; none if it is the same in all.

    Args:
        episodes: columns, among them `success` and that of the number.
        name: of its column.
    """
    values, success = episodes[name], episodes["success"]
    if len(values) < PARTS or np.ptp(values) <= 1e-6 * np.abs(values).max():
        return []
    order = np.argsort(values, kind="stable")
    parts = np.array_split(order, PARTS)
    return [(values[p].min(), values[p].max(), len(p), round(success[p].sum())) for p in parts]


def joined(tables: Sequence[Episodes]) -> dict[str, Float[np.ndarray, " _"]]:
    """The columns that all tables have, one table after the other; tables without numbers of the start are left out."""
    tables = [table for table in tables if any(map(_is_start, table))]
    names = [name for name in tables[0] if all(name in table for table in tables)] if tables else []
    return {name: np.concatenate([table[name] for table in tables]) for name in names}


def starts_section(runs: Sequence[Run]) -> Section:
    """Success in each quarter of the episodes, in the order of each number that was drawn at their start; of runs in
    which no episode succeeds there is nothing to tell."""
    rows = []
    for (env, preset, agent, guidance, _), members in grouped(runs).items():
        episodes = joined([run.episodes for run in members])
        for name in filter(_is_start, episodes if np.any(episodes.get("success", 0)) else ()):
            cells = [f"{100 * hits / n:.1f} ({low:.3g} to {high:.3g})" for low, high, n, hits in bins(episodes, name)]
            if cells:
                rows.append([env, preset, agent, guidance, name.removeprefix(PREFIX), *cells])
    head = ("task", "preset", "learner", "guidance", "number", "lowest quarter", "second", "third", "highest quarter")
    note = (
        "Success % over the episodes of all seeds, and in brackets the number's range in that quarter. Runs in which "
        "no episode succeeds are left out."
    )
    return Section("Success against how episodes began", head, rows, note)


def _is_start(name: str) -> bool:
    return name.startswith(PREFIX)


def has_starts(runs: Sequence[Run], env: str, preset: str) -> bool:
    """Whether some run of a task and preset says how its episodes began."""
    return any(run.group[:2] == (env, preset) and any(map(_is_start, run.episodes)) for run in runs)


@dataclass(frozen=True)
class Line:
    """A line of the figure.

    Attributes:
        episodes: columns, of all seeds.
        style: of the line: dotted for zero correction.
        colour: the same in every picture, for zero correction that of the first learner that has it.
        label: in the legend.
    """

    episodes: Episodes
    style: str
    colour: str
    label: str


def _lines(runs: Sequence[Run], env: str, preset: str) -> list[Line]:
    """Learners and guidance of a task and preset, and zero correction once where it is that of lines before."""
    lines, seen, others = list[Line](), set[bytes](), itertools.cycle(OTHERS)
    for group, members in grouped(runs).items():
        if group[:2] == (env, preset):
            colour = COLOURS.get(group[2:4]) or next(others)
            for tables, style in (([m.episodes for m in members], "-"), (zero_episodes(members), ":")):
                episodes = joined(tables)
                drawn = (name for name in sorted(episodes) if _is_start(name) or name == "success")
                key = b"".join(np.asarray(episodes[name]).tobytes() for name in drawn)
                if episodes and (style == "-" or key not in seen):
                    seen.add(key)
                    what = "" if style == "-" else ", zero correction"
                    label = f"{shortened(group[2])}, guidance {shortened(group[3])} ({seeds_of(members)}){what}"
                    lines.append(Line(episodes, style, colour, label))
    return lines


def draw_starts(runs: Sequence[Run], env: str, preset: str) -> bytes:
    """A PNG of success over each number of the start, the first `MOST_DRAWN` of them, one line per learner and guidance
    with Wilson's intervals of each quarter of its episodes; dotted, zero correction."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    lines = _lines(runs, env, preset)
    names = list(dict.fromkeys(n for line in lines for n in filter(_is_start, line.episodes) if bins(line.episodes, n)))
    count, names = len(names), names[:MOST_DRAWN]
    down = -(-max(len(names), 1) // ACROSS)
    figure, axes = pyplot.subplots(
        down, ACROSS, figsize=(13, 0.8 + 3.2 * down), layout="constrained", squeeze=False, sharey=True
    )
    drawn: dict[str, Any] = {}
    for axis, name in zip(axes.flat, names, strict=False):
        for line in lines:
            parts = bins(line.episodes, name) if name in line.episodes else []
            if parts:
                ends = np.array([wilson(hits, n) for _, _, n, hits in parts])
                share = np.array([hits / n for _, _, n, hits in parts])
                middle = [(low + high) / 2 for low, high, _, _ in parts]
                drawn[line.label] = axis.errorbar(
                    middle, share, (share - ends[:, 0], ends[:, 1] - share), linestyle=line.style, marker="o",
                    markersize=3, capsize=2, color=line.colour, label=line.label,
                )  # fmt: skip
        axis.set_xlabel(shortened(name.removeprefix(PREFIX).replace("_", " ")), parse_math=False)
        axis.set_ylim(-0.02, 1.02)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(names) :]:
        axis.set_axis_off()
    axes[0, 0].set_ylabel("success")
    legend = figure.legend(list(drawn.values()), list(drawn), fontsize=8, loc="outside lower center", ncols=2)
    for text in legend.get_texts():
        text.set_parse_math(False)
    title = f"{shortened(env)}, preset {shortened(preset)}: success in quarters of the episodes"
    title += f" (the first {MOST_DRAWN} of {count} numbers)" if count > MOST_DRAWN else ""
    figure.suptitle(title).set_parse_math(False)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    pyplot.close(figure)
    return content.getvalue()
