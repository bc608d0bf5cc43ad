"""Sheets of pictures: views in a grid with titles and legends, as one PNG file."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.legend import Legend as DrawnLegend
from matplotlib.patches import Patch

from dora.affordance.views.fonts import families
from dora.files import write_bytes

Legend = Mapping[str, tuple[int, int, int]]
"""Colours (red, green and blue, 0 to 255) by their meaning."""
DPI = 100
"""Resolution of figures, pixels per inch."""
TITLE, LEGEND = 34, 50
"""Height of a row of titles and of a row of legends [pixels]."""
SIZE = 9
"""Size of letters [points]."""


@dataclass(frozen=True, eq=False)
class Panel:
    """One view: its pixels (h, w, 3), the title above it, and the legend of its own colours below it, if any."""

    view: UInt8[np.ndarray, "h w 3"]
    title: str
    legend: Legend = field(default_factory=dict)


def write_sheet(
    panels: Sequence[Panel], path: Path | str, columns: int, legend: Legend | None = None, name: str = ""
) -> None:
    """Write views of one size as a PNG.

    Args:
        panels: the views, row by row.
        path: path of the file.
        columns: number of views in a row.
        legend: legend of all views together; none if None.
        name: title of that legend.

    Raises:
        InputError: the file cannot be written.
    """
    texts = [*(legend or ()), name, *(text for panel in panels for text in (panel.title, *panel.legend))]
    content = io.BytesIO()
    with rc_context({"font.family": families("".join(texts))}):
        _drawn(panels, columns, legend, name).savefig(content, format="png")
    write_bytes(Path(path), content.getvalue())


def _drawn(panels: Sequence[Panel], columns: int, legend: Legend | None, name: str) -> Figure:
    rows = -(-len(panels) // columns)
    height, width, _ = panels[0].view.shape
    own = LEGEND if any(panel.legend for panel in panels) else 0
    size = columns * width / DPI, (rows * (height + TITLE + own) + (LEGEND if legend else 0)) / DPI
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, panel in zip(axes, panels, strict=False):
        axis.imshow(panel.view)
        axis.set_title(drawable(panel.title), fontsize=SIZE, parse_math=False)
        if panel.legend:
            _plain(axis.legend(
                handles=_patches(panel.legend), loc="upper center", bbox_to_anchor=(0.5, 0.0),
                ncols=len(panel.legend), fontsize=SIZE, frameon=False,
            ))  # fmt: skip
    if legend:
        handles = _patches(legend)
        _plain(figure.legend(
            handles=handles, loc="outside lower center", ncols=len(handles), fontsize=SIZE, frameon=False,
            title=drawable(name),
        ))  # fmt: skip
    return figure


def drawable(text: str) -> str:
    """A text without parts that no letters can be, such as those of a file's name that is not in UTF-8."""
    return text.encode(errors="replace").decode()


def _patches(legend: Legend) -> list[Patch]:
    """A patch for each colour; matplotlib leaves out names that begin with "_", so these get a space."""
    names = {label: drawable(f" {label}" if label.startswith("_") else label) for label in legend}
    return [Patch(color=np.divide(colour, 255).tolist(), label=names[label]) for label, colour in legend.items()]


def _plain(legend: DrawnLegend) -> None:
    """Shows names as they are, without mathematics between signs of dollar."""
    for text in (*legend.get_texts(), legend.get_title()):
        text.set_parse_math(False)
