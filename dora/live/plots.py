"""Plots of a live page: the terms of the reward and the overlap over the time of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dora.live.state import Episode, Setup

OVERLAP_HEIGHT, TERMS_HEIGHT = 120, 180
"""Heights of the plots [pixels]."""
TERM_COLOURS = (
    "#1f77b4", "#ff7f0e", "#2ca02c", "#9467bd", "#8c564b", "#17becf", "#bcbd22", "#e377c2", "#7f7f7f", "#d62728",
)  # fmt: skip
"""Colours of the terms, one after the other."""
OVERLAP_COLOURS = ("#8aa2c8", "#24406e", "#c0392b")
"""Colours of the overlap now, the largest so far, and the limit."""


class Plots:
    """Two plots, made anew where an environment has other terms.

    Args:
        gui: of viser's server.
        setup: of the environment.
    """

    def __init__(self, gui: Any, setup: Setup):
        self._setup = setup
        self.overlap = _plot(
            gui, "overlap [mm] over time [s]", OVERLAP_HEIGHT, ("now", "largest so far", "limit"), OVERLAP_COLOURS
        )
        self.terms = _plot(gui, "reward terms over time [s]", TERMS_HEIGHT, setup.terms, TERM_COLOURS)

    def update(self, episode: Episode) -> None:
        """Shows an episode so far."""
        history = episode.history
        time = history.time if len(history.time) > 1 else np.array([0.0, self._setup.dt])
        if len(history.time) > 1:
            terms, overlap = history.terms, history.overlap
        else:
            terms, overlap = np.zeros((2, len(self._setup.terms))), np.zeros((2, 2))
        limit = np.full(len(time), self._setup.limit)
        self.terms.data = _columns(time, *terms.T)
        self.overlap.data = _columns(time, *overlap.T, limit)

    def remove(self) -> None:
        """Takes the plots away."""
        self.terms.remove()
        self.overlap.remove()


def _columns(*columns: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.ascontiguousarray(column, np.float64) for column in columns)


def _plot(gui: Any, title: str, height: int, names: Sequence[str], colours: Sequence[str]) -> Any:
    series = [{"label": "time [s]"}]
    series += [
        {"label": name, "stroke": colours[k % len(colours)], "width": 2, "points": {"show": False}}
        for k, name in enumerate(names)
    ]
    empty = _columns(np.array([0.0, 1.0]), *np.zeros((len(names), 2)))
    return gui.add_uplot(
        empty, tuple(series), title=title, height=height, scales={"x": {"time": False}}, legend={"show": True}
    )
