"""Figures of a report: greedy evaluations during training, and smoothed curves of the training itself."""

import io
from collections.abc import Sequence
from math import ceil
from statistics import mean
from typing import Any

import numpy as np
from jaxtyping import Float

from dora.agents.reports.run_results import SECONDS_PER_MINUTE, Group, Run, grouped, zero_episodes, zero_shares
from dora.agents.runs.progress_table import STAGE

COLOURS = {
    ("PPO", "affordance"): "#c0392b",
    ("PPO", "none"): "#e59866",
    ("SAC", "affordance"): "#1f618d",
    ("SAC", "none"): "#85c1e9",
}
"""Line colour of each learner with and without guidance."""
OTHERS = (
    "#148f77", "#b9770e", "#7d3c98", "#566573", "#e84393", "#00acc1", "#212121", "#7cb342", "#8d6e63", "#3949ab",
    "#c0ca33", "#ad1457",
)  # fmt: skip
"""Line colours of all else, in this order."""
EPOCHS = 10_000
"""Epochs of the paper's trainings [1]: one of its epochs is this share of a budget."""
SIGMA = 200
"""Standard deviation of the Gaussian with which the paper smooths its curves, in its epochs [1]."""
LONGEST = 60
"""Largest number of characters of a name in a figure [1]."""
GRID = 200
"""Points of a smoothed curve [1]."""
TRAINING = (
    ("success_rate", "training success"), ("return_mean", "training return"), ("penetration_mm", "overlap [mm]"),
)  # fmt: skip
"""Columns of `progress.csv` that are drawn beside those of sub-tasks, and their labels."""
ACROSS, MOST_STAGES = 3, 12
"""Axes in a row of a figure, and the largest number of sub-tasks that are drawn [1]."""


def smoothed(
    at: Float[np.ndarray, " p"],
    steps: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, " rows"],
    weights: Float[np.ndarray, " rows"],
    sigma: float,
) -> Float[np.ndarray, " p"]:
    """Mean of values around each place, weighted by a Gaussian; NaN where there are none.

    Args:
        at: places [environment steps].
        steps: places of the values [environment steps].
        values: NaN is left out.
        weights: of the values, such as the episodes over which each is a mean.
        sigma: standard deviation of the Gaussian [environment steps].
    """
    known = np.isfinite(steps) & np.isfinite(values) & (weights > 0)
    steps, values, weights = steps[known], values[known], weights[known]
    found = np.full(len(at), np.nan)
    for k, place in enumerate(at):  # one after the other, so that the memory does not grow with both
        kernel = np.exp(-0.5 * ((place - steps) / sigma) ** 2) * weights
        if (total := kernel.sum()) > 1e-12:
            found[k] = kernel @ values / total
    return found


def draw_curves(runs: Sequence[Run], env: str, preset: str) -> bytes:
    """A PNG of success and return of greedy evaluations over environment steps and minutes, one line per learner: mean
    and range over seeds; dotted, the success of no correction in the last evaluations. Below, where runs have a
    `progress.csv`, what happened in training, smoothed as in the paper, before the raw values: success, return,
    overlap, and the share of episodes in which each sub-task was done."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    groups = {group: members for group, members in grouped(runs).items() if group[:2] == (env, preset)}
    evaluated = {group: some for group, members in groups.items() if (some := [m for m in members if m.curve])}
    trained = {group: some for group, members in groups.items() if (some := [m for m in members if m.progress])}
    shown = _columns_of(trained)
    rows = 1 + ceil(len(shown) / ACROSS)
    figure, axes = pyplot.subplots(rows, ACROSS, figsize=(13, 0.6 + 3.6 * rows), layout="constrained", squeeze=False)
    for axis in axes.flat:
        axis.set_prop_cycle(color=OTHERS)
    colours = _draw_evaluations(axes[0], evaluated)
    places = list(axes[1:].flat)
    for axis, (column, label) in zip(places[: len(shown)], shown, strict=True):
        _draw_training(axis, column, label, trained, colours)
    for axis in places[len(shown) :]:
        axis.remove()
    legend = figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=2)
    for text in legend.get_texts():
        text.set_parse_math(False)
    about = "greedy evaluation during training (mean and range over seeds; dotted: no correction)"
    below = f"\nbelow: training, smoothed over {SIGMA / EPOCHS:.0%} of the budget" if trained else ""
    figure.suptitle(f"{shortened(env)}, preset {shortened(preset)}: {about}{below}").set_parse_math(False)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    pyplot.close(figure)
    return content.getvalue()


def draw_overlap(runs: Sequence[Run], env: str, preset: str) -> bytes:
    """A PNG of the share of evaluation episodes whose largest overlap stays below a depth, one line per learner and
    guidance, over the episodes of all its seeds; dotted, zero correction, once where it is that of the lines before."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(7, 4.2), layout="constrained")
    axis.set_prop_cycle(color=OTHERS)
    max_penetration, seen = 0.0, set[bytes]()
    for group, members in grouped(runs).items():
        if group[:2] != (env, preset):
            continue
        colour = COLOURS.get(group[2:4])
        for tables, style in (([m.episodes for m in members], "-"), (zero_episodes(members), ":")):
            depths = [table["penetration_mm"] for table in tables if "penetration_mm" in table]
            depth = np.sort(np.concatenate(depths)) if depths else np.empty(0)
            if len(depth) and (style == "-" or depth.tobytes() not in seen):
                seen.add(depth.tobytes())
                shares = np.arange(1, len(depth) + 1) / len(depth)
                what = "" if style == "-" else ", zero correction"
                label = f"{shortened(group[2])}, guidance {shortened(group[3])} ({len(depth)}){what}"
                (line,) = axis.step(depth, shares, style, where="post", color=colour, label=label)
                colour = line.get_color()
                max_penetration = max(max_penetration, float(np.percentile(depth, 99)))
    axis.set_xlim(0, 1.05 * max(max_penetration, 1.0))
    axis.set_ylim(0, 1.01)
    axis.set_xlabel("largest overlap of an episode [mm]")
    axis.set_ylabel("share of episodes below")
    axis.grid(alpha=0.3)
    for text in axis.legend(fontsize=7, loc="lower right").get_texts():
        text.set_parse_math(False)
    axis.set_title(f"{shortened(env)}, preset {shortened(preset)}", fontsize=10).set_parse_math(False)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    pyplot.close(figure)
    return content.getvalue()


