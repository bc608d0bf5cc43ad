"""Confusion and balanced accuracy of votes, and when a region is dominant."""

import pytest
import torch

from dora.affordance.maps.confusion import DOMINANT_SHARE, FEWEST_GRASPS, Confusion, clearly_dominant

NAMES = ("handle", "head", "face")


def agreement(*cells: tuple[int, int, int]) -> Confusion:
    """From (measured, voted, times)."""
    held = torch.tensor([h for h, _, n in cells for _ in range(n)])
    voted = torch.tensor([v for _, v, n in cells for _ in range(n)])
    return Confusion.of(NAMES, voted, held)


def test_rows_are_held_and_columns_voted_with_no_contact_last():
    found = agreement((0, 0, 3), (0, 1, 2), (1, 1, 4), (1, -1, 5))
    assert found.counts.tolist() == [[3, 2, 0, 0], [0, 4, 0, 5], [0, 0, 0, 0]]
    assert found.grasps.tolist() == [5, 9, 0]
    assert found.recall == pytest.approx({"handle": 3 / 5, "head": 4 / 9})


def test_every_region_counts_alike_however_often_it_is_held():
    found = agreement((0, 0, 1000), (1, 1, FEWEST_GRASPS // 2), (1, 0, FEWEST_GRASPS - FEWEST_GRASPS // 2))
    assert found.balanced_accuracy == pytest.approx(0.75)


def test_regions_that_are_hardly_held_do_not_count():
    found = agreement((0, 0, FEWEST_GRASPS), (1, 0, FEWEST_GRASPS), (2, 2, FEWEST_GRASPS - 1))
    assert found.balanced_accuracy == pytest.approx(0.5)
    assert found.recall["face"] == 1


def test_one_region_alone_has_nothing_to_balance():
    assert agreement((0, 0, 100), (1, 1, FEWEST_GRASPS - 1)).balanced_accuracy is None
    assert Confusion.of(NAMES, torch.zeros(0).long(), torch.zeros(0).long()).balanced_accuracy is None


def test_clearly_held():
    force = torch.tensor([[2.0, 1.0, 0.0], [2.0, 1.1, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    assert pytest.approx(2 / 3) == DOMINANT_SHARE
    assert clearly_dominant(force).tolist() == [True, False, False, True]
    assert clearly_dominant(0.01 * force).tolist() == [True, False, False, True]  # a light hold is one, too
