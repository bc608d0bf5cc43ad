"""Distances from line segments: beside them, beyond their ends, and where both ends are one point."""

import numpy as np
import pytest
import torch

from dora.geometry.segments import distance_to_segment


@pytest.mark.parametrize(
    ("point", "distance"), [((0.5, 2.0, 0.0), 2.0), ((-3.0, 4.0, 0.0), 5.0), ((2.0, 0.0, 0.0), 1.0), ((0.3, 0, 0), 0.0)]
)
def test_the_nearest_point_is_on_the_segment(point: tuple[float, float, float], distance: float):
    start, end = torch.zeros(3), torch.tensor([1.0, 0.0, 0.0])
    for ends in ((start, end), (end, start)):
        assert float(distance_to_segment(torch.tensor(point), *ends)) == pytest.approx(distance, abs=1e-6)


def test_a_segment_without_length_is_a_point():
    point = torch.tensor([1.0, 2.0, 2.0])
    assert float(distance_to_segment(point, torch.zeros(3), torch.zeros(3))) == 3.0


def test_points_and_segments_broadcast():
    points, start, end = torch.randn(5, 7, 3), torch.randn(5, 1, 3), torch.randn(5, 1, 3)
    found = distance_to_segment(points, start, end)
    share = torch.linspace(0, 1, 4001)[:, None, None, None]
    sampled = (points - start - share * (end - start)).norm(dim=-1).amin(0)
    np.testing.assert_allclose(found, sampled, atol=2e-3)
    assert bool((found <= sampled + 1e-6).all())
