"""The picture of success against how episodes began: what is drawn where, and how it is named."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot
from test_report_sections import made, of

from dora.agents.reports.run_results import Run
from dora.agents.reports.starts import MOST_DRAWN, draw_starts


def drawn(runs: Sequence[Run], monkeypatch: pytest.MonkeyPatch) -> Any:
    """The figure of the jug with the standard preset."""
    figures = []
    monkeypatch.setattr(pyplot, "close", figures.append)
    assert draw_starts(runs, "DoraJug-v1", "standard").startswith(b"\x89PNG")
    monkeypatch.undo()
    pyplot.close("all")
    return figures[0]


def episodes(*hits: float, names: Sequence[str] = ("size",)) -> dict[str, np.ndarray]:
    """Episodes that end so, whose numbers rise from 0."""
    return of(*hits) | {f"start/{name}": np.arange(float(len(hits))) for name in names}


def test_each_quarter_is_a_point_with_its_interval(monkeypatch: pytest.MonkeyPatch):
    """Two seeds with eight episodes, of which the lower ones succeed; without correction the upper ones do."""
    learned, zero = episodes(1, 1, 1, 0, 0, 0, 0, 0), episodes(0, 0, 0, 0, 0, 0, 1, 1)
    runs = [made(episodes=learned, zero=zero, zero_success_rate=0.25), made(episodes=learned, seed=11)]
    others = [made(episodes=zero, preset="hard"), made(episodes=zero, env="DoraCube-v1")]
    figure = drawn([*runs, *others], monkeypatch)
    axis = figure.axes[0]
    ours, theirs = axis.containers
    assert ours.get_label() == "PPO, guidance affordance (2)"
    assert theirs.get_label() == "PPO, guidance affordance (2), zero correction"
    for container, share, spread, style in (
        (ours, [1, 0.5, 0, 0], [(0.510, 1), (0.150, 0.850), (0, 0.490), (0, 0.490)], "-"),  # Wilson's, of four
        (theirs, [0, 0, 0, 1], [(0, 0.658), (0, 0.658), (0, 0.658), (0.342, 1)], ":"),  # of two
    ):
        line, _, (bars,) = container
        assert line.get_xdata().tolist() == [0.5, 2.5, 4.5, 6.5]
        assert line.get_ydata().tolist() == share
        assert line.get_linestyle() == style
        ends = np.array(bars.get_segments())[:, :, 1]
        np.testing.assert_allclose(ends, spread, atol=1e-3)
    assert axis.get_xlabel() == "size"
    assert axis.get_ylabel() == "success"
    assert axis.get_ylim() == (-0.02, 1.02)
    assert [other.axison for other in figure.axes] == [True, False, False]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [ours.get_label(), theirs.get_label()]
    assert figure.get_suptitle() == "DoraJug-v1, preset standard: success in quarters of the episodes"
    named = [*figure.texts, axis.xaxis.label, *figure.legends[0].get_texts()]
    assert not any(text.get_parse_math() for text in named)  # a $ of a name stays one


@pytest.mark.parametrize(("count", "down"), [(0, 1), (1, 1), (3, 1), (4, 2), (7, 3)])
def test_three_pictures_stand_in_a_row(count: int, down: int, monkeypatch: pytest.MonkeyPatch):
    names = [f"mass_{k}" for k in range(count)]
    table = episodes(*[1.0, 0.0] * 4, names=names) | {"start/same": np.ones(8)}
    figure = drawn([made(episodes=table)], monkeypatch)
    assert len(figure.axes) == 3 * down
    assert figure.get_size_inches().tolist() == pytest.approx([13, 0.8 + 3.2 * down])
    assert [axis.get_xlabel() for axis in figure.axes if axis.axison] == [name.replace("_", " ") for name in names]
    assert [len(axis.containers) for axis in figure.axes] == [1] * count + [0] * (3 * down - count)


@pytest.mark.parametrize(("more", "said"), [(0, False), (1, True)])
def test_numbers_that_are_left_out_are_counted(more: int, said: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("dora.agents.reports.starts.MOST_DRAWN", 2)
    assert MOST_DRAWN == 30
    table = episodes(1, 0, 1, 0, names=[f"n{k}" for k in range(2 + more)])
    figure = drawn([made(episodes=table)], monkeypatch)
    assert len(figure.axes) == 3
    assert (f" (the first 2 of {2 + more} numbers)" in figure.get_suptitle()) == said
    assert sum(axis.axison for axis in figure.axes) == 2