def shortened(name: str) -> str:
    """A name as a figure shows it: characters that can be printed, and not too many."""
    text = "".join(c if c.isprintable() else "?" for c in name)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def _together(
    curves: Sequence[Sequence[tuple[float, float]]],
) -> tuple[Float[np.ndarray, " x"], Float[np.ndarray, "runs x"]]:
    """Curves of several runs at the same x: those at which every run was evaluated between its first and last one, with
    straight lines between evaluations.

    A run that was good enough early keeps its last value. Nothing is drawn before all runs have begun.
    """
    known = [np.array(curve) for curve in curves]
    at = np.unique(np.concatenate([curve[:, 0] for curve in known]))
    at = at[at >= max(curve[0, 0] for curve in known)]
    return at, np.stack([np.interp(at, *curve.T) for curve in known])


def _draw_evaluations(axes: Any, groups: dict[Group, list[Run]]) -> dict[Group, Any]:
    """Three axes of greedy evaluations; returns the colour of each group."""
    colours: dict[Group, Any] = {}
    by_steps, by_minutes = ("env_steps", 1e3), ("wall_seconds", SECONDS_PER_MINUTE)
    views = ((*by_steps, "success_rate"), (*by_minutes, "success_rate"), (*by_steps, "return_mean"))
    for axis, (x, unit, y) in zip(axes, views, strict=True):
        for group, members in groups.items():
            at, values = _together([[(row[x] / unit, row[y]) for row in m.curve] for m in members])
            label = f"{shortened(group[2])}, guidance {shortened(group[3])}, {group[4]}k ({len(members)})"
            colour = colours.get(group, COLOURS.get(group[2:4]))
            (line,) = axis.plot(at, values.mean(0), color=colour, marker="o", markersize=3, label=label)
            colour = colours[group] = line.get_color()
            axis.fill_between(at, values.min(0), values.max(0), color=colour, alpha=0.15)
            zero = [rate for rate, _ in zero_shares(members)]
            if zero and y == "success_rate":
                axis.axhline(mean(zero), color=colour, linestyle=":")
        axis.set_xlabel("environment steps [1000]" if x == "env_steps" else "minutes")
        axis.set_ylabel(y.replace("_", " "))
        axis.grid(alpha=0.3)
        if y == "success_rate":
            axis.set_ylim(-0.02, 1.02)
    return colours


def _columns_of(groups: dict[Group, list[Run]]) -> list[tuple[str, str]]:
    """Columns of training that are drawn, and their labels: those of `TRAINING`, and the sub-tasks of any run."""
    names = dict.fromkeys(name for members in groups.values() for m in members for name in m.progress)
    stages = [name for name in names if name.startswith(STAGE)][:MOST_STAGES]
    return [*TRAINING, *((name, f"training {shortened(name.removeprefix(STAGE))}") for name in stages)] if names else []


def _draw_training(
    axis: Any, column: str, label: str, groups: dict[Group, list[Run]], colours: dict[Group, Any]
) -> None:
    """One column of training: the mean over seeds of smoothed curves, before the raw values of each seed."""
    for group, members in groups.items():
        if not all(column in m.progress for m in members):
            continue  # the sub-task of another form of the task
        colour, curves = colours.get(group, COLOURS.get(group[2:4])), []
        at = np.linspace(0, min(np.nanmax(m.progress["env_steps"], initial=0.0) for m in members), GRID)
        for m in members:
            steps, values, episodes = (m.progress[name] for name in ("env_steps", column, "episodes"))
            curves.append(smoothed(at, steps, values, episodes, max(m.budget, 1) * SIGMA / EPOCHS))
            known = np.isfinite(values)
            (line,) = axis.plot(steps[known] / 1e3, values[known], color=colour, alpha=0.15, linewidth=0.6)
            colour = colours[group] = line.get_color()
        axis.plot(at / 1e3, np.mean(curves, 0), color=colour)
    axis.set_xlabel("environment steps [1000]")
    axis.set_ylabel(label).set_parse_math(False)
    axis.grid(alpha=0.3)
    if column.startswith(STAGE):
        axis.set_ylim(-0.02, 1.02)
