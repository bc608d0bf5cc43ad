"""Wilson's interval, against its formula."""

import math

import pytest

from dora.tables import share_text, wilson

Z = 1.959963984540054  # 97.5 % quantile of the normal distribution


@pytest.mark.parametrize(("hits", "trials"), [(0, 10), (175, 200), (200, 200), (1, 3)])
def test_the_interval_is_the_formula_of_wilson(hits: int, trials: int):
    share, square = hits / trials, Z * Z / trials
    centre = (share + square / 2) / (1 + square)
    half = Z / (1 + square) * math.sqrt(share * (1 - share) / trials + square / 4 / trials)
    assert wilson(hits, trials) == pytest.approx((max(centre - half, 0), min(centre + half, 1)), abs=1e-9)


def test_nothing_is_known_without_trials():
    assert wilson(0, 0) == (0.0, 1.0)


def test_a_share_in_words():
    assert share_text(0.875, 200) == "0.875 [0.822, 0.914]"
    assert share_text(0.875, 200, scale=100.0, digits=1) == "87.5 [82.2, 91.4]"
